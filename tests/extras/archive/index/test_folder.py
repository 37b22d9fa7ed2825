"""The index of a folder of recordings: it survives kills and damage, disturbs no flight, removes what it should."""

import logging
import os
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr

from hvt_archive.index import folder
from hvt_archive.index.database import INDEX, read_index
from hvt_archive.index.files import claimed, is_claimed, remove_video
from hvt_archive.index.folder import IndexWriter, RecordingsFolder
from hvt_archive.index.retention import Retention
from hvt_common.errors import UserError
from hvt_common.runtime.clock import boot_id, since_boot_ns
from hvt_common.runtime.failures import Failures
from hvt_common.units import Limit
from hvt_ground.events import Event, Overlay
from hvt_ground.recordings.row import RecordingRow
from hvt_ground.recordings.session_files import SessionFiles
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.sdk import viewer_program
from media.recorded_feed import coded, drawn_frames, session
from programs import rrd
from programs.processes import eventually
from programs.rrd import Recording, ends_its_reader

FRAMES = 60
SPLIT = Limit(seconds=2.0)
STEM = time.strftime("hvt-uav-1-%Y%m%d-%H%M%S")
NAMES = [f"{STEM}-000{number}.rrd" for number in (1, 2)]
ALL = Retention()


@pytest.fixture(scope="module")
def events() -> list[Event]:
    """Four seconds: two files; a truck is called a vehicle."""
    drawn = drawn_frames(FRAMES)
    made = [one for one, _ in session(drawn, coded(drawn, kbps=200, keyint=10), tracks=6, total_kbps=400)]
    return [
        replace(one, vague=np.array([name == "truck" for name in one.classes]))
        if isinstance(one, Overlay)
        else one
        for one in made
    ]


def settings(folder: Path) -> RecorderSettings:
    """Of a session whose files have names of ours."""
    return rrd.settings(folder / f"{STEM}.rrd")


@contextmanager
def flying(folder: Path) -> Iterator[tuple[SessionFiles, Failures]]:
    """A session that is recorded with an index; whoever flies it closes it."""
    failures = Failures(time.time_ns)
    with RecordingsFolder(folder, ALL, failures=failures) as index:
        index.begin()
        yield SessionFiles(settings(folder), split=SPLIT, tell=index.recorded), failures


def log(sink: SessionFiles, events: list[Event], *, close: bool = True) -> None:
    for event in events:
        sink.log(event)
    if close:
        sink.close()


def fly(folder: Path, events: list[Event]) -> Failures:
    with flying(folder) as (sink, failures):
        log(sink, events)
    return failures


