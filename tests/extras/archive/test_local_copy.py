"""The Matroska file of the base stream."""

import os
import select
import shutil
import time
from contextlib import suppress
from pathlib import Path

import av
import numpy as np
import pytest

from hvt_archive.local_copy import LocalCopy, _MatroskaFile
from hvt_common.runtime.failures import Failures, RetryPause
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.clips import START_NS, framed, smooth_pictures
from programs.processes import eventually
from programs.small_disk import small_disk

SIZE = (320, 192)


def units(count: int, *, fps: float = 15.0) -> list[AccessUnit]:
    """Access units of an easy clip, a keyframe each ten."""
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=fps, bitrate_bps=200_000, preset="ultrafast"))
    frames = framed(smooth_pictures(count, size=SIZE), fps=fps)
    return [encoder.encode(frame, keyframe=frame.index % 10 == 0) for frame in frames]


def copied(path: Path, coded: list[AccessUnit]) -> None:
    """The copy of a run in which nothing fails."""
    with LocalCopy(path, failures=Failures(time.time_ns)) as recorder:
        for unit in coded:
            recorder.write(unit)


def played(path: Path) -> tuple[list[float], list[np.ndarray], list[bool]]:
    """(time in s, picture, keyframe) of all frames, by a player that knows nothing of HVT."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "hevc"
        frames = list(container.decode(stream))
    return (
        [float(frame.pts * frame.time_base) for frame in frames],
        [frame.to_ndarray(format="bgr24") for frame in frames],
        [frame.key_frame for frame in frames],
    )


def test_any_player_shows_every_frame_at_its_time(tmp_path):
    """The flight's only video on the drone could not be watched, not be entered at minute 40, or be another."""
    path, coded = tmp_path / "base.mkv", units(30)
    copied(path, coded)
    times, pictures, keyframes = played(path)
    np.testing.assert_allclose(times, [(unit.capture_ns - START_NS) / 1e9 for unit in coded], atol=0.001)
    assert [index for index, one in enumerate(keyframes) if one] == [0, 10, 20]
    shown = pictures[20]
    assert (len(pictures), shown.shape) == (30, (192, 320, 3))
    red = np.argwhere((shown[..., 2] > 170) & (shown[..., 0] < 100) & (shown[..., 1] < 120))
    assert abs(red[:, 1].min() - 140) <= 4, "the square is where frame 20 had it"
    assert path.stat().st_size < sum(len(unit.data) for unit in coded) + 3_000
    with av.open(str(path)) as container:
        sizes = [packet.size for packet in container.demux(video=0) if packet.size]
        container.seek(1_400_000)  # of 2 s; the keyframes are at 0, 0.67 and 1.33 s
        first = next(container.decode(video=0))
    assert float(first.pts * first.time_base) == pytest.approx(20 / 15, abs=0.002)
    # Start codes become lengths, byte for byte as long or one longer.
    off = [abs(size - len(unit.data)) for size, unit in zip(sizes, coded, strict=True)]
    assert max(off) <= 8


def test_dropped_frames_and_equal_times_do_not_spoil_the_file(tmp_path):
    """A busy drone's record would end at the first dropped frame, or at two frames in one millisecond."""
    path = tmp_path / "base.mkv"
    coded = [
        AccessUnit(number, START_NS + 300_000 * number, unit.data, unit.keyframe)
        for number, unit in zip([0, 1, 2, 3, 60, 61, 62, 63, 64, 65], units(10), strict=True)
    ]
    copied(path, coded)
    times, pictures, _ = played(path)
    assert (len(pictures), times) == (10, sorted(set(times)))
    copied(tmp_path / "none.mkv", [])  # Ctrl-C before the first frame is no error


def test_a_second_run_overwrites_nothing(tmp_path, caplog):
    """A supervisor that starts the edge again would delete the video of the crash."""
    path = tmp_path / "base.mkv"
    for _ in range(3):
        copied(path, units(3))
    files = sorted(tmp_path.iterdir())
    assert [(file.name, len(played(file)[1])) for file in files] == [
        (name, 3) for name in ("base-2.mkv", "base-3.mkv", "base.mkv")
    ]
    assert caplog.messages == [
        f"--record-base {path} is there already: this is {path.with_name(name)}"
        for name in ("base-2.mkv", "base-3.mkv")
    ]


