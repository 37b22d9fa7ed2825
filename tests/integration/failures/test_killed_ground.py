"""Recordings of real processes: in files that follow each other, with an index that a kill leaves whole."""

from __future__ import annotations

import json
import os
from itertools import pairwise
from pathlib import Path

import pytest

import hvt_ground.cli
from hvt_archive.index.database import INDEX, read_index
from programs.processes import Link, eventually
from programs.rrd import Recording

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

EDGE = (
    *("--source", "scene", "--size", "320x180", "--fps", "10", "--preset", "ultrafast"),
    *("--budget", "300kbps"),
    *("--detector", "motion", "--edge-id", "uav-1", "--wait", "60s", "--method", "M5"),
    *("--keyframe-interval", "2s"),
)
GROUND = ("--detector", "motion", "--classifier", "none", "--record", "flights", "--split", "3s")


@pytest.fixture(autouse=True)
def long_scene(scene: Path, tmp_path: Path) -> None:
    """A minute and more, from where the edge runs."""
    (tmp_path / "scene").mkdir()
    pictures = sorted(scene.iterdir())
    for number in range(3 * len(pictures)):
        (tmp_path / "scene" / f"{number:06d}.jpg").symlink_to(pictures[number % len(pictures)])


def frames(paths: list[Path]) -> list[int]:
    """Of the video in all of them, in the order of the files."""
    return [frame for path in paths for frame, *_ in Recording(path).video()]


def test_a_ground_that_is_killed_and_started_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a power cut at the ground the flight would be in no index, or in files that nobody can put in order."""
    folder = tmp_path / "flights"
    with Link(tmp_path) as link:
        first = link.ground(*GROUND)
        edge = link.edge(*EDGE)
        eventually(lambda: len(list(folder.glob("*.rrd"))) >= 3, within_s=120, what="there are three files")
        eventually(
            lambda: any(one.whole for one in read_index(folder)), within_s=120, what="the first is described"
        )
        first.kill()
        left = [one for one in sorted(folder.glob("*.rrd")) if one.stat().st_size]
        known = {one.file: one for one in read_index(folder)}
        assert set(known) <= {one.name for one in left}, "a database that was killed can be read"
        assert known[left[0].name].whole
        again = link.ground(*GROUND, "--keep", "1GB", name="again")
        eventually(
            lambda: len(list(folder.glob("*.rrd"))) >= len(left) + 2,
            within_s=120,
            what="it goes on in new files",
        )
        edge.stop()
        again.stop()
        summary = again.summary()
        assert summary["failed"] == []
    assert [Path(one).name for one in summary["recordings"]] == sorted(
        one.name for one in folder.glob("*.rrd") if one not in left and "backlog" not in one.name
    )
    rows = {one.file: one for one in read_index(folder)}
    assert set(rows) == {one.name for one in folder.glob("*.rrd")}
    assert all(one.whole and one.size_bytes == (folder / one.file).stat().st_size for one in rows.values())
    before = frames(left)
    assert before == sorted(set(before))
    assert all(one < other for one, other in pairwise(before))
    assert sum(rows[one.name].frames for one in left) == len(before), (
        "a killed file is counted from what is in it"
    )
    assert hvt_ground.cli.main(["recordings", "find", os.fspath(folder), "--edge", "uav-1", "--json"]) == 0
    assert {one["file"] for one in json.loads(capsys.readouterr().out)} == set(rows)
    assert all(one.name.startswith(INDEX) for one in folder.iterdir() if one.suffix != ".rrd")
