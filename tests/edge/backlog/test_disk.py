"""What the edge keeps while its link is away: real files, real access units, kills and full disks."""

from __future__ import annotations

import logging
import os
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import av
import pytest

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info, RoiHeader, parse_backlog_still, parse_backlog_units
from hvt_edge.app import Edge
from hvt_edge.backlog.disk import check_folder, default_folder
from hvt_edge.backlog.segment import DamagedError, SegmentWriter, index_of, read_segment
from hvt_edge.config import EdgeConfig, check
from media.clips import START_NS
from rigs.kept import INFO, UNITS, S, add_stills, add_units, opened, packed_still, shifted

TESTS = Path(__file__).resolve().parents[3] / "tests" / "support"


def numbers(entries) -> list[int]:
    """Of entries, in their order."""
    return [entry.number for entry in entries]


def read_units(folder):
    """All frames that are kept and can be read, in order of capture."""
    objects = [folder.read(entry) for entry in reversed(list(folder.newest_segments()))]
    return [unit for data in objects if data is not None for unit in parse_backlog_units(data)]


# Segments


def test_a_segment_gives_back_every_byte_and_any_player_shows_it(tmp_path):
    """The hole in the ground's recording would be filled with something else, at other times."""
    video = tmp_path / "base.mkv"
    writer = SegmentWriter(video, parameter_sets=UNITS[0].data)
    for unit in UNITS:
        writer.write(unit)
    writer.close()
    units = read_segment(video)
    assert [(one.frame_index, one.capture_ns, one.keyframe, one.data) for one in units] == [
        (one.frame_index, one.capture_ns, one.keyframe, one.data) for one in UNITS
    ]
    with av.open(str(video)) as container:
        pictures = list(container.decode(video=0))
    assert len(pictures) == 60
    assert float(pictures[-1].pts * pictures[-1].time_base) == pytest.approx(59 / 15, abs=0.002)


