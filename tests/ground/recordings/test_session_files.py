"""A session in several files: nothing lost between them, and each opens by itself."""

import subprocess
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from hvt_archive.index.files import described
from hvt_archive.reading.recorded import read_recordings
from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS, Limit
from hvt_common.values import Pose, View
from hvt_ground.events import Event, Notice, Overlay, PoseUpdate, Refinement, VideoSample
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.recordings.session_files import SessionFiles
from hvt_ground.sinks.rerun.sdk import viewer_program
from hvt_ground.sinks.rerun.still_places import SLOTS
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames, session
from programs import rrd
from programs.rrd import Recording, settings

FRAMES, KEYINT, TRACKS = 100, 10, 6
SPLIT = Limit(seconds=2.0)
STARTS = [0, 30, 60, 90]
"""The keyframes at which a file's two seconds of fifteen frames are up."""


@pytest.fixture(scope="module")
def events() -> list[Event]:
    """Seven seconds with a keyframe every ten frames; the tracks of each come three frames later, as they do live."""
    drawn = drawn_frames(FRAMES)
    units = coded(drawn, kbps=300, keyint=KEYINT)
    timed = []
    for place, (event, _) in enumerate(session(drawn, units, tracks=TRACKS, total_kbps=500)):
        behind = 3 if isinstance(event, Overlay) else 4 if isinstance(event, Refinement) else 0
        timed.append((event.frame_index + behind, place, event))
    return [event for _, _, event in sorted(timed, key=lambda one: one[:2])]


def recorded(folder: Path, events: list[Event], split: Limit = SPLIT) -> tuple[list[Path], dict]:
    """The files, in the order of their names, and the newest row that an index was told of each."""
    rows: dict[str, RecordingRow] = {}
    tell = lambda row: rows.update({row.file: row})  # noqa: E731
    sink = SessionFiles(settings(folder / "flight.rrd"), split=split, tell=tell)
    for event in events:
        sink.log(event)
    sink.close()
    return sorted(folder.glob("*.rrd")), rows


