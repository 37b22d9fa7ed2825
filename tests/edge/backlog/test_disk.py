"""What the edge keeps while its link is away: real files, real access units, kills and full disks."""

import contextlib
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import textwrap
import threading
from dataclasses import replace
from pathlib import Path

import av
import pytest

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info, RoiHeader, parse_backlog_still, parse_backlog_units
from hvt_edge.app import Edge
from hvt_edge.backlog.disk import FILE_NAME, Store
from hvt_edge.config import EdgeConfig, check
from hvt_edge.wiring.storing import check_store, default_folder
from media.clips import START_NS
from rigs.kept import INFO, UNITS, S, add_stills, add_units, opened, packed_still, shifted

TESTS = Path(__file__).resolve().parents[3] / "tests" / "support"


def numbers(entries) -> list[int]:
    return [entry.number for entry in entries]


def read_units(folder):
    objects = [folder.read(entry) for entry in reversed(list(folder.newest_segments()))]
    return [unit for data in objects if data is not None for unit in parse_backlog_units(data)]


def units_of(folder) -> list[bytes]:
    return [one.data for one in read_units(folder)]


def change(path: Path, statement: str) -> None:
    with contextlib.closing(sqlite3.connect(path / FILE_NAME)) as db, db:
        db.execute(statement)


@pytest.mark.parametrize("units", [UNITS, UNITS[20:27]], ids=["whole", "without a keyframe"])
def test_a_segment_gives_back_every_byte(folder, units):
    """The hole in the ground's recording would be filled with something else, or frames be missing."""
    add_units(folder, units)
    assert [(one.frame_index, one.capture_ns, one.keyframe, one.data) for one in read_units(folder)] == [
        (one.frame_index, one.capture_ns, one.keyframe, one.data) for one in units
    ]


