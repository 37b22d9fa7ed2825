"""The golden flights, of real processes, and what is flown once in a run of all tests, whoever comes first."""

import fcntl
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

_Left = TypeVar("_Left")

FLIGHTS = {
    "drawn": "auto, with a pose, into every sink: recorded, exported, placed on maps, replayed",
    "outage": "the paper's method over a link that goes away: what was stored comes afterwards",
    "backlog": "an edge that is stopped while it sends what was stored before",
    "passthrough": "a camera that makes HEVC itself",
    "late": "grounds that come and go in mid-flight, and a program that is none",
    "killed": "two edges; one of them is killed, and then the ground",
    "alone": "a ground and an edge, each under systemd, that meet nobody",
    "asked": "stills, keyframes and budgets on request",
    "keys": "TLS: who may watch, who may command, who may not",
    "page": "a browser that watches and commands",
    "watched": "Prometheus, a probe and a collector of logs",
    "plug-ins": "a codec and a detector of others, installed beside HVT",
}
"""Those of `make test`, each flown once in the file of its name or in `tests/conftest.py`; all others are nightly."""


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
