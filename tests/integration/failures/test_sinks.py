"""A disk that fills while a ground writes there: only what is written there suffers."""

import csv
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from hvt_ground.sinks.rerun.sdk import viewer_environment, viewer_program
from programs.processes import Link, Running, eventually
from programs.rrd import Recording
from programs.small_disk import small_disk

pytestmark = pytest.mark.integration

EDGES = ("uav-1", "uav-2")
ANALYSES = ("--detector", "motion", "--classifier", "none")


@pytest.fixture(name="small_disk")
def _small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MB, of which 1 MB is free."""
    with small_disk(tmp_path / "disk", size="8m") as disk:
        (disk / "ballast").write_bytes(bytes(7 << 20))
        yield disk


def edges(link: Link, scene: Path) -> list[Running]:
    """Two that play the scene in real time at little cost."""
    cheap = ("--size", "640x360", "--fps", "10", "--preset", "ultrafast", "--budget", "600kbps")
    source = ("--source", str(scene), "--source-fps", "10", "--detector", "motion", *cheap)
    return [link.edge(*source, "--edge-id", name, name=name) for name in EDGES]


def columns(path: Path, name: str) -> list[str]:
    with path.open(newline="") as file:
        return [row[name] for row in csv.DictReader(file)]


def verified(path: Path) -> bool:
    """Whether Rerun's own tool finds the recording whole, its footer included."""
    command = [str(viewer_program()), "rrd", "verify", str(path)]
    return subprocess.run(command, check=False, capture_output=True, env=viewer_environment()).returncode == 0


@pytest.mark.nightly
def test_a_full_disk_under_the_recordings_ends_nothing_else(small_disk, long_scene, link):
    """It ended the whole ground with the code that keeps systemd from starting it again."""
    ground = link.ground(
        *ANALYSES, "--once", "--record", str(small_disk), "--tracks", ".", "--timing", "timing.csv"
    )
    flown = edges(link, long_scene)
    for name in EDGES:
        ground.until(f"recording of {name} FAILED at")
    firsts = [min(small_disk.glob(f"hvt-{name}-*.rrd"), key=lambda one: len(one.name)) for name in EDGES]
    before = {path: path.read_bytes() for path in firsts}
    (small_disk / "ballast").unlink()
    for name in EDGES:
        ground.until(f"recording of {name}: works again")

    def goes_on(name: str) -> bool:
        newest = max(small_disk.glob(f"hvt-{name}-*.rrd"), key=lambda one: one.stat().st_mtime)
        with suppress(RuntimeError):  # it was read in the middle of a message
            return len(Recording(newest).video()) > 10
        return False

    eventually(lambda: all(map(goes_on, EDGES)), what="video is recorded again")
    for edge in flown:
        edge.stop()
    summaries = ground.finish()
    for name, summary in zip(EDGES, summaries, strict=True):
        parts = {one["part"]: one for one in summary["failed"]}
        assert parts.keys() <= {f"recording of {name}", "recordings index"}, "the index is on that disk too"
        assert all(one["working"] for one in parts.values())
        failed = parts[f"recording of {name}"]
        assert "No space left on device" in failed["reason"]
        assert failed["since"] <= failed["last"]
        said = ground.said.count(f"hvt-ground: recording of {name}: recording {small_disk}")
        assert 1 <= said <= 3, "once, or twice where it had found some room between"
        assert summary["missing_events"][f"recording of {name}"] > 0
        first, *_, second = map(Path, summary["recordings"])
        assert first.read_bytes() == before[first], "what was recorded stays as it was"
        frames = [{frame for frame, *_ in Recording(path).video()} for path in (first, second)]
        assert len(frames[0]) > 10
        assert min(frames[1]) > max(frames[0])
        assert verified(second)
        assert f"recording of {name}" in ground.told
        table = next(link.folder.glob(f"hvt-{name}-*.csv"))
        assert max(map(int, columns(table, "frame_index"))) > min(frames[1]), "the table went on"
    shown = [kind for kind in columns(link.folder / "timing.csv", "kind") if kind == "base"]
    assert len(shown) == sum(summary["frames"] for summary in summaries), "no line of any message is missing"