@pytest.fixture(scope="module")
def parts(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The session in four files."""
    return recorded(tmp_path_factory.mktemp("parts"), events)[0]


@pytest.fixture(scope="module")
def whole(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(rrd.recorded(tmp_path_factory.mktemp("whole") / "flight.rrd", events))


def test_names_sort_and_the_video_is_continuous(parts: list[Path], whole: Recording) -> None:
    """A frame between two files would be lost for good, or one would be shown twice."""
    assert [one.name for one in parts] == [f"flight-000{number}.rrd" for number in range(1, 5)]
    videos = [Recording(one).video() for one in parts]
    assert [video[0][0] for video in videos] == STARTS, "each begins at a keyframe"
    assert [sample for video in videos for sample in video] == whole.video()


def test_each_file_opens_by_itself(parts: list[Path], whole: Recording) -> None:
    """An hour would have to be opened with all hours before it: no screen, no colours, no open tracks."""
    for path, start, end in zip(parts, STARTS, [*STARTS[1:], FRAMES], strict=True):
        subprocess.run([viewer_program(), "rrd", "verify", path], check=True, capture_output=True)
        part = Recording(path)
        assert part.blueprints == 1
        assert "uav-1" in part.rows("/session", "TextDocument:text")[-1][2][0]
        legend = set(part.rows("/base/legend", "Points2D:labels")[-1][2])
        assert legend <= set(whole.rows("/base/legend", "Points2D:labels")[-1][2])
        for frame in range(start, end):
            assert part.boxes(frame) == whole.boxes(frame), frame
            assert part.words(frame) == whole.words(frame), frame
            assert part.patches(frame).keys() == whole.patches(frame).keys(), frame
            for entity in [f"/stills/{slot}/{one}" for slot in range(SLOTS) for one in ("base", "still")]:
                shown = [one.latest(entity, "EncodedImage:blob", frame) for one in (part, whole)]
                assert shown[0] == shown[1], (entity, frame)
        timed = [frame for rows in (part.events(), part.lines("/link/bitrate")) for frame, *_ in rows]
        assert all(start <= frame < end for frame in timed), "what is of another file's time is there"


def test_all_are_shown_as_one_recording(parts: list[Path]) -> None:
    """Opened together, they would be four screens of four flights."""
    named = {(e.application_id, e.recording_id) for one in parts for e in Recording(one).reader.recordings()}
    assert named == {("hvt-uav-1", "uav-1-00ff")}


def test_events_and_plots_are_in_one_file_each(parts: list[Path], whole: Recording) -> None:
    """What is counted over all files would be counted twice."""
    read = [Recording(one) for one in parts]
    assert [one for part in read for one in part.events()] == whole.events()
    assert [one for part in read for one in part.lines("/link/bitrate")] == whole.lines("/link/bitrate")


def test_the_index_learns_what_is_in_each(events: list[Event], tmp_path: Path) -> None:
    """The hour with the truck would be found by opening them all."""
    paths, told = recorded(tmp_path, events)
    rows = [told[one.name] for one in paths]
    assert [row.frames for row in rows] == [30, 30, 30, 10]
    assert all(row.whole and not row.backlog for row in rows)
    assert [row.size_bytes for row in rows] == [one.stat().st_size for one in paths]
    assert rows[0].begin_ns == START_NS
    assert rows[-1].end_ns == START_NS + (FRAMES - 1) * STEP_NS
    assert all(one.end_ns < other.begin_ns for one, other in pairwise(rows))
    assert rows[0].classes["truck"] == 2
    assert sum(row.stills for row in rows) == len([one for one in events if isinstance(one, Refinement)])


def test_by_bytes(events: list[Event], tmp_path: Path) -> None:
    """A card that takes files up to a size would be full."""
    paths, _ = recorded(tmp_path, events, Limit(size_bytes=150_000))
    assert len(paths) > 1
    video = [sample for one in paths for sample in Recording(one).video()]
    assert [frame for frame, *_ in video] == list(range(FRAMES))


def test_a_clock_that_is_set_back_does_not_stop_the_splitting(events: list[Event], tmp_path: Path) -> None:
    """One file would grow for as long as the clock went back."""
    back = [
        replace(one, capture_ns=one.capture_ns - 10**15) if one.frame_index >= 40 else one for one in events
    ]
    paths, _ = recorded(tmp_path, back)
    assert [Recording(one).video()[0][0] for one in paths] == [0, 30, 40, 70]


def test_without_perception_files_end_too(events: list[Event], tmp_path: Path) -> None:
    """A detector that failed would hold two files open for the rest of the flight."""
    paths, told = recorded(tmp_path, [one for one in events if isinstance(one, VideoSample)])
    assert [row.frames for row in told.values()] == [30, 30, 30, 10]
    assert [Recording(one).blueprints for one in paths] == [1, 1, 1, 1]


def test_nothing_is_written_over(events: list[Event], tmp_path: Path) -> None:
    """The hours of the flight before would be gone."""
    (tmp_path / "flight-0002.rrd").write_text("mine")
    paths, _ = recorded(tmp_path, events)
    assert (tmp_path / "flight-0002.rrd").read_text() == "mine"
    assert len(paths) == 5


def outage(events: list[Event], begin: int, end: int, *, arrives: int) -> list[Event]:
    """The same, but what is of these frames comes at a later one."""
    away = [one for one in events if begin <= one.frame_index < end]
    late = [replace(one, stored=True) for one in away if isinstance(one, VideoSample | Overlay)]
    live = [one for one in events if not begin <= one.frame_index < end]
    place = next(place for place, one in enumerate(live) if one.frame_index >= arrives)
    return [*live[:place], *late, *live[place:]]


def test_backlog_of_a_former_file_lies_beside_it(events: list[Event], tmp_path: Path) -> None:
    """Whoever opens the hour of the outage would find the hole, and the picture in another hour's file."""
    paths, told = recorded(tmp_path, outage(plain(events), 10, 30, arrives=75))
    names = [one.name for one in paths]
    assert names == ["flight-0001-backlog.rrd", *(f"flight-000{number}.rrd" for number in range(1, 5))]
    beside = Recording(paths[0])
    assert [frame for frame, *_ in beside.video()] == list(range(10, 30))
    assert sorted(beside.boxes(15)) == list(range(1, TRACKS + 1))
    assert {box.class_after for box in beside.boxes(15).values()} == {"car", "van", "truck"}
    subprocess.run([viewer_program(), "rrd", "verify", paths[0]], check=True, capture_output=True)
    row = told["flight-0001-backlog.rrd"]
    assert (row.backlog, row.frames, row.whole) == (True, 20, True)
    frames = [frame for one in paths for frame, *_ in Recording(one).video()]
    assert sorted(frames) == list(range(FRAMES)), "all of them, none twice"
    after = Recording(paths[0]).rows("/base/tracks", "track_id")[-1]
    assert after[0] == 30, "the live boxes are written once more where live video goes on"


def test_backlog_of_the_newest_file_goes_into_it(events: list[Event], tmp_path: Path) -> None:
    """A file more for each short outage."""
    paths, _ = recorded(tmp_path, outage(plain(events), 5, 20, arrives=28))
    assert len(paths) == 4
    assert [frame for frame, *_ in Recording(paths[0]).video()] == list(range(30))


def test_many_outages_make_a_bounded_number_of_files(events: list[Event], tmp_path: Path) -> None:
    """Somebody in the edge's name could fill the disk with files of nothing."""
    sink = SessionFiles(settings(tmp_path / "flight.rrd"), split=Limit(seconds=1.0))
    key = next(one for one in events if isinstance(one, VideoSample))
    for number in range(8):
        sink.log(replace(key, frame_index=number * 30, capture_ns=START_NS + number * 30 * STEP_NS))
        sink.log(Notice(number * 30, START_NS + number * 30 * STEP_NS, "info", "x"))
    for number in range(100):
        sink.log(replace(key, frame_index=number % 7 * 30 + 1 + number // 7, stored=True))
    sink.close()
    assert len(list(tmp_path.glob("*-backlog*"))) == 32
    assert len(list(tmp_path.glob("*.rrd"))) == 40


def test_a_folder_that_is_gone_is_one_sentence(events: list[Event], tmp_path: Path) -> None:
    """The sink would not be made anew."""
    folder = tmp_path / "gone"
    folder.mkdir()
    sink = SessionFiles(settings(folder / "flight.rrd"), split=SPLIT)
    sink.log(events[0])
    for one in folder.iterdir():
        one.unlink()
    folder.rmdir()
    with pytest.raises(UserError, match="flight-000"):
        sink.log(events[1])
    with pytest.raises(UserError):
        sink.close()


def plain(events: list[Event]) -> list[Event]:
    """Video and tracks, without classes that a still changed."""
    nothing = np.zeros(TRACKS, np.bool_)
    return [
        replace(one, classes=one.base_classes, refined=nothing) if isinstance(one, Overlay) else one
        for one in events
        if isinstance(one, VideoSample | Overlay)
    ]


def test_a_later_file_does_not_begin_with_an_old_pose(tmp_path, events):
    """One that went stale long ago would place tracks for ten seconds of each file."""
    view = View.fitted((320, 192), (320, 192), fit="letterbox")
    said_ns = START_NS + 20 * STEP_NS
    old = PoseUpdate(20, said_ns, Pose(said_ns, 48.1, 11.5, height_m=60.0), view)
    at = next(place for place, one in enumerate(events) if one.frame_index > 20)
    files, _ = recorded(tmp_path, [*events[:at], old, *events[at:]])
    poses = [[one.capture_ns for one in read_recordings([file]).poses] for file in files]
    assert poses == [[said_ns], *[[] for _ in files[1:]]]


def test_capture_times_that_jump_do_not_fill_the_disk(tmp_path, events):
    """Each file costs 190 kB: an edge whose clock says another hour at each keyframe would begin one at each."""
    key = next(one for one in events if isinstance(one, VideoSample) and one.keyframe)
    sink = SessionFiles(settings(tmp_path / "flight.rrd"), split=Limit(seconds=3600.0))
    for number in range(12):
        jump_ns = number % 2 * 7200 * SECOND_NS
        sink.log(replace(key, frame_index=number, capture_ns=START_NS + number + jump_ns))
    sink.close()
    assert len(list(tmp_path.glob("*.rrd"))) == 9


def test_a_file_that_breaks_off_is_described_up_to_there(parts: list[Path], tmp_path: Path) -> None:
    """After a power cut the flight would be in no index, and go neither by age nor by size."""
    broken = tmp_path / "hvt-uav-1-20261122-130000.rrd"
    broken.write_bytes(parts[0].read_bytes()[: parts[0].stat().st_size * 2 // 3])
    row = described(broken)
    assert (row.edge, row.session, row.size_bytes) == ("uav-1", "00ff", broken.stat().st_size)
    assert 0 < row.frames <= 30
