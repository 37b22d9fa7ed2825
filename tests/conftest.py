"""Fixtures that every test may use."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).resolve().parent.parent

# Hypothesis' own 200 ms for an example are an assertion on speed: a machine that stops the process for so long would
# break a property that holds. Here and not in a fixture: `@settings` takes what is loaded when its module is read.
settings.register_profile("hvt", deadline=None)
settings.load_profile("hvt")


@pytest.fixture(autouse=True, scope="session")
def _state_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test, and no process that one starts, keeps anything in the home of whoever runs it."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real clips, models and tracks; a test that asks for it is skipped where it is absent."""
    folder = Path(os.environ.get("HVT_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set HVT_DATA to the folder that holds it")
    return folder


@pytest.fixture
def free_port() -> int:
    """A TCP port of loopback that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
