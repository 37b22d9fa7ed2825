"""The page that explains the summaries, `docs/summary.md`."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_PAGE = Path(__file__).parents[3] / "docs" / "summary.md"
_NAMED_FREELY = {"missing_events"}
"""Its keys are parts of this one ground."""


def unexplained(content: dict[str, Any]) -> set[str]:
    """Keys of a summary, at any depth, that do not stand on the page."""
    return set(_keys(content)) - set(re.findall(r"`([^`\n]+)`", _PAGE.read_text(encoding="utf-8")))


def _keys(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield name
            if name not in _NAMED_FREELY:
                yield from _keys(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _keys(inner)