@pytest.fixture(scope="module")
def flown(events: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown")
    fly(folder, events)
    return folder


@pytest.fixture
def copied(flown: Path, tmp_path: Path) -> Path:
    return copytree(flown, tmp_path / "flights")


def look(
    folder: Path, retention: Retention = ALL, *, later_s: float = 0.0, set_by_s: float = 0.0, times: int = 1
) -> list[RecordingRow]:
    """Start a ground there, so much later, which reads what it does not know and looks so often; the index then.

    In between somebody set the clock by ``set_by_s``.
    """
    later_ns = round(later_s * 1e9)
    with closing(
        IndexWriter(
            folder,
            retention,
            now_ns=lambda: time.time_ns() + later_ns + round(set_by_s * 1e9),
            since_boot=lambda: (boot_id(), since_boot_ns() + later_ns),
        )
    ) as writer:
        while writer.unread:
            writer.log(None)
        for _ in range(times - 1):
            writer.log(None)
    return read_index(folder)


def test_files_tell_the_same_when_the_index_is_lost(copied):
    """After a damaged card everything would have to be searched by hand."""
    before = read_index(copied)
    (copied / INDEX).unlink()
    (copied / "mine.rrd").write_bytes((copied / NAMES[0]).read_bytes())
    (copied / "hvt-uav-1-20261122-140000.rrd").write_text("no recording")
    with rr.RecordingStream("hvt-uav-1", recording_id="uav-1-00ff") as odd:
        odd.save(copied / "hvt-uav-1-20261122-150000.rrd")
        boxes = rr.Boxes2D(centers=[[1, 2]], half_sizes=[[1, 2]], class_ids=[3])
        odd.log("/base/tracks", boxes, rr.AnyValues(track_id=pa.array([[1, 2]])))
    after = look(copied)
    assert [replace(one, written_ns=0) for one in after] == [replace(one, written_ns=0) for one in before]
    (copied / INDEX).unlink()
    late = (copied / NAMES[0]).rename(copied / f"{STEM}-0001-backlog.rrd")
    IndexWriter(copied, ALL).close()
    assert [one.file for one in read_index(copied) if one.backlog] == [late.name], "its name says it"


@pytest.mark.parametrize("damage", ["text", "zeros", "half", "empty"])
def test_a_damaged_index_is_set_aside_and_made_anew(copied, caplog, damage):
    """No flight could be recorded with an index, until somebody removes a file that he does not know."""
    index = copied / INDEX
    data = index.read_bytes()
    index.write_bytes(
        {
            "text": b"this is no database at all " * 50,
            "zeros": data[:4096] + bytes(len(data) - 4096),
            "half": data[: len(data) // 2 // 4096 * 4096],
            "empty": b"",
        }[damage]
    )
    with caplog.at_level(logging.WARNING):
        assert [one.file for one in look(copied)] == NAMES
    aside = list(copied.glob(f"{INDEX}.damaged-*"))
    assert len(aside) == (damage != "empty")
    assert len(caplog.messages) == (damage != "empty")


@pytest.mark.parametrize("how", ["locked", "no file"])
def test_an_index_that_cannot_be_written_disturbs_no_flight(tmp_path, events, how):
    """A backup program that holds the index would end the recording."""
    look(tmp_path)
    if how == "no file":
        for one in tmp_path.iterdir():
            one.unlink()
        (tmp_path / INDEX).mkdir()
    blocker = sqlite3.connect(":memory:" if how == "no file" else tmp_path / INDEX, isolation_level=None)
    with closing(blocker):
        blocker.execute("BEGIN EXCLUSIVE")
        with flying(tmp_path) as (sink, failures):
            log(sink, events)  # while nobody can write to the index: nobody waits for it
            eventually(lambda: failures.parts, what="it is said")
            assert [(one.part, one.working) for one in failures.parts] == [("recordings index", False)]
            assert "Error" not in failures.parts[0].reason, "it is said in words"
            blocker.execute("ROLLBACK")
            if how == "no file":
                (tmp_path / INDEX).rmdir()
            eventually(lambda: failures.parts[0].working, what="it works again")
    assert [one.file for one in look(tmp_path)] == NAMES, "what it missed it reads from the files"


def test_a_new_recording_is_not_taken_for_an_empty_one_that_was_left(tmp_path):
    """Who starts a ground while a drone flies would now and then lose the recording that has just begun."""
    Recorder(settings(tmp_path)).close()  # the first one takes its time
    path = settings(tmp_path).path
    path.write_bytes(b"")
    with ThreadPoolExecutor(1) as pool:
        with claimed(path) as ours:
            assert ours
            begun = pool.submit(Recorder, settings(tmp_path))
            time.sleep(0.3)
            path.unlink()
        with begun.result() as recorder:
            assert recorder.path.exists()
            assert is_claimed(recorder.path)
    assert Recording(path).blueprints == 1


def test_a_file_that_another_program_is_at_work_on_is_refused(tmp_path):
    """It would write into a recording that is being stripped of its video."""
    path = settings(tmp_path).path
    path.touch()
    with claimed(path), pytest.raises(UserError, match="cannot be created: another program is at work on it"):
        Recorder(settings(tmp_path))


def test_an_index_that_is_removed_in_flight_is_made_anew(tmp_path, events):
    """All that came after it would be written to a file that is in no folder."""
    with flying(tmp_path) as (sink, failures):
        eventually(lambda: (tmp_path / INDEX).exists() and read_index(tmp_path), what="a row")
        for one in tmp_path.glob(f"{INDEX}*"):
            one.unlink()
        log(sink, events, close=False)
        eventually((tmp_path / INDEX).exists, what="it is there again")
        sink.close()
        eventually(lambda: failures.parts[0].working, what="it works again")
    assert [one.file for one in look(tmp_path)] == NAMES


def test_a_disk_that_is_unmounted_and_comes_back_has_its_index(copied):
    """All its files were forgotten while another folder was in its place, which was then taken for it."""
    away = copied.with_name("away")
    with closing(IndexWriter(copied, Retention((Limit(seconds=86_400),)))) as writer:
        copied.rename(away)
        for there in (None, away):
            if there:
                copytree(there, copied, dirs_exist_ok=True)
            else:
                copied.mkdir()
            with pytest.raises(sqlite3.OperationalError, match="was removed"):
                writer.log(None)
    assert [one.file for one in read_index(away)] == NAMES


@pytest.mark.parametrize("job", ["described", "remove_video"])
def test_a_ground_that_ends_while_it_is_at_old_files_leaves_them_to_the_next(copied, monkeypatch, job):
    """It said that what it had yet to write was lost; and live video waited for the reading of old files.

    One large file, or one on a busy machine, took the rows of the flight that had come meanwhile with it.
    """
    (row, _), ended = read_index(copied), threading.Event()
    begun, failures = [], Failures(time.time_ns)

    def long(path: Path) -> None:
        begun.append((path.name, os.getpriority(os.PRIO_PROCESS, threading.get_native_id())))
        ended.wait()

    if job == "described":
        (copied / INDEX).unlink()
    monkeypatch.setattr(folder, job, long)
    rules = ALL if job == "described" else Retention(video_age=Limit(seconds=1e-6))
    with RecordingsFolder(copied, rules, failures=failures) as index:
        index.begin()
        eventually(lambda: begun, what="it is at one")
        index.recorded(replace(row, file="flown.rrd", whole=False))
    ended.set()
    assert ([name for name, _ in begun], failures.parts) == (NAMES[job == "described" :][:1], ())
    assert begun[0][1] >= 10
    assert "flown.rrd" in [one.file for one in read_index(copied)]
    monkeypatch.undo()
    assert [(one.file, one.frames) for one in look(copied)] == [(name, 30) for name in NAMES]


def test_files_that_were_not_read_yet_count_and_keep_no_flight_waiting(copied, monkeypatch):
    """After a lost index the disk was full before thousands of files were read, and rows of flights were dropped.

    Of two edges the oldest file goes, not that of the first name; what a stranger put there stays, and counts not.
    """
    before = read_index(copied)
    (copied / INDEX).unlink()
    strangers = [copied / "hvt-uav-1-20200101-000000.rrd", copied / "hvt-uav-2-20200101-000000.rrd"]
    strangers[0].write_bytes(bytes(10**8))
    strangers[1].write_bytes((copied / NAMES[0]).read_bytes())
    monkeypatch.setattr(folder, "described", lambda path: pytest.fail(f"{path} is read first"))
    size = Limit(size_bytes=before[1].size_bytes + before[0].size_bytes + 99)
    with closing(IndexWriter(copied, Retention((size,)))) as writer:
        row = replace(before[0], file="hvt-a-20000101-000000.rrd", edge="a", size_bytes=100, whole=False)
        (copied / row.file).touch()
        assert [one.file for one in read_index(copied)] == NAMES
        writer.log(row)
        assert [one.file for one in read_index(copied)] == [row.file, *NAMES]
        writer.log(replace(row, whole=True))
        assert [one.file for one in read_index(copied)] == [row.file, NAMES[1]]
        assert writer.unread == [*(one.name for one in strangers), *NAMES]
    assert not (copied / NAMES[0]).exists()
    assert all(one.exists() for one in strangers)


def test_what_was_known_of_a_file_stays_until_it_is_read(copied):
    """After a power cut `find --class truck` left it out, and for good where it cannot be read any more."""
    before = read_index(copied)
    with closing(sqlite3.connect(copied / INDEX)) as killed, killed:
        killed.execute("UPDATE recordings SET whole = 0")
    (copied / NAMES[0]).write_bytes(b"RRF2 no more")
    IndexWriter(copied, ALL).close()
    left = [replace(one, whole=False) for one in before]
    assert read_index(copied) == [replace(left[0], size_bytes=12), left[1]]
    assert [(one.classes, one.whole) for one in look(copied)] == [(one.classes, True) for one in before]


@pytest.mark.parametrize("how", ["never opened", "fails later"])
def test_an_index_that_fails_is_not_asked_to_read_on(copied, monkeypatch, how):
    """A ground woke 20 times a second for as long as its disk was away."""
    failures = Failures(time.time_ns)

    def fail(path: Path | None = None) -> None:
        for one in copied.glob(f"{INDEX}*"):
            one.unlink()
        (copied / INDEX).mkdir()
        if path is not None:
            raise sqlite3.OperationalError("the disk is away")

    monkeypatch.setattr(folder, "described", fail)
    if how == "never opened":
        fail()
    else:
        (copied / INDEX).unlink()
    with RecordingsFolder(copied, ALL, failures=failures) as index:
        index.begin()
        eventually(lambda: failures.parts, what="it is said")
        assert index._pause_s() >= 60  # noqa: SLF001 - how often it would wake


def test_by_age_and_by_bytes(copied, caplog):
    """The disk is full after a month."""
    day = Retention((Limit(seconds=86_400),))
    assert len(look(copied, day, later_s=80_000)) == 2
    first, second = read_index(copied)
    least = Retention((Limit(size_bytes=second.size_bytes),))
    assert [one.file for one in look(copied, least)] == [second.file]
    assert not (copied / first.file).exists()
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        assert look(copied, day, later_s=90_000) == []
    assert caplog.messages == [f"recording {second.file} is removed: it is older than --keep allows"]
    assert list(copied.glob("*.rrd")) == []


CLOCKS = Retention((Limit(seconds=90 * 86_400.0),), Limit(seconds=14 * 86_400.0))
YEAR_S = 365 * 86_400.0


@pytest.mark.parametrize("set_by_s", [100 * 86_400.0, 2 * YEAR_S, 56 * YEAR_S, -2 * YEAR_S])
def test_a_clock_that_is_set_removes_nothing(copied, set_by_s):
    """NTP comes after the flight, or the clock is years ahead: the flight of a minute ago would be gone."""
    for step_s in (set_by_s, 0.0, set_by_s):  # in flight, and at the next starts
        rows = look(copied, CLOCKS, set_by_s=step_s, later_s=60, times=3)
        assert [(one.file, one.video) for one in rows] == [(name, True) for name in NAMES]
        rows = look(copied, CLOCKS, set_by_s=step_s, later_s=7200, times=3)
        assert [(one.file, one.video) for one in rows] == [(name, True) for name in NAMES]


@pytest.mark.parametrize("ahead_s", [2 * YEAR_S, -56 * YEAR_S])
def test_a_clock_that_is_wrong_after_a_boot_removes_nothing(copied, ahead_s):
    """The clock of a machine without a battery says anything: nobody knows how long it was off."""
    clock: dict[str, Any] = {
        "now_ns": lambda: time.time_ns() + round(ahead_s * 1e9),
        "since_boot": lambda: ("the next", since_boot_ns()),
    }
    with closing(IndexWriter(copied, CLOCKS, **clock)) as writer:
        for _ in range(3):
            writer.log(None)
    assert [(one.file, one.video) for one in read_index(copied)] == [(name, True) for name in NAMES]


def test_files_that_no_look_has_seen_before_are_not_old(copied):
    """A copied folder, or a lost index: their times are those of the copy, or of a clock that nobody knows."""
    (copied / INDEX).unlink()
    for one in NAMES:
        os.utime(copied / one, (0, 0))
        (copied / one).rename(copied / one.replace(STEM, "hvt-uav-1-20200202-020202"))
    week = Retention((Limit(seconds=7 * 86_400.0),))
    assert len(look(copied, week, times=3)) == 2
    assert len(look(copied, week, later_s=8 * 86_400)) == 1


def test_by_bytes_the_newest_stays_whatever_the_clock_says(tmp_path, events):
    """The flight in the air has the oldest date where the clock was set back: it would make room for the others."""
    row = RecordingRow("", "uav-1", "00ff", None, None, 0, 100, 1, 0, whole=True)
    limit = Retention((Limit(size_bytes=200),))
    clock_ns = [time.time_ns()]
    since_boot = [("first", 0)]
    files = [f"hvt-uav-1-20261122-13000{number}.rrd" for number in range(3)]
    with closing(
        IndexWriter(tmp_path, limit, now_ns=lambda: clock_ns[0], since_boot=lambda: since_boot[0])
    ) as writer:
        for file, days, boot in zip(files, (0, -1000, 500), ("first", "first", "second"), strict=True):
            clock_ns[0] = time.time_ns() + round(days * 86_400e9)
            since_boot[0] = (boot, since_boot_ns())
            (tmp_path / file).touch()
            writer.log(replace(row, file=file))
    assert [one.file for one in read_index(tmp_path)] == files[1:]


def test_what_somebody_removed_does_not_count(copied):
    """Another would be removed to make room that is there."""
    rows = read_index(copied)
    both = Retention((Limit(size_bytes=sum(one.size_bytes for one in rows)),))
    third = f"{STEM}-0003.rrd"
    with closing(IndexWriter(copied, both)) as writer:
        (copied / NAMES[1]).rename(copied / third)
        writer.log(replace(rows[1], file=third))
    assert [one.file for one in read_index(copied)] == [NAMES[0], third]
    assert sorted(one.name for one in copied.glob("*.rrd")) == [NAMES[0], third]


def test_only_files_of_ours_in_the_folder_are_removed(copied):
    """What somebody put there, or a link to elsewhere, would be gone."""
    other = copied.parent / "other.rrd"
    kept = [copied / "mine.rrd", copied / "notes.txt", other, copied / "hvt-a.rrd"]
    for one in kept:
        one.write_bytes((copied / NAMES[0]).read_bytes())
    link = copied / "hvt-uav-1-20200101-000000.rrd"
    link.symlink_to(other)
    with closing(sqlite3.connect(copied / INDEX)) as forged, forged:
        forged.execute(
            "INSERT INTO recordings SELECT '../other.rrd', edge, session, 0, 0, written_ns, 1, 1, 1, 0, 1, 1 "
            "FROM recordings LIMIT 1"
        )
        forged.execute("UPDATE recordings SET written_ns = 1600000000000000000")
    look(copied, Retention((Limit(seconds=1.0),)), later_s=100, times=3)
    assert [one.name for one in kept if not one.exists()] == []
    assert link.is_symlink()
    assert sorted(one.name for one in copied.glob("*-0*.rrd")) == [link.name]


def test_a_file_in_flight_is_never_removed(tmp_path, events):
    """The flight in the air would be lost: not even where another ground writes it."""
    with flying(tmp_path) as (sink, _):
        log(sink, events, close=False)
        eventually(lambda: len(read_index(tmp_path)) == 2, what="the index knows both")
        least = Retention((Limit(seconds=1.0), Limit(size_bytes=1)), Limit(seconds=1.0))
        assert [one.file for one in look(tmp_path, least, later_s=1e6)] == NAMES[1:]
        sink.close()
    assert [frame for frame, *_ in Recording(tmp_path / NAMES[1]).video()] == list(range(30, 60))
    assert look(tmp_path, least, later_s=1e6) == []


def test_video_is_removed_and_the_rest_stays(tmp_path, events):
    """Who wants to know in a year what flew there would have to keep all pictures for it."""
    fly(tmp_path, events)
    before = Recording(tmp_path / NAMES[0])
    rows = look(tmp_path, Retention(video_age=Limit(seconds=86_400)), later_s=90_000, times=2)
    assert [one.video for one in rows] == [False, False]
    after = Recording(tmp_path / NAMES[0])
    assert after.video() == []
    assert after.events() == before.events()
    assert after.stills() == before.stills()
    assert after.boxes(20) == before.boxes(20)
    assert after.blueprints == 1
    subprocess.run([viewer_program(), "rrd", "verify", tmp_path / NAMES[0]], check=True, capture_output=True)
    assert list(tmp_path.glob("*.part")) == []
    assert [one.size_bytes for one in rows] == [(tmp_path / one).stat().st_size for one in NAMES]
    (tmp_path / INDEX).unlink()
    assert [one.video for one in look(tmp_path)] == [False, False]


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2 - 37], ends_its_reader])
def test_a_damaged_file_is_stripped_and_smaller_without_its_video(copied, damage):
    """Rerun's own program refuses it: each minute it was tried again.

    The footer, a row for each chunk, takes more than the pictures of a file that was cut short by a power cut.
    """
    path = copied / NAMES[0]
    path.write_bytes(damage(path.read_bytes()))
    before = path.stat().st_size
    first, second = look(copied, Retention(video_age=Limit(seconds=86_400)), later_s=90_000, times=2)
    assert (first.video, second.video, first.size_bytes < before) == (False, False, True)
    assert first.size_bytes == path.stat().st_size
    assert Recording(path).video() == []
    assert Recording(path).blueprints == 1
    assert Recording(path).boxes(20)


