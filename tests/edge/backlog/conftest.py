"""A disk of one megabyte."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from programs.small_disk import small_disk


@pytest.fixture(name="small_disk")
def _small_disk(tmp_path) -> Iterator[Path]:
    """With a file `filler` of 0.4 MB on it."""
    with small_disk(tmp_path / "small") as path:
        (path / "filler").write_bytes(bytes(400_000))
        yield path
