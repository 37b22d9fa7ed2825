"""What is flown once in a run of all tests, by whichever of its processes comes first; the others read it."""

from __future__ import annotations

import fcntl
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

_Left = TypeVar("_Left")


def once(factory: pytest.TempPathFactory, name: str, fly: Callable[[Path], _Left]) -> _Left:
    """What ``fly(folder)`` returned; pickled, so that nobody changes what another test reads."""
    root = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    folder, left = root / name, root / f"{name}.pickle"
    with (root / f"{name}.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not left.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            data = pickle.dumps(fly(folder))
            left.write_bytes(data)
    found: _Left = pickle.loads(left.read_bytes())
    return found
