"""Fixtures of the tests that run real processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from pictures import write_scene
from processes import Link


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    """A ground and its edges on free ports, killed at the end of the test."""
    with Link(tmp_path) as link:
        yield link


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of pictures that lasts 30 s at 10 a second."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(folder, frames=300)
    return folder
