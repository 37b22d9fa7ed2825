"""Fixtures of the tests that run real processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Link


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    """A ground and its edges on free ports, killed at the end of the test."""
    with Link(tmp_path) as link:
        yield link
