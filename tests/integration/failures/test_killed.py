"""A flight in which an edge and the ground are killed with -9 and started again, while another edge flies on."""

import json
import shlex
import signal
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import pytest

import hvt_ground.cli
from hvt_archive.index.database import INDEX, read_index
from hvt_ground.recordings.row import RecordingRow
from programs.processes import Link, eventually
from programs.rrd import Recording

pytestmark = pytest.mark.integration


EDGE = shlex.split(
    "--size 320x192 --fps 10 --source-fps 10 --preset ultrafast --budget 300kbps"
    " --detector motion --wait 60s --method M5 --keyframe-interval 2s"
)
GROUND = shlex.split("--detector motion --classifier none --record flights --split 3s")


@dataclass
class Flight:
    """What is left of it: ``uav-1`` was killed and started again, then the ground; ``uav-2`` flew at the end."""

    folder: Path
    described: dict[str, RecordingRow]
    """The index at the moment the ground was killed, by file."""
    left: list[Path]
    """The files of the killed ground, in their order."""
    edges: dict[str, dict[str, Any]]
    """Summaries; of ``uav-1`` that of the second process."""
    ground: dict[str, dict[str, Any]]
    """Summaries of the second ground by edge."""

    @property
    def rows(self) -> dict[str, RecordingRow]:
        return {one.file: one for one in read_index(self.folder / "flights")}

    def before(self, *, doomed: bool) -> list[Path]:
        """The killed ground's files of the first process, or of the second, as they flew."""
        rows, session = self.rows, self.edges["uav-1"]["session"]
        return [
            one
            for one in self.left
            if not rows[one.name].backlog and (rows[one.name].session == session) != doomed
        ]


def ended(file: Path) -> bool:
    """Whether a recording has the end of its session in it."""
    return Recording(file).events()[-1][2].endswith("ended")


def frames(paths: list[Path]) -> list[int]:
    """Of the video in all of them, in the order of the files."""
    return [frame for path in paths for frame, *_ in Recording(path).video()]


@pytest.fixture(scope="module")
def flight(long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Flight:
    """Some three seconds to each death, and to the end."""
    folder = tmp_path_factory.mktemp("killed")
    flights = folder / "flights"
    edge = ("--source", str(long_scene), *EDGE)

    def files() -> list[Path]:
        return sorted(flights.glob("*.rrd"))

    def flown(count: int) -> None:
        eventually(lambda: len(files()) >= count, what=f"there are {count} files")

    with Link(folder, name="killed") as link:
        first = link.ground(*GROUND)
        doomed = link.edge(*edge, "--edge-id", "uav-1", "--record-base", "killed.mkv", name="doomed")
        flown(2)
        doomed.kill()
        old = files()
        steady = link.edge(*edge, "--edge-id", "uav-1", name="uav-1")
        flown(len(old) + 2)

        def closed() -> bool:
            whole = [one for one in read_index(flights) if one.whole]
            before, files = {one.name for one in old}, {one.file for one in whole}
            return before <= files and any(one.file not in before and not one.backlog for one in whole)

        eventually(closed, what="what the killed edge flew is closed, and some of what came then")
        first.kill()
        left = [one for one in files() if one.stat().st_size]
        described = {one.file: one for one in read_index(flights)}
        again = link.ground(*GROUND, "--keep", "1GB", name="again")
        other = link.edge(*edge, "--edge-id", "uav-2", "--max-frames", "40", name="uav-2")
        sent = other.finish()
        flown(len(left) + 3)

        def read() -> bool:
            return {one.name for one in left} <= {one.file for one in read_index(flights) if one.whole}

        eventually(read, what="the index has read what the killed ground left")
        again.stop(signal.SIGHUP)
        assert steady.alive, steady.said
        steady.stop(signal.SIGHUP)
        summaries: Any = {one["edge"]: one for one in again.finish()}
        return Flight(folder, described, left, {"uav-1": steady.finish(), "uav-2": sent}, summaries)


def test_the_killed_edge_left_files_that_play(flight):
    """A crash in the air would take its own evidence with it."""
    with av.open(str(flight.folder / "killed.mkv")) as container:
        shown = sum(1 for _ in container.decode(container.streams.video[0]))
    recorded = flight.before(doomed=True)
    received = len(frames(recorded))
    assert received > 1
    assert shown >= received - 3, "a fifth of a second may be missing at the end"
    assert ended(recorded[-1]), "the ground went on"


def test_the_killed_ground_left_recordings_and_an_index_that_can_be_read(flight):
    """A power cut at the ground would take all that led to it, or leave files that nobody can put in order."""
    assert flight.described.keys() <= {one.name for one in flight.left}
    recorded = flight.before(doomed=False)
    assert flight.described[recorded[0].name].whole
    seen = frames(recorded)
    assert len(seen) > 1
    assert all(one < other for one, other in pairwise(seen))
    assert len(seen) == sum(flight.rows[one.name].frames for one in recorded), "by what a killed file has"


def test_a_ground_started_in_mid_flight_shows_the_edge_that_never_stopped(flight):
    """The drone would have to be landed to be seen again."""
    edge, ground = flight.edges["uav-1"], flight.ground["uav-1"]
    assert ground["session"] == edge["session"]
    assert ground["frames_decoded"] >= 20
    assert edge["frames"] > ground["frames_decoded"] + len(frames(flight.before(doomed=False))) / 2


def test_an_edge_is_whole_beside_another(flight):
    """One drone's picture would suffer from the other's."""
    edge, ground = flight.edges["uav-2"], flight.ground["uav-2"]
    assert ground["session"] == edge["session"]
    assert ground["frames_decoded"] == ground["frames"] == edge["frames"] > 0
    assert ground["gaps"] == ground["unusable_messages"] == 0
    for count in ("base_bytes", "roi_bytes", "meta_bytes", "overhead_bytes", "worst_window_bps"):
        assert ground[count] == edge[count], count
    assert edge["worst_window_bps"]["total"] <= 300_000


def test_sighup_ends_both_with_summary_and_whole_recordings(flight):
    """A terminal that closes would cut the recordings off, and nobody would get the account."""
    for edge, summary in flight.ground.items():
        assert summary["failed"] == []
        recorded = [flight.folder / one for one in summary["recordings"]]
        assert len(frames(recorded)) == summary["frames_decoded"], edge
        assert ended(recorded[-1])
    # The edge's summary is there, and both said goodbye with 0: see `Running.finish`.
    assert flight.edges["uav-1"]["frames"] > 0


def test_the_index_names_all_that_was_recorded(flight, capsys):
    """After a power cut the flight would be in no index."""
    folder, rows = flight.folder / "flights", flight.rows
    assert set(rows) == {one.name for one in folder.glob("*.rrd")}
    assert all(one.whole and one.size_bytes == (folder / one.file).stat().st_size for one in rows.values())
    recorded = {Path(one).name for summary in flight.ground.values() for one in summary["recordings"]}
    # What an edge had kept while nobody received it comes later, as a recording of its own.
    new = rows.keys() - {one.name for one in flight.left}
    assert recorded == {name for name in new if not rows[name].backlog}
    assert len({one.session for one in rows.values() if not one.backlog}) == 3, "two of uav-1, one of uav-2"
    assert hvt_ground.cli.main(["recordings", "find", str(folder), "--edge", "uav-1", "--json"]) == 0
    found = {one["file"] for one in json.loads(capsys.readouterr().out)}
    assert found == {one.file for one in rows.values() if one.edge == "uav-1"}
    assert all(one.name.startswith(INDEX) for one in folder.iterdir() if one.suffix != ".rrd")
