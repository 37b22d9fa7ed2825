"""How much memory an object holds: what a flood must not make grow, whatever the object keeps it in."""

import gc
import sys
from types import FunctionType, ModuleType
from typing import Any


def footprint_bytes(root: Any) -> int:
    """Of the object and all that it refers to; classes, functions and modules are not its own."""
    seen: set[int] = set()
    pending, total = [root], 0
    while pending:
        one = pending.pop()
        if id(one) in seen or isinstance(one, type | FunctionType | ModuleType):
            continue
        seen.add(id(one))
        total += sys.getsizeof(one)
        pending += gc.get_referents(one)
    return total