def test_a_damaged_frame_ends_its_segment_and_costs_no_other(tmp_path):
    """Garbage would be shown as what the camera saw."""
    video = tmp_path / "base.mkv"
    writer = SegmentWriter(video, parameter_sets=UNITS[0].data)
    for unit in UNITS:
        writer.write(unit)
    writer.close()
    whole = video.read_bytes()
    place = whole.index(UNITS[30].data[-40:])
    video.write_bytes(whole[:place] + b"\x55" + whole[place + 1 :])
    assert [one.data for one in read_segment(video)] == [one.data for one in UNITS[:30]]
    video.write_bytes(whole[: len(whole) // 2])
    cut = read_segment(video)
    assert 20 < len(cut) < 40
    assert [one.data for one in cut] == [one.data for one in UNITS[: len(cut)]]
    video.write_bytes(b"no video at all")
    with pytest.raises(DamagedError):
        read_segment(video)
    index_of(video).unlink()
    with pytest.raises(DamagedError):
        read_segment(video)


def test_a_run_without_a_keyframe_is_kept_too(tmp_path):
    """The frames that were on their way when the link broke would be missing."""
    with opened(tmp_path) as folder:
        add_units(folder, UNITS[20:27])
        assert [one.frame_index for one in read_units(folder)] == list(range(20, 27))
        assert [one.data for one in read_units(folder)] == [one.data for one in UNITS[20:27]]


def test_segments_begin_with_keyframes_and_are_bounded(tmp_path):
    """Nothing could be evicted or sent but all of it."""
    with opened(tmp_path) as folder:
        add_units(folder, UNITS[3:15] + UNITS[15:] + [shifted(unit, 20) for unit in UNITS[:20]])
        firsts = sorted(numbers(folder.newest_segments()))
        assert firsts == [3, 15, 300], "a keyframe after less than five seconds stays in its segment"
        assert folder.span_ns == pytest.approx((11 + 44 + 19) / 15 * S, abs=3)
        assert len(read_units(folder)) == 57 + 20


# The folder


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
        assert [one.data for one in read_units(folder)] == [one.data for one in UNITS]
        assert folder.disk_bytes == before
        info = folder.info_of(7)
        assert Info.parse(folder.read(info)) == INFO
        still = parse_backlog_still(folder.read(next(folder.best_stills())))
        assert RoiHeader.parse(still.attachment, still.payload).sequence == 6
        for entry in [*folder.best_stills(), *folder.newest_segments()]:
            folder.remove(entry)
        assert list(tmp_path.iterdir()) == [tmp_path / "lock"], "the session of before leaves nothing"


def test_what_is_too_old_is_dropped_at_the_start(tmp_path, caplog):
    """Last week's flight would fill the link of today's."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0}, capture_ns=START_NS)
        add_stills(folder, {2: 1.0}, capture_ns=START_NS + 100 * S)
        add_units(folder, UNITS[:5])
    with (
        caplog.at_level(logging.WARNING),
        opened(tmp_path, session_id=8, oldest_ns=START_NS + 50 * S) as folder,
    ):
        assert numbers(folder.best_stills()) == [2]
        assert folder.segments == 0
    (said,) = caplog.messages
    assert said.startswith("2 stills and stretches of video")
    assert "--store-age" in said
    assert sorted(one.name for one in (tmp_path / f"{7:016x}").iterdir()) == [
        "info",
        f"still-2-{START_NS + 100 * S}-1.still",
    ]


def test_half_written_files_are_dropped_and_other_peoples_are_not(tmp_path):
    """A kill would leave rubbish for ever; or a note that somebody put there would go."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        add_units(folder, UNITS[:5])
    session = tmp_path / f"{7:016x}"
    for name in (
        f"still-2-{START_NS}-1.still.part",
        f"base-9-{START_NS}.mkv",
        f"base-8-{START_NS}.index",
        f"still-3-{START_NS}-nan.still",
        "notes.txt",
    ):
        (session / name).write_bytes(b"x")
    with opened(tmp_path, session_id=8) as folder:
        assert (folder.stills, folder.segments) == (1, 1)
    assert sorted(one.suffix for one in session.iterdir()) == ["", ".index", ".mkv", ".still", ".txt"]


def test_corrupt_entries_are_skipped_with_one_warning(tmp_path, caplog):
    """One bad sector would stop everything else from coming back, or fill the log."""
    with opened(tmp_path) as folder:
        add_stills(folder, dict.fromkeys(range(4), 1.0))
        files = sorted((tmp_path / f"{7:016x}").glob("still-*"))
        files[0].write_bytes(b"")
        files[1].write_bytes(files[1].read_bytes()[:-100])
        flipped = bytearray(files[2].read_bytes())
        flipped[-100] ^= 1
        files[2].write_bytes(flipped)
        with caplog.at_level(logging.WARNING):
            kinds = [folder.read(entry) is not None for entry in list(folder.best_stills())]
        assert sorted(kinds) == [False, False, False, True]
        assert folder.stills == 1
        assert folder.damaged == 3
        assert len(caplog.records) == 2, "the first, the second, then the fourth …"


def test_the_store_is_bounded_and_the_least_useful_goes_first(tmp_path):
    """The disk of the drone would fill; or the best still would go for one more second of road."""
    with opened(tmp_path, max_bytes=1_000_000) as folder:
        add_stills(folder, {number: float(number) for number in range(50)})
        for part in range(30):
            add_units(folder, [shifted(unit, 10 * part) for unit in UNITS])
        assert folder.disk_bytes <= 1_000_000
        assert folder.evicted_segments > 10
        assert folder.evicted_stills == 0, "video takes three quarters at the most where there are stills"
        assert max(numbers(folder.newest_segments())) == 29 * 150
        assert min(numbers(folder.newest_segments())) > 1000, "the oldest went"
        add_stills(folder, {number: float(number) for number in range(50, 400)})
        assert folder.disk_bytes <= 1_000_000
        kept = numbers(folder.best_stills())
        assert folder.evicted_stills > 0
        assert kept == list(range(399, 399 - len(kept), -1)), "those with the least utility went"
    on_disk = sum(4096 * -(-one.stat().st_size // 4096) for one in tmp_path.rglob("*") if one.is_file())
    assert on_disk <= 1_000_000 + 4096


def test_a_still_loses_worth_with_age(tmp_path):
    """An hour-old still of some car would come before the one of a minute ago."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 4.0})
        add_stills(folder, {2: 1.0}, capture_ns=START_NS + 600 * S)
        assert numbers(folder.best_stills()) == [1, 2]
        add_stills(folder, {3: 1.0}, capture_ns=START_NS + 1300 * S)
        assert numbers(folder.best_stills()) == [3, 1, 2]


def test_two_edges_do_not_share_a_folder(tmp_path):
    """Each would delete the other's files as half written."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        second = opened(tmp_path, session_id=8)
        assert second.locked_out
        assert second.stills == 0
        with pytest.raises(OSError, match="another edge"):
            add_stills(second, {2: 1.0})
        second.close()
        assert len(list(tmp_path.rglob("*.still"))) == 1
    opened(tmp_path, session_id=8).close()


@pytest.mark.parametrize("keeps", [False, True])
def test_a_folder_that_a_dying_run_still_has_is_asked_for_again(tmp_path, caplog, keeps):
    """An edge that is restarted at once would keep nothing for the whole flight, and send nothing of the last one."""
    with opened(tmp_path) as dying:
        add_stills(dying, {1: 1.0})
        with caplog.at_level(logging.WARNING):
            folder = opened(tmp_path, session_id=8)
            folder.enter()
        assert caplog.text.count("another edge keeps its things there") == 1
    if keeps:
        add_stills(folder, {2: 0.5})
    else:
        folder.enter()
    assert numbers(folder.best_stills()) == ([1, 2] if keeps else [1])
    folder.close()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_is_refused_at_the_start(tmp_path):
    """It would be noticed in the first outage."""
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    with pytest.raises(UserError, match="cannot be used"):
        check_folder(locked / "store")


def test_a_folder_that_cannot_be_made_is_refused_at_the_start(tmp_path, monkeypatch):
    """It would be noticed in the first outage; or somebody without a home would see a traceback."""
    (tmp_path / "file").write_text("in the way")
    for path in (tmp_path / "file", tmp_path / "file" / "store"):
        with pytest.raises(UserError, match=r"--store-folder .* cannot be used"):
            check_folder(path)
    check_folder(tmp_path / "deep" / "store")
    check_folder(tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["file"], "nothing is made"

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    config = check(EdgeConfig(source="demo", store_folder=tmp_path / "file", listen=("tcp/127.0.0.1:0",)))
    with pytest.raises(UserError, match="--store-folder"):
        Edge(config, stop=threading.Event()).run()
    monkeypatch.setenv("XDG_STATE_HOME", "")
    monkeypatch.setattr(Path, "home", homeless)
    with pytest.raises(UserError, match="no home folder"):
        default_folder("uav-1")


def test_a_folder_that_vanishes_costs_what_was_in_it_and_nothing_else(tmp_path, caplog):
    """A stick that is pulled out would end the flight."""
    store = tmp_path / "store"
    with opened(store) as folder:
        for unit in UNITS[:5]:
            folder.add_unit(unit, parameter_sets=UNITS[0].data)
        shutil.rmtree(store)
        with caplog.at_level(logging.WARNING):
            folder.end_segment()
        assert (folder.segments, folder.open_segments, folder.damaged, folder.span_ns) == (0, 0, 1, 0)
        assert caplog.text.count("cannot read") == 1
        with pytest.raises(OSError, match=r"."):
            add_units(folder, UNITS[5:10])
    assert not store.exists()


def test_the_default_folder_is_where_programs_keep_their_state(monkeypatch, tmp_path):
    """It would be written beside whatever the edge was started from."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_folder("uav-1") == tmp_path / "hvt" / "uav-1"
    monkeypatch.setenv("XDG_STATE_HOME", "")
    assert default_folder("uav-1") == Path.home() / ".local" / "state" / "hvt" / "uav-1"


# Kills and full disks

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
    folder.add_unit(unit, parameter_sets=units[0].data)
    if unit.frame_index % 3 == 0:
        add_stills(folder, {{unit.frame_index: 1.0}})
    sys.stdout.write(f"{{unit.frame_index}}\\n")
    sys.stdout.flush()
    time.sleep(1 / 150)
time.sleep(60)
"""


@pytest.mark.parametrize("after", [1, 40, 120])
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
        assert len(frames) >= last + 1 - 0.3 * 15
        assert folder.damaged == (0 if frames else 1)
        assert Info.parse(folder.read(folder.info_of(7))).class_names == INFO.class_names


def test_a_full_disk_is_an_error_at_once_and_leaves_what_fits_readable(tmp_path):
    """Frames would seem to be kept and not be."""
    with opened(tmp_path) as folder:
        add_stills(folder, {1: 1.0})
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, before[1]))
        try:
            with pytest.raises(OSError, match=r"."):
                add_units(folder, UNITS)
            with pytest.raises(OSError, match=r"."):
                folder.add_still(2, packed_still(2, data=b"\xff" * 60_000), utility=1.0, capture_ns=START_NS)
            folder.end_segment()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        frames = [one.frame_index for one in read_units(folder)]
        assert 3 < len(frames) < 60
        assert frames == list(range(len(frames)))
        assert numbers(folder.best_stills()) == [1]
    assert not list(tmp_path.rglob("*.part"))


def test_a_folder_that_cannot_be_made_is_an_error_of_the_disk(tmp_path):
    """A traceback in mid-flight."""
    (tmp_path / "file").write_text("in the way")
    folder = opened(tmp_path / "file" / "store")
    with pytest.raises(OSError, match=r"."):
        add_stills(folder, {1: 1.0})
    folder.close()
