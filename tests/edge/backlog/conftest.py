"""A store, and a disk of one megabyte."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hvt_edge.backlog.disk import Store
from programs.small_disk import small_disk
from rigs.kept import opened


@pytest.fixture(name="small_disk")
def _small_disk(tmp_path) -> Iterator[Path]:
    with small_disk(tmp_path / "small") as path:
        (path / "filler").write_bytes(bytes(400_000))
        yield path


@pytest.fixture
def folder(tmp_path) -> Iterator[Store]:
    with opened(tmp_path) as folder:
        yield folder