def test_a_file_that_ends_the_process_of_its_reader_ends_no_ground(copied):
    """On some damage the SDK does not raise: the ground was gone, at each start."""
    path = copied / NAMES[0]
    path.write_bytes(ends_its_reader(path.read_bytes()))
    before, _ = read_index(copied)
    (copied / INDEX).unlink()
    script = f"""
from pathlib import Path
from hvt_archive.index.folder import IndexWriter
from hvt_archive.index.retention import Retention
writer = IndexWriter(Path({str(copied)!r}), Retention())
while writer.unread:
    writer.log(None)
writer.close()
"""
    subprocess.run([sys.executable, "-c", script], check=True)
    after, _ = read_index(copied)
    assert (after.frames, after.begin_ns, after.end_ns) == (before.frames, before.begin_ns, before.end_ns)


def test_a_file_that_cannot_be_stripped_holds_up_no_other(tmp_path, events, caplog, monkeypatch):
    """One bad file, and nothing is removed any more; or seconds of processor went into it each minute."""
    tried = []
    monkeypatch.setattr(folder, "remove_video", lambda path: (tried.append(path.name), remove_video(path)))
    fly(tmp_path, events)
    (tmp_path / NAMES[0]).write_bytes(b"RRF2 no more")
    rows = look(tmp_path, Retention(video_age=Limit(seconds=60.0)), later_s=1000, times=4)
    assert [one.video for one in rows] == [True, False]
    assert sorted(tried) == sorted(NAMES)
    assert len([one for one in caplog.messages if "cannot be stripped" in one]) == 1
    assert (tmp_path / NAMES[0]).read_bytes() == b"RRF2 no more"


