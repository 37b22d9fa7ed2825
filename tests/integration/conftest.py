"""Fixtures of the tests that run real processes."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from programs.fleet_keys import Fleet
from programs.processes import Link


@pytest.fixture
def link(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Link]:
    """A ground and its edges on free ports, killed at the end of the test; of the golden flight of its module."""
    with Link(tmp_path, name=getattr(request.module, "FLIGHT", "")) as link:
        yield link


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """Edges ``uav-1`` and ``uav-2``; grounds ``base`` and ``ops`` that command, ``guest`` that watches.

    And ``stranger``, a ground whose key is newer than the files of ``uav-1`` and ``base``: they do not name it.
    """
    fleet = Fleet(tmp_path_factory.mktemp("keys") / "own")
    fleet.keys("add-edge", "uav-1", "--host", "127.0.0.1")
    fleet.keys("add-edge", "uav-2")
    fleet.keys("add-ground", "base", "--host", "127.0.0.1")
    fleet.keys("add-ground", "ops")
    fleet.keys("add-ground", "guest", "--watch-only")
    before = {name: fleet.file(name).read_text() for name in ("base", "uav-1")}
    fleet.keys("add-ground", "stranger")
    for name, text in before.items():
        fleet.file(name).write_text(text)
    return fleet