def goes_on(recorder: LocalCopy, failures: Failures, coded: list[AccessUnit], *, tries: int = 0) -> None:
    """Until it works again, or was tried in vain so often."""

    def written() -> bool:
        for unit in coded:
            recorder.write(unit)
        return failures.parts[0].count >= tries if tries else failures.parts[0].working

    eventually(written, what="it is tried again" if tries else "the copy goes on")


def test_a_full_card_stops_the_copy_alone_and_it_goes_on_in_a_new_file(tmp_path, caplog):
    """The flight's video would end with the card's last byte; or never be kept again after files were moved off."""
    failures = Failures(time.time_ns)
    coded = units(60)
    with small_disk(tmp_path / "card") as card:
        (card / "old.bin").write_bytes(bytes(1_020_000))
        with LocalCopy(card / "base.mkv", failures=failures, pause=RetryPause(SECOND_NS // 10)) as recorder:
            for unit in coded:
                recorder.write(unit)
            eventually(lambda: failures.parts, what="the card is full")
            (failed,) = failures.parts
            assert (failed.part, failed.working) == ("local copy", False)
            assert "No space left" in failed.reason
            goes_on(recorder, failures, coded, tries=3)
            assert "is there already" not in caplog.text, "each try said so of a file that took nothing"
            (card / "old.bin").unlink()
            goes_on(recorder, failures, coded)
        files = sorted(card.glob("*.mkv"))
        assert len(played(files[0])[1]) >= 10, "what follows the pause begins with a keyframe, and plays"
    assert len([one for one in caplog.records if "cannot be written" in one.message]) == 1


def test_a_folder_that_is_removed_stops_the_copy_alone(tmp_path):
    """Hours of video would be written into a file that has no name any more."""
    failures, folder = Failures(time.time_ns), tmp_path / "card"
    folder.mkdir()
    coded = units(20)
    with LocalCopy(folder / "base.mkv", failures=failures, pause=RetryPause(SECOND_NS // 10)) as recorder:
        recorder.write(coded[0])
        eventually((folder / "base.mkv").exists, what="the file is there")
        shutil.rmtree(folder)
        for unit in coded[1:]:
            recorder.write(unit)
        eventually(lambda: failures.parts, what="the loss is noticed")
        folder.mkdir()
        goes_on(recorder, failures, coded)
    assert len(played(folder / "base.mkv")[1]) >= 10


def test_a_card_that_hangs_costs_no_frame(tmp_path):
    """The picture would freeze for as long as the card does: here a pipe that nobody reads."""
    pipe, failures = tmp_path / "pipe.mkv", Failures(time.time_ns)
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    coded = units(40)
    recorder = LocalCopy(pipe, failures=failures, pause=RetryPause(1000 * SECOND_NS))
    recorder.write(coded[0])
    eventually(lambda: bool(select.select([reader], [], [], 0)[0]))
    for _ in range(40):
        for unit in coded:
            recorder.write(unit)  # one that waited would wait for ever
    assert "takes no more" in failures.parts[0].reason
    os.close(reader)  # which ends the write that hangs
    recorder.close()


def test_a_pipe_that_takes_nothing_is_not_removed(tmp_path):
    """As root the edge removed /dev/full, and every program after it filled a file of that name."""
    pipe = tmp_path / "pipe.mkv"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    file = _MatroskaFile(pipe, pipe.open("wb", buffering=0))
    os.close(reader)
    file.give_up()
    assert pipe.is_fifo()


def test_what_was_recorded_plays_before_the_file_is_closed(tmp_path):
    """The record of a crash would be missing just when it is wanted."""
    path = tmp_path / "base.mkv"

    def kept() -> int:
        with suppress(av.FFmpegError, OSError):  # the writing thread has not begun
            return len(played(path)[1])
        return 0

    with LocalCopy(path, failures=Failures(time.time_ns)) as recorder:
        for unit in units(45):
            recorder.write(unit)
        eventually(lambda: kept() >= 45 - 4, what="all but a fifth of a second is in the file")