GROUND = """
from hvt_common.runtime.failures import Failures
from hvt_common.units import Limit
from hvt_archive.index.folder import RecordingsFolder
from hvt_archive.index.retention import Retention
from hvt_ground.recordings.session_files import SessionFiles
index = RecordingsFolder(settings.path.parent, Retention(), failures=Failures(time.time_ns))
index.begin()
sink = SessionFiles(settings, split=Limit(seconds=2.0), tell=index.recorded)
"""


@pytest.mark.parametrize("at", [2, 30, *(pytest.param(at, marks=pytest.mark.nightly) for at in (29, 31, 45))])
def test_a_killed_ground_leaves_an_index_that_goes_on(tmp_path, events, at):
    """A power cut, and the index has to be mended by hand or tells less than there is."""
    folder = tmp_path / "flights"
    folder.mkdir()
    rrd.killed(GROUND, settings(folder), events, feed=tmp_path / "feed", at=at)
    rows = look(folder)
    assert [one.file for one in rows] == sorted(one.name for one in folder.glob("*.rrd"))
    assert all(one.whole for one in rows)
    frames = [frame for one in rows for frame, *_ in Recording(folder / one.file).video()]
    assert frames[: at + 1] == list(range(at + 1))
    assert sum(one.frames for one in rows) == len(frames)
    assert [one.size_bytes for one in rows] == [(folder / one.file).stat().st_size for one in rows]
    with closing(sqlite3.connect(folder / INDEX)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_a_ground_killed_while_it_removes_video_leaves_no_half_file(copied):
    """Half a copy would stand in the place of the flight, or lie there for ever."""
    half, empty, other = (copied / one for one in (f"{NAMES[0]}.part", f"{STEM}-0003.rrd", "mine.rrd.part"))
    half.write_bytes((copied / NAMES[0]).read_bytes()[:5000])  # as a kill in the middle leaves it
    empty.touch()
    other.write_text("mine")
    assert [one.file for one in look(copied)] == NAMES
    assert [one.exists() for one in (half, empty, other)] == [False, False, True]