def test_any_player_shows_what_the_manual_takes_out_of_it(tmp_path):
    """Whoever has the disk in hand could not look at what is on it."""
    with opened(tmp_path) as folder:
        add_units(folder, UNITS)
    page = Path(__file__).parents[3] / "docs" / "backlog.md"
    (command,) = [line.strip() for line in page.read_text().splitlines() if "-c 'import sqlite3" in line]
    subprocess.run(["sh", "-c", command.replace("python3", sys.executable)], cwd=tmp_path, check=True)
    with av.open(str(tmp_path / "backlog.h265")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 60


def test_a_damaged_frame_ends_its_segment_and_costs_no_other(tmp_path):
    """Garbage would be shown as what the camera saw."""
    with opened(tmp_path) as folder:
        add_units(folder, UNITS)
        add_units(folder, [shifted(unit, 10) for unit in UNITS])
    change(tmp_path, "UPDATE part SET data = zeroblob(100) WHERE frame_index = 30")
    change(tmp_path, "UPDATE part SET data = 'text' WHERE frame_index = 150")
    with opened(tmp_path) as folder:
        assert units_of(folder) == [one.data for one in UNITS[:30]]
        assert (folder.segments, folder.damaged) == (1, 1), "the second has no whole frame at all"


@pytest.mark.parametrize("damage", ["no database", "a page of zeros", "tables of another version"])
def test_a_damaged_file_is_put_aside_and_another_begun(tmp_path, caplog, damage):
    """One bad sector would be the end of storing, at this start and every later one."""
    file = tmp_path / FILE_NAME
    with opened(tmp_path) as folder:
        add_units(folder, UNITS)
    whole = file.read_bytes()
    if damage == "tables of another version":
        change(tmp_path, "ALTER TABLE part DROP COLUMN crc")
    else:
        file.write_bytes(b"x" * 9000 if damage == "no database" else whole[:4096] + bytes(len(whole) - 4096))
    with pytest.raises(OSError, match=r"malformed|not a database|no such column"), opened(tmp_path) as folder:
        add_units(folder, [*read_units(folder), *UNITS])
    assert "is damaged and is put aside" in caplog.text
    assert file.with_suffix(".damaged").exists()
    with opened(tmp_path) as folder:
        add_units(folder, UNITS)
        assert len(read_units(folder)) == 60


def test_segments_begin_with_keyframes_and_are_bounded(folder):
    """Nothing could be evicted or sent but all of it."""
    add_units(folder, UNITS[3:15] + UNITS[15:] + [shifted(unit, 20) for unit in UNITS[:20]])
    firsts = sorted(numbers(folder.newest_segments()))
    assert firsts == [3, 15, 300], "a keyframe after less than five seconds stays in its segment"
    assert folder.span_ns == pytest.approx((11 + 44 + 19) / 15 * S, abs=3)
    assert len(read_units(folder)) == 57 + 20


def test_nothing_is_made_before_something_is_kept(tmp_path):
    """Every demo would leave a folder in somebody's home."""
    path = tmp_path / "deep" / "store"
    with opened(path) as folder:
        assert not path.exists()
        assert (folder.stills, folder.segments, folder.disk_bytes) == (0, 0, 0)
    assert not path.exists()


def test_what_was_kept_is_there_after_a_restart(tmp_path):
    """An edge that is started again in an outage would forget what it saw."""
    with opened(tmp_path) as folder:
        add_stills(folder, {2**31: 0.5, 2**31 + 1: 2.0, 4: -1.0, 5: 0.0, 6: float("inf")})
        add_units(folder, UNITS)
        before = folder.disk_bytes
    with opened(tmp_path, session_id=8) as folder:
        assert numbers(folder.best_stills()) == [6, 2**31 + 1, 2**31, 5, 4]
        assert units_of(folder) == [one.data for one in UNITS]
        assert folder.disk_bytes == before
        info = folder.info_of(7)
        assert Info.parse(folder.read(info)) == INFO
        still = parse_backlog_still(folder.read(next(folder.best_stills())))
        assert RoiHeader.parse(still.attachment, still.payload).sequence == 6
        for entry in [*folder.best_stills(), *folder.newest_segments()]:
            folder.remove(entry)
        assert folder.info_of(7) is None, "the session of before leaves nothing"
    assert (tmp_path / FILE_NAME).stat().st_size < 50_000


def test_nobody_else_may_read_what_is_stored(tmp_path):
    """Every user of the drone's computer could look at what its camera saw."""
    tmp_path.chmod(0o755)
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        modes = {one.name: one.stat().st_mode & 0o777 for one in tmp_path.iterdir()}
    assert modes == {FILE_NAME: 0o600, f"{FILE_NAME}-wal": 0o600}


def test_what_is_too_old_is_dropped_at_the_start(tmp_path, caplog):
    """Last week's flight would fill the link of today's."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0}, capture_ns=START_NS)
        add_units(folder, UNITS[:5])
    with opened(tmp_path, at_s=(100, 100)) as folder:
        add_stills(folder, {2: 1.0, 3: 0.5}, capture_ns=START_NS + 100 * S)
    with (
        caplog.at_level(logging.WARNING),
        opened(tmp_path, session_id=8, oldest_ns=START_NS + 50 * S, at_s=(110, 110)) as folder,
    ):
        assert numbers(folder.best_stills()) == [2, 3]
        assert folder.segments == 0
    (said,) = caplog.messages
    assert said.startswith("2 stills and stretches of video")
    assert "--store-age" in said
    assert "still 1 of session 0000000000000007" in said


def test_never_is_all_dropped_at_once(tmp_path, caplog):
    """Where the ages are wrong after all, a whole flight would be gone without a look."""
    with opened(tmp_path) as folder:
        for number in range(5):
            add_stills(folder, {number: 1.0}, capture_ns=START_NS + number * S)
    for session_id, left in ((8, {2, 3, 4}), (9, {3, 4}), (10, {4}), (11, {4})):
        at = {"oldest_ns": START_NS + 50 * S, "at_s": (100, 100)}
        with opened(tmp_path, session_id=session_id, **at) as folder:
            assert set(numbers(folder.best_stills())) == left
    assert len(caplog.messages) == 3


HOUR_S = 3600
YEAR_S = 365 * 86_400


@pytest.mark.parametrize("boot", ["a boot", "the next"])
@pytest.mark.parametrize("set_by_s", [2 * HOUR_S, 56 * YEAR_S, -2 * YEAR_S])
def test_a_clock_that_is_set_drops_nothing(tmp_path, caplog, set_by_s, boot):
    """NTP comes between two flights, or the drone has no clock: what was not sent would be gone without a look."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        add_units(folder, UNITS)
    for session_id in (8, 9):
        oldest_ns = max(0, START_NS + (set_by_s + 60 - HOUR_S) * S)
        at = {"oldest_ns": oldest_ns, "at_s": (set_by_s + 60, 60), "boot": boot}
        with opened(tmp_path, session_id=session_id, **at) as folder:
            assert (folder.stills, folder.segments) == (1, 1)
    assert caplog.messages == []


@pytest.mark.parametrize("ahead_s", [-YEAR_S, YEAR_S])
def test_the_oldest_goes_first_whatever_the_clocks_said(tmp_path, ahead_s):
    """A flight with a clock that was behind has the oldest dates: it would make room, and be sent last."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        add_units(folder, UNITS)
    with opened(tmp_path, session_id=8, at_s=(ahead_s + 60, 60)) as folder:
        add_stills(folder, {2: 1.0}, capture_ns=START_NS + (ahead_s + 60) * S)
        add_units(folder, [replace(shifted(one, ahead_s + 60), frame_index=one.frame_index) for one in UNITS])
    with opened(tmp_path, session_id=9, at_s=(300, 300)) as folder:
        assert [one.session_id for one in folder.newest_segments()] == [8, 7]
        assert numbers(folder.best_stills()) == [2, 1]


def test_corrupt_entries_are_skipped_with_few_warnings(tmp_path, caplog):
    """One bad sector would stop everything else from coming back, or fill the log."""
    with opened(tmp_path) as folder:
        add_stills(folder, dict.fromkeys(range(4), 1.0))
    change(
        tmp_path,
        "UPDATE part SET data = zeroblob(9) WHERE rowid IN (SELECT rowid FROM part LIMIT 3 OFFSET 1)",
    )
    with opened(tmp_path) as folder, caplog.at_level(logging.WARNING):
        kinds = [folder.read(entry) is not None for entry in list(folder.best_stills())]
        assert sorted(kinds) == [False, False, False, True]
        assert (folder.stills, folder.damaged) == (1, 3)
    assert len(caplog.records) == 2, "the first, the second, then the fourth …"


def test_the_store_is_bounded_and_the_least_useful_goes_first(tmp_path):
    """The disk of the drone would fill; or the best still would go for one more second of road."""
    with opened(tmp_path, max_bytes=2_000_000) as folder:
        add_stills(folder, {number: float(number) for number in range(50)})
        for part in range(30):
            add_units(folder, [shifted(unit, 10 * part) for unit in UNITS])
        assert folder.disk_bytes <= 2_000_000
        assert folder.evicted_segments > 10
        assert folder.evicted_stills == 0, "video takes three quarters at the most where there are stills"
        assert max(numbers(folder.newest_segments())) == 29 * 150
        assert min(numbers(folder.newest_segments())) > 1000, "the oldest went"
        add_stills(folder, {number: float(number) for number in range(50, 1500)})
        assert folder.disk_bytes <= 2_000_000
        kept = numbers(folder.best_stills())
        assert folder.evicted_stills > 0
        assert kept == list(range(1499, 1499 - len(kept), -1)), "those with the least utility went"
        on_disk = sum(512 * one.stat().st_blocks for one in tmp_path.rglob("*") if one.is_file())
        assert on_disk <= 2_000_000, "with its log"


def test_a_still_loses_worth_with_age(folder):
    """An hour-old still of some car would come before the one of a minute ago."""
    add_stills(folder, {1: 4.0})
    add_stills(folder, {2: 1.0}, capture_ns=START_NS + 600 * S)
    assert numbers(folder.best_stills()) == [1, 2]
    add_stills(folder, {3: 1.0}, capture_ns=START_NS + 1300 * S)
    assert numbers(folder.best_stills()) == [3, 1, 2]


def test_two_edges_do_not_share_a_folder(tmp_path):
    """Each would send and delete what the other has on its way."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        second = Store(tmp_path, max_bytes=10**7, session_id=8, info=INFO.pack)
        for what in (second.enter, lambda: add_stills(second, {2: 1.0})):
            with pytest.raises(BlockingIOError, match="another edge"):
                what()
        assert second.stills == 0
    second.enter()
    assert numbers(second.best_stills()) == [1]
    second.close()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_refused_at_the_start(tmp_path):
    """It would be noticed in the first outage."""
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    with pytest.raises(UserError, match="cannot be used"):
        check_store(EdgeConfig(source="demo", store_folder=locked / "store"), live=False)


def test_a_folder_that_cannot_be_made_is_refused_at_the_start(tmp_path, monkeypatch):
    """It would be noticed in the first outage; or somebody without a home would see a traceback."""
    (tmp_path / "file").write_text("in the way")
    for path in (tmp_path / "file", tmp_path / "file" / "store"):
        with pytest.raises(UserError, match=r"--store-folder .* cannot be used"):
            check_store(EdgeConfig(source="demo", store_folder=path), live=False)
    for path in (tmp_path / "deep" / "store", tmp_path):
        check_store(EdgeConfig(source="demo", store_folder=path), live=False)
    assert [one.name for one in tmp_path.iterdir()] == ["file"], "nothing is made"

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    config = check(EdgeConfig(source="demo", store_folder=tmp_path / "file", listen=("tcp/127.0.0.1:7447",)))
    with pytest.raises(UserError, match="--store-folder"):
        Edge(config, stop=threading.Event()).run()
    monkeypatch.setenv("XDG_STATE_HOME", "")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(UserError, match="no home folder"):
        check_store(EdgeConfig(source="/dev/video0"), live=True)
    check_store(EdgeConfig(source="demo"), live=False)


def test_the_default_folder_is_where_programs_keep_their_state(monkeypatch, tmp_path):
    """It would be written beside whatever the edge was started from."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_folder("uav-1") == tmp_path / "hvt" / "uav-1"
    monkeypatch.setenv("XDG_STATE_HOME", "")
    assert default_folder("uav-1") == Path.home() / ".local" / "state" / "hvt" / "uav-1"


_WRITER = """
import sys
sys.path[:0] = [{tests!r}]
import time
from pathlib import Path
from rigs.kept import *
folder = opened(Path({path!r}))
units = coded(150)
said = 0
for unit in units:
    folder.add_unit(unit)
    if unit.frame_index % 3 == 0:
        add_stills(folder, {{unit.frame_index: 1.0}})
    sys.stdout.write(f"{{unit.frame_index}}\\n")
    sys.stdout.flush()
    time.sleep(1 / 150)
time.sleep(60)
"""


@pytest.mark.parametrize("after", [1, pytest.param(40, marks=pytest.mark.nightly), 120])
def test_after_a_kill_all_but_the_last_moment_is_there(tmp_path, after):
    """A crash is when one wants to know what was seen."""
    program = textwrap.dedent(_WRITER).format(tests=str(TESTS), path=str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        for line in process.stdout:
            if int(line) >= after:
                break
        os.kill(process.pid, signal.SIGKILL)
        last = max([after, *(int(line) for line in process.stdout if line.endswith(b"\n"))])
    with opened(tmp_path, session_id=8) as folder:
        assert set(numbers(folder.best_stills())) >= set(range(0, last + 1, 3))
        assert all(folder.read(entry) for entry in list(folder.best_stills()))
        frames = [one.frame_index for one in read_units(folder)]
        assert frames == list(range(len(frames))), "no hole, nothing twice"
        assert len(frames) >= last + 1, "each is whole at once"
        assert folder.damaged == 0
        assert Info.parse(folder.read(folder.info_of(7))).class_names == INFO.class_names


def test_a_full_disk_is_an_error_at_once_and_leaves_what_fits_readable(small_disk):
    """Frames would seem to be stored and not be."""
    with opened(small_disk) as folder:
        add_stills(folder, {1: 1.0})
        flight = [shifted(unit, 10 * part) for part in range(50) for unit in UNITS]
        with pytest.raises(OSError, match="no space is left"):
            add_units(folder, flight)
        with pytest.raises(OSError, match="no space is left"):
            folder.add_still(2, packed_still(2, data=b"\xff" * 60_000), utility=1.0, capture_ns=START_NS)
        with contextlib.suppress(OSError):  # a few bytes, for which there may be room
            folder.end_segment()
        frames = [one.frame_index for one in read_units(folder)]
        assert len(frames) > 60
        assert frames == sorted(set(frames))
        assert numbers(folder.best_stills()) == [1]
        (still,) = folder.best_stills()
        folder.remove(still)
        assert not list(folder.best_stills()), "what has arrived is not sent again"


def test_a_full_disk_evicts_nothing_in_vain(small_disk):
    """Where deleting takes space too, a smaller --store would cost all that is stored, and free nothing."""
    (small_disk / "filler").unlink()
    with opened(small_disk, max_bytes=1_000_000) as folder:
        for part in range(3):
            add_units(folder, [shifted(unit, 10 * part) for unit in UNITS])
        stored = numbers(folder.newest_segments())
    with contextlib.suppress(OSError), (small_disk / "junk").open("wb", buffering=0) as junk:
        while junk.write(bytes(4096)):
            pass
    folder = Store(small_disk, max_bytes=720_000, session_id=8, info=INFO.pack)
    with pytest.raises(OSError, match="no space is left"):
        folder.enter()
    assert numbers(folder.newest_segments()) == stored
    assert folder.segments == len(stored)
    (small_disk / "junk").unlink()
    folder.trial()
    folder.enter()
    add_stills(folder, {1: 1.0})
    assert numbers(folder.newest_segments()) == stored[:1]
    folder.close()
