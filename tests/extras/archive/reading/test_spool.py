"""A recording that is read back: as long as it may be, what is in memory stays small."""

import errno
import gc
import os
import tempfile
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvt_archive.reading.recorded import read_recordings
from hvt_archive.reading.spool import Mapped, Spool, SpooledRows
from hvt_archive.replay.command import messages_of
from hvt_common.errors import UserError
from hvt_ground.events import VideoSample
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from media.recorded_feed import START_NS, STEP_NS, coded, drawn_frames


def test_rows_come_back_in_order_of_frames() -> None:
    """Boxes would stand at other frames than they were drawn at."""
    spool = Spool()
    rows, more = (SpooledRows(spool, blobs=False) for _ in range(2))
    for frame in (3, 1, 1, 2):
        rows.add(frame, 10 * frame, [frame, len(rows)])
    more.add(0, 5, [])
    rows.extend(more)
    rows.sort()
    assert list(rows) == [(0, 5, []), (1, 10, [1, 1]), (1, 10, [1, 2]), (2, 20, [2, 3]), (3, 30, [3, 0])]
    assert [rows.latest(frame) for frame in (-1, 0, 1, 9)] == [-1, 0, 2, 4]
    rows.sort(unique=True)
    assert [row[2] for row in rows] == [[], [1, 2], [2, 3], [3, 0]], "of one frame the last"
    rows.keep(lambda place: rows.frames[place] != 2)
    assert list(rows.begun(7, 70, [], then=rows).frames) == [7, 0, 1, 3]
    frames = Mapped(rows, lambda row: row[0])
    assert (list(frames), list(frames[1:]), frames[1:][0], len(frames[5:])) == ([0, 1, 3], [1, 3], 1, 0)


def test_the_video_of_a_flight_does_not_come_into_memory(tmp_path: Path) -> None:
    """An hour took 800 MB, and a day's flight could not be exported or replayed on the machine that had it."""
    path = tmp_path / "flight.rrd"
    unit = coded(drawn_frames(1), kbps=300, keyint=1)[0][0]
    with Recorder(RecorderSettings(path, "uav-1", "00ff", (320, 192), 15.0, 4e5)) as recorder:
        for frame in range(400):
            data = unit + b"\0\0\1\x4e\1" + os.urandom(20_000).replace(b"\0", b"\1")
            recorder.log(VideoSample(frame, START_NS + frame * STEP_NS, data, keyframe=True))
    read_recordings([path])  # what is made once is no matter
    gc.collect()
    tracemalloc.start()
    recorded = read_recordings([path])
    assert sum(isinstance(one, VideoSample) for one in recorded.all()) == 400
    played = replace(recorded, info=SimpleNamespace(edge="uav-1", session_id=255, pack=lambda: b""))  # type: ignore[arg-type]
    assert sum(1 for _ in messages_of(played)) == 401
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(recorded.video) == 400
    assert recorded.video[399].data[-20_000:] != recorded.video[398].data[-20_000:]
    assert peak < 4_000_000, "8 MB of video, of which a chunk of the file is the most at once"


def test_a_full_folder_for_temporary_files_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording would be called none, and thrown away."""

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    spool = Spool()
    monkeypatch.setattr("hvt_archive.reading.spool.os.write", full)
    with pytest.raises(UserError, match="set TMPDIR to a folder with room"):
        spool.put(bytes(2**20))
    monkeypatch.undo()


def test_where_no_folder_takes_temporary_files_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a board whose disks are all mounted read-only an export ended in a traceback."""

    def refuses(*_: object) -> int:
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as here:
        here.setattr(tempfile, "tempdir", None)
        here.setattr("tempfile._os.open", refuses)
        with pytest.raises(UserError, match="which no folder takes: set TMPDIR to a folder with room"):
            Spool()
