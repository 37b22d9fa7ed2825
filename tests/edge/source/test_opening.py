"""Every kind of source, on real files and real sockets."""

from __future__ import annotations

import errno
import fcntl
import io
import logging
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import av
import cv2
import numpy as np
import psutil
import pytest
from av.video.reformatter import Interpolation

from hvt_common.errors import NotYetError, UserError
from hvt_common.runtime.clock import SteadyClock
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.decoding import container
from hvt_edge.source.demo import DemoSource
from hvt_edge.source.folder import sequence_files
from hvt_edge.source.live import LiveSource
from hvt_edge.source.opening import open_source
from hvt_edge.source.stream import StreamGrabber, is_description
from hvt_scene import Scene
from programs.processes import eventually

BASE = {"size": (320, 180), "fps": 15.0}


def painted(number, *, size=(160, 120)):
    """Paint a grey picture whose level says which frame it is."""
    return np.full((size[1], size[0], 3), 20 + number % 38 * 6, np.uint8)


def number_of(frame):
    """Read from the grey level which frame it is."""
    return round((float(frame.source_bgr[20:-20, 20:-20].mean()) - 20) / 6)


def write_clip(
    path, *, codec="libx264", rate=30, count=30, pixels="yuv420p", size=(160, 120), times=None, **options
):
    """Encode `painted` frames; ``times`` (in milliseconds) overrides the constant rate.

    Colours are rounded accurately: swscale is otherwise three levels too dark.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        stream.options = {name: str(value) for name, value in options.items()}
        if times is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(painted(number, size=size), format="bgr24")
            frame = frame.reformat(
                format=pixels, interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND
            )
            if times is not None:
                frame.pts, frame.time_base = times[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return str(path)


def play(spec, **settings):
    """Play a source to its end; returns it, closed, and its frames."""
    with open_source(spec, **{**BASE, **settings}) as source:
        return source, list(source.frames(start_ns=1_000))


# -- video files ------------------------------------------------------------


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("clip", "count", "size"),
    [("drone_carpark.mp4", 220, (1100, 720)), ("intel_car-detection.mp4", 453, (768, 432))],
)
def test_a_real_clip_gives_the_frames_its_duration_holds(data, clip, count, size):
    """A user's clip would run fast, slow or short, or its boxes would be stretched."""
    with open_source(str(data / "clips" / clip), size=(1280, 720), fps=15) as source:
        assert source.view.source_size == size
        assert source.frame_count == count
        seen = 0
        for frame in source.frames(start_ns=10**18):
            assert frame.index == seen
            assert frame.capture_ns == 10**18 + round(Fraction(seen, 15) * 10**9)
            assert frame.source_bgr.shape == (size[1], size[0], 3)
            assert frame.base_bgr.shape == (720, 1280, 3)
            seen += 1
    assert seen == count


@pytest.mark.realdata
def test_a_real_clip_is_letterboxed_without_distortion(data):
    """1100x720 in 1280x720 is the very same picture between two black borders; stretched cars would be misjudged."""
    clip = str(data / "clips" / "drone_carpark.mp4")
    with open_source(clip, size=(1280, 720), fps=15, max_frames=1) as source:
        assert not source.live
        (frame,) = source.frames(start_ns=0)
    assert np.array_equal(frame.base_bgr[:, 90:1190], frame.source_bgr)
    assert not frame.base_bgr[:, :90].any()
    assert not frame.base_bgr[:, 1190:].any()


@pytest.mark.realdata
def test_a_real_clip_shows_the_right_frames(data):
    """At 24 to 15 fps a wrong choice of frames makes cars jump to and fro."""
    clip = str(data / "clips" / "drone_carpark.mp4")
    with av.open(clip) as container:
        decoded = [
            frame.to_ndarray(format="bgr24")
            for _, frame in zip(range(41), container.decode(video=0), strict=False)
        ]
    _, frames = play(clip, max_frames=25)
    for frame in frames:
        assert np.array_equal(frame.source_bgr, decoded[frame.index * 24 // 15])


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "size"),
    [
        ("h264.mp4", "libx264", "yuv420p", (160, 120)),
        ("hevc.mp4", "libx265", "yuv420p", (160, 120)),
        ("hevc10.mkv", "libx265", "yuv420p10le", (160, 120)),
        ("vp9.webm", "libvpx-vp9", "yuv420p", (160, 120)),
        ("av1.mp4", "libsvtav1", "yuv420p", (160, 120)),
        ("odd.mkv", "ffv1", "bgr0", (161, 121)),
        ("grey.mkv", "ffv1", "gray", (160, 120)),
        ("grey10.mkv", "ffv1", "gray10le", (160, 120)),
        ("motion.avi", "mjpeg", "yuvj420p", (160, 120)),
    ],
)
def test_any_codec_and_pixel_format_comes_out_as_bgr(tmp_path, name, codec, pixels, size):
    """A clip of another camera would be refused or come out in false colours."""
    if codec not in av.codecs_available:
        pytest.skip(f"this FFmpeg has no {codec}")
    clip = write_clip(tmp_path / name, codec=codec, pixels=pixels, size=size, count=20)
    source, frames = play(clip)
    assert source.view.source_size == size
    assert [number_of(frame) for frame in frames] == list(range(0, 20, 2))
    for frame in frames:
        assert frame.source_bgr.shape == (size[1], size[0], 3)
        assert frame.source_bgr.dtype == np.uint8


def test_a_variable_rate_and_a_late_start_are_kept(tmp_path):
    """A screen or phone recording would play at the wrong speed; a cut clip would begin with seconds of nothing."""
    times = [5000, 5100, 5500, 5533, 5567, 6000]
    clip = write_clip(tmp_path / "vfr.mkv", times=times, count=6)
    _, frames = play(clip, fps=10)
    shown = [number_of(frame) for frame in frames]
    assert shown[:11] == [0, 1, 1, 1, 1, 2, 4, 4, 4, 4, 5]


def test_a_damaged_clip_plays_as_far_as_it_goes_and_says_so(tmp_path, caplog):
    """A drone that lost power leaves a broken file; its user would get nothing of it, or no warning."""
    clip = write_clip(tmp_path / "whole.ts", count=90, g=10, bf=0)
    raw = (tmp_path / "whole.ts").read_bytes()
    broken = tmp_path / "broken.ts"
    rng = np.random.default_rng(1)
    half = len(raw) // 2 // 188 * 188
    broken.write_bytes(raw[:half] + rng.bytes(4000))
    _, whole = play(clip)
    with caplog.at_level(logging.WARNING):
        _, frames = play(str(broken))
    assert 10 < len(frames) < len(whole)
    assert [number_of(f) for f in frames[:10]] == [number_of(f) for f in whole[:10]]


def test_a_clip_plays_twice_and_stops_early(tmp_path):
    """A second pass would be empty, or a stop in the middle would hang."""
    clip = write_clip(tmp_path / "clip.mp4", count=60)
    with open_source(clip, **BASE) as source:
        first = source.frames(start_ns=0)
        assert [next(first).index for _ in range(3)] == [0, 1, 2]
        assert [frame.index for frame in source.frames(start_ns=0)] == list(range(30))


def test_source_fps_overrides_a_clips_own_times(tmp_path):
    """A time lapse could not be played at the rate it was taken."""
    clip = write_clip(tmp_path / "lapse.mp4", rate=30, count=30)
    source, frames = play(clip, source_fps=5, fps=5)
    assert source.frame_count == 30
    assert [number_of(frame) for frame in frames] == list(range(30))


# -- image folders ------------------------------------------------------------


@pytest.mark.parametrize(
    "pattern", ["{:07d}.jpg", "img{:06d}.jpg", "shot-{}.png", "{}.bmp", "a{}.webp", "b{}.tif", "²{}.png"]
)
def test_sequence_folders_play_in_order(tmp_path, pattern):
    """VisDrone and UAVDT sequences would not play as they are, or play 1, 10, 11, 2."""
    for number in range(1, 13):
        assert cv2.imwrite(str(tmp_path / pattern.format(number)), painted(number))
    (tmp_path / "gt.txt").write_text("1,1,1,1")
    source, frames = play(str(tmp_path))
    assert source.frame_count == 12
    assert not source.live
    assert [number_of(frame) for frame in frames] == list(range(1, 13))
    assert frames[-1].capture_ns == 1_000 + round(11 / 15 * 1e9)


def test_a_folder_at_its_own_rate(tmp_path):
    """A 30 fps sequence would play at half speed in a 15 fps stream."""
    for number in range(12):
        cv2.imwrite(str(tmp_path / f"{number:07d}.png"), painted(number))
    source, frames = play(str(tmp_path), source_fps=30)
    assert source.frame_count == 6
    assert [number_of(frame) for frame in frames] == [0, 2, 4, 6, 8, 10]


def test_an_unreadable_image_is_held_over_and_shifts_nobody(tmp_path, caplog):
    """One bad file would end the run, or put every later frame against the wrong ground truth."""
    for number in range(6):
        cv2.imwrite(str(tmp_path / f"{number:07d}.jpg"), painted(number))
    (tmp_path / "0000002.jpg").write_bytes(b"not a picture")
    (tmp_path / "0000003.jpg").write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        _, frames = play(str(tmp_path))
    assert [number_of(frame) for frame in frames] == [0, 1, 1, 1, 4, 5]
    assert [record.getMessage().count("cannot be read") for record in caplog.records] == [1, 1]


def test_a_damaged_first_image_is_not_said_to_show_the_one_before(tmp_path, caplog):
    """There is none: who looks for what is shown at the beginning would look for a picture that never was."""
    (tmp_path / "1.png").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "2.png"), painted(50))
    (tmp_path / "3.png").write_bytes(b"no image")
    with open_source(str(tmp_path), size=(64, 64), fps=5) as source:
        assert len(list(source.frames(start_ns=0))) == 3
    assert "1.png cannot be read as an image; the first that can is shown in its place" in caplog.text
    assert "3.png cannot be read as an image; the one before is shown in its place" in caplog.text


def test_another_size_among_images_is_fitted_into_the_first_ones(tmp_path):
    """A sequence with one odd image would crash the encoder."""
    cv2.imwrite(str(tmp_path / "1.png"), painted(50, size=(200, 100)))
    cv2.imwrite(str(tmp_path / "2.png"), painted(50, size=(100, 100)))
    _, frames = play(str(tmp_path))
    assert frames[1].source_bgr.shape == (100, 200, 3)
    assert (frames[1].source_bgr[:, 50:150] == 92).all()
    assert not frames[1].source_bgr[:, :50].any()


def test_files_that_are_no_pictures_by_their_names_are_said(tmp_path):
    """Photographs of a phone among the others were left out without a word."""
    for name in ("1.jfif", "2.HEIC", "3.heic", "4.avif", ".hidden", "README"):
        (tmp_path / name).write_bytes(cv2.imencode(".jpg", painted(1))[1])
    source, _ = play(str(tmp_path))
    assert source.frame_count == 1
    assert "left out by their endings: 1 .avif, 2 .heic, 1 without one" in source.notes[-1]


def test_a_folder_that_may_not_be_read_is_said(tmp_path, monkeypatch):
    """Another user's folder would be a traceback."""
    denied = mock.Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(type(tmp_path), "iterdir", denied)
    assert "cannot be read (Permission denied)" in refused(str(tmp_path))


def test_hidden_files_are_not_frames(tmp_path):
    """A folder that came from a Mac would show its thumbnails."""
    cv2.imwrite(str(tmp_path / "1.png"), painted(1))
    (tmp_path / "._1.png").write_bytes(b"resource fork")
    assert [file.name for file in sequence_files(tmp_path)] == ["1.png"]


def test_a_picture_that_goes_while_the_folder_plays_is_skipped(tmp_path):
    """Somebody who tidies up would end the flight in a traceback."""
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), painted(number, size=(96, 64)))
    with open_source(str(tmp_path), size=(96, 64), fps=10) as source:
        frames = source.frames(start_ns=0)
        first = next(frames)
        (tmp_path / "2.png").unlink()
        rest = list(frames)
    means = [round(float(frame.source_bgr.mean())) for frame in (first, *rest)]
    assert means[1] == means[2], "the one before is shown"
    assert len(set(means)) == 3


def test_pictures_that_come_while_the_folder_plays_are_counted(tmp_path, caplog):
    """They were left out without a word, with ``--follow`` too."""
    cv2.imwrite(str(tmp_path / "1.png"), painted(1, size=(96, 64)))
    with open_source(str(tmp_path), size=(96, 64), fps=10) as source:
        cv2.imwrite(str(tmp_path / "2.png"), painted(2, size=(96, 64)))
        assert len(list(source.frames(start_ns=0))) == 1
    assert "1 images came after the start and are not shown" in caplog.text
    assert "--follow waits for no other" in refused(str(tmp_path), growing=True)


# -- demo ------------------------------------------------------------


def test_the_demo_is_a_source_with_truth(tmp_path):
    """The command `make demo` would have nothing to show, or nothing to measure against."""
    with open_source("demo:codes", size=(640, 360), fps=15, seed=2, max_frames=2) as source:
        assert isinstance(source, DemoSource)
        assert not source.live
        assert source.frame_count == 2
        assert source.class_names[:2] == ("car", "van")
        assert source.view.source_size == (1920, 1080)
        source.write_truth(tmp_path / "gt.txt", fps=2.0)
        first, second = source.frames(start_ns=50)
    assert np.array_equal(second.source_bgr, Scene(2, codes=True).image(1 / 15))
    assert (first.capture_ns, second.capture_ns) == (50, 50 + 66_666_667)
    assert first.base_bgr.shape == (360, 640, 3)
    assert len((tmp_path / "gt.txt").read_text().splitlines()) > 1000
    with open_source("demo", size=(640, 360), fps=12.5) as source:
        assert source.frame_count == 250


def test_the_demo_begins_anew_for_its_next_reader(tmp_path):
    """A flight whose encoder was tried first would show a picture of the trial, or fail at its truth."""
    with open_source("demo", size=(640, 360), fps=15, max_frames=4) as source:
        assert isinstance(source, DemoSource)
        first = [next(source.frames(start_ns=0)).base_bgr for _ in range(2)]
        source.write_truth(tmp_path / "gt.txt", fps=1.0)
        whole = [frame.base_bgr for frame in source.frames(start_ns=0)]
    assert len(whole) == 4
    assert all(np.array_equal(one, whole[0]) for one in first)
    assert not np.array_equal(whole[0], whole[3])


@pytest.fixture
def drawn_by(monkeypatch) -> list[subprocess.Popen]:
    """The processes that draw."""
    started, popen = [], subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *args, **more: started.append(popen(*args, **more)) or started[-1]
    )
    return started


def test_a_demo_whose_drawing_was_stopped_for_a_moment_goes_on(monkeypatch, drawn_by):
    """In a container, whose Python has no buffers, half a picture came, and the flight stood still for good.

    After `kill -9` of its reader a traceback of it stood on the screen.
    """
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    with open_source("demo", size=(64, 64), fps=5, max_frames=2) as source:
        frames = source.frames(start_ns=0)
        next(frames)
        (drawing,) = drawn_by

        def has_begun() -> bool:
            waits = fcntl.ioctl(drawing.stdout, termios.FIONREAD, bytes(4))
            return int.from_bytes(waits, sys.byteorder) >= 4096

        eventually(has_begun, what="a part of the next picture has come")
        drawing.send_signal(signal.SIGSTOP)
        eventually(lambda: psutil.Process(drawing.pid).status() == "stopped", what="it is stopped")
        drawing.send_signal(signal.SIGCONT)
        assert len(list(frames)) == 1
        next(source.frames(start_ns=0))
        drawing.stdout.close()
        assert drawing.wait(timeout=60) == -signal.SIGPIPE


def test_a_demo_that_nobody_draws_any_more_ends_with_a_sentence(drawn_by):
    """Where the system had no memory left for it, a traceback would tell of a broken pipe."""
    with open_source("demo", size=(64, 64), fps=5) as source:
        assert isinstance(source, DemoSource)
        drawn_by[0].kill()
        drawn_by[0].wait()
        for use in (lambda: next(source.frames(start_ns=0)), source.poses):
            with pytest.raises(UserError, match="the process that draws the scene has ended"):
                use()


def test_a_demo_that_was_killed_in_the_midst_of_an_answer_ends_with_a_sentence(monkeypatch):
    """Half of what it had to say would be a traceback of pickle's."""
    half = io.BytesIO(pickle.dumps(((3840, 2160), ("car",) * 100, 10.0))[:-9])
    killed = SimpleNamespace(
        stdin=io.BytesIO(), stdout=half, kill=lambda: None, communicate=lambda **_timeout: None
    )
    monkeypatch.setattr(subprocess, "Popen", lambda *_args, **_more: killed)
    assert "the process that draws the scene has ended" in refused("demo")


def test_the_demo_has_4k_when_told():
    """A 4K flight would be one of an enlarged picture."""
    with open_source("demo:codes,4k", size=(640, 360), fps=15, seed=1, max_frames=1) as source:
        assert source.view.source_size == (3840, 2160)
    said = refused("demo:codes,8k")
    assert "'8k'" in said
    assert "demo:codes,4k" in said


# -- live ------------------------------------------------------------


class Live(BaseHTTPRequestHandler):
    """Sends an MPEG-TS recording at a few times its own pace and hangs up, like a camera that restarts."""

    stream: bytes = b""

    def do_GET(self):
        """Answer with the recording."""
        self.send_response(200)
        self.send_header("Content-Type", "video/mp2t")
        at_once = self.path == "/whole.ts"
        if at_once or self.path == "/invented.ts":
            self.send_header("Content-Length", str(len(self.stream) if at_once else 2**31 - 1))
        self.end_headers()
        try:
            for start in range(0, len(self.stream), 188 * 8):
                self.wfile.write(self.stream[start : start + 188 * 8])
                time.sleep(0 if at_once else 0.01)
        except OSError:
            return

    def log_message(self, *_):
        """Keep quiet."""
        return


@pytest.fixture
def http_stream(tmp_path):
    """Serve a stream without a length from loopback."""
    write_clip(tmp_path / "live.ts", codec="mpeg2video", rate=25, count=200, size=(320, 240), b=2_000_000)
    Live.stream = (tmp_path / "live.ts").read_bytes()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Live)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/live.ts"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.parametrize("length", ["live", "invented"])
def test_an_http_stream_plays_live_and_comes_back_after_it_ends(http_stream, caplog, length):
    """A camera that restarts would end the flight's telemetry."""
    http_stream = http_stream.replace("live", length)
    began = time.time_ns()
    with caplog.at_level(logging.WARNING), open_source(http_stream, size=(320, 180), fps=100) as source:
        assert source.live
        assert source.frame_count is None
        assert source.view.source_size == (320, 240)
        frames = []
        for frame in source.frames(start_ns=0):
            frames.append(frame)
            if source.restarts and len(frames) > 20:
                break
    assert [frame.index for frame in frames] == list(range(len(frames)))
    times = [frame.capture_ns for frame in frames]
    assert began < times[0]
    assert times == sorted(times)
    assert frames[0].base_bgr.shape == (180, 320, 3)
    assert "source: http://127.0.0.1" in caplog.text
    assert not [thread for thread in threading.enumerate() if thread.name == "hvt-source"]


@pytest.mark.parametrize("ending", ["ts", "mpg", "h264"])
def test_a_recording_that_a_server_sends_as_a_whole_is_a_clip(tmp_path, http_stream, ending):
    """It was a camera that sends in bursts and stops each time: a few pictures of each minute, over and over."""
    codec = "libx264" if ending == "h264" else "mpeg2video"
    write_clip(tmp_path / f"a.{ending}", codec=codec, rate=25, count=200, size=(320, 240), bf=0)
    Live.stream = (tmp_path / f"a.{ending}").read_bytes()
    with open_source(http_stream.replace("live", "whole"), size=(320, 180), fps=25) as source:
        assert not source.live
        assert len(list(source.frames(start_ns=0))) == 200


def test_an_mp4_whose_index_cannot_be_reached_says_how_it_can(tmp_path, http_stream):
    """Of a whole file it was said that no frame can be decoded; its server sends no ranges."""
    clip = write_clip(tmp_path / "a.mp4", codec="mjpeg", pixels="yuvj420p", count=60, size=(320, 240))
    Live.stream = Path(clip).read_bytes()
    said = refused(http_stream.replace("live", "whole"))
    assert "without HTTP ranges plays an MP4 whose index (moov) comes first (+faststart)" in said


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_a_clock_that_is_set_neither_stops_a_camera_nor_dates_it_anew(http_stream, monkeypatch, step_s):
    """NTP would silence the camera for as long as the clock was ahead, or put an hour into the recording."""
    wall_ns, set_by_s = time.time_ns, [0]
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns() + set_by_s[0] * 1_000_000_000)
    with open_source(http_stream, size=(320, 180), fps=20, clock=SteadyClock()) as source:
        times = []
        for frame in source.frames(start_ns=0):
            times.append(frame.capture_ns)
            if len(times) == 10:
                set_by_s[0] = step_s
            if len(times) == 25:
                break
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert min(gaps) > 0
    assert max(gaps) < 30_000_000_000


def test_a_slow_consumer_gets_fresh_frames_and_no_queue(http_stream):
    """The operator would see the past, later and later."""
    with open_source(http_stream, size=(320, 180), fps=200) as source:
        assert isinstance(source, LiveSource)
        for _ in source.frames(start_ns=0):
            if source.missed:
                break
            time.sleep(0.15)


def test_a_udp_stream_plays(tmp_path):
    """A drone's video link, which sends MPEG-TS by UDP, could not be used."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    stop = threading.Event()

    def send():
        with av.open(f"udp://127.0.0.1:{port}?pkt_size=1316", "w", format="mpegts") as container:
            stream = container.add_stream("mpeg2video", rate=50)
            stream.width, stream.height, stream.pix_fmt, stream.gop_size = 320, 240, "yuv420p", 5
            number = 0
            while not stop.wait(0.01):
                picture = av.VideoFrame.from_ndarray(painted(number, size=(320, 240)), format="bgr24")
                container.mux(stream.encode(picture))
                number += 1

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with open_source(f"udp://127.0.0.1:{port}", size=(320, 180), fps=15, max_frames=5) as source:
            frames = list(source.frames(start_ns=0))
    finally:
        stop.set()
        sender.join()
    assert [frame.index for frame in frames] == list(range(5))
    # The base rate, although the sender is faster: four periods less the quarter that a frame may be early. Not each
    # gap by itself: after a frame that is late the next may follow at once.
    assert frames[-1].capture_ns - frames[0].capture_ns >= (4 - 1 / 4) / 15 * 1e9


def test_a_stream_that_is_joined_between_two_keyframes_plays_from_the_next(tmp_path, free_port):
    """A drone whose picture is whole once in four seconds would be refused until the start hits that moment."""
    clip = tmp_path / "whole.ts"
    write_clip(clip, count=520, g=260, bf=0)
    packets = [clip.read_bytes()[at : at + 188] for at in range(0, clip.stat().st_size, 188)]
    video = [
        place for place, one in enumerate(packets) if one[1] & 0x40 and (one[1] & 31) << 8 | one[2] == 256
    ]
    stop = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for place in range(video[7], len(packets)):
                out.sendto(packets[place], ("127.0.0.1", free_port))
                if stop.wait(0.01):
                    return

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with open_source(f"udp://127.0.0.1:{free_port}", size=(320, 180), fps=30, max_frames=2) as source:
            assert len(list(source.frames(start_ns=0))) == 2
    finally:
        stop.set()
        sender.join()


def test_closing_ends_a_reader_that_waits(http_stream):
    """Ctrl-C would hang while the camera is silent."""
    source = LiveSource(StreamGrabber(http_stream), SourceSettings(size=(320, 180), fps=15))
    closer = threading.Timer(0.3, source.close)
    closer.start()
    list(source.frames(start_ns=0))
    closer.join()
    source.close()


# -- wrong input ------------------------------------------------------------


def refused(spec, **settings):
    """Return the sentence with which a source is refused."""
    with pytest.raises(UserError) as caught:
        open_source(spec, **{**BASE, **settings})
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert not sentence.endswith(".")
    return sentence


def test_missing_and_unusable_files_are_one_sentence(tmp_path):
    """A typing error would end in a traceback."""
    empty = tmp_path / "empty.mp4"
    empty.touch()
    text = tmp_path / "notes.txt"
    text.write_text("not a video\n" * 50)
    noise = tmp_path / "noise.mp4"
    noise.write_bytes(np.random.default_rng(0).bytes(20_000))
    bare = tmp_path / "folder"
    bare.mkdir()
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "1.jpg").write_bytes(b"no picture")
    assert "nothere.mp4" in refused(str(tmp_path / "nothere.mp4"))
    assert "empty" in refused(str(empty))
    assert "no video" in refused(str(text)) or "not a video" in refused(str(text))
    assert "noise.mp4" in refused(str(noise))
    assert "no images" in refused(str(bare))
    assert "none of which" in refused(str(broken))


@pytest.mark.parametrize("spec", ["rtsp:/cam/1", "http:/10.0.0.5/a", "10.0.0.5:554/stream", "rtsp//cam/1"])
def test_an_address_with_a_slip_is_no_disk_that_may_come(spec):
    """It was waited for with exit code 1, and a disk was asked for."""
    assert "does not exist, and an address has a scheme and two slashes" in refused(spec)


def test_a_users_folder_is_found(tmp_path, monkeypatch):
    """No shell replaces the ~ in --source=~/clip.mp4: a disk was asked for."""
    monkeypatch.setenv("HOME", str(tmp_path))
    write_clip(tmp_path / "a.mp4", count=2)
    assert play("~/a.mp4")[0].frame_count == 1
    assert "a user that this machine does not know" in refused("~nobody-here/a.mp4")


def test_a_phones_photograph_is_refused(tmp_path):
    """It is made of tiles, and one of them was flown."""
    clip = Path(write_clip(tmp_path / "a.mp4", count=2))
    clip.write_bytes(clip.read_bytes().replace(b"isom", b"heic", 1))
    assert "is a HEIC picture: convert it to JPEG" in refused(str(clip))


def test_a_sound_file_is_no_video(tmp_path):
    """A wrong file would fail somewhere in the decoder."""
    path = tmp_path / "tone.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
    assert "no video" in refused(str(path))


def test_unreachable_streams_are_one_sentence_without_the_password(free_port):
    """The user would wait for ever, or find the camera's password in the log."""
    sentence = refused(f"rtsp://admin:secret@127.0.0.1:{free_port}/cam")
    assert "secret" not in sentence
    assert "127.0.0.1" in sentence
    assert "scheme" in refused("gopher://127.0.0.1/x")


def test_streams_of_rtmp_and_of_a_description_are_live(tmp_path, free_port):
    """What a drone sends by RTMP, or by RTP alone, would be no source at all."""
    assert "cannot be opened within" in refused(f"rtmp://127.0.0.1:{free_port}/live/key")
    described = tmp_path / "camera.sdp"
    described.write_text(
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n"
        f"m=video {free_port} RTP/AVP 96\na=rtpmap:96 H264/90000\n"
    )
    assert is_description(str(described))
    grabber = StreamGrabber(str(described), open_s=0.2)
    grabber.open()  # as nothing else than a file of video it could not be read
    assert not grabber.holds_a_clip
    grabber.close()
    assert "does not exist" in refused(str(tmp_path / "other.sdp"))
    assert "source '' does not exist" in refused("")


def test_a_stream_that_never_answers_is_given_up(free_port):
    """An address that accepts and says nothing would hang the start."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        grabber = StreamGrabber(f"rtsp://127.0.0.1:{silent.getsockname()[1]}/cam", open_s=0.5)
        with pytest.raises(UserError, match=r"within 0\.5 s"):
            grabber.open()


@pytest.mark.parametrize("hangs_up", [False, True])
def test_a_camera_that_opens_its_port_before_it_answers_is_waited_for(hangs_up):
    """After a power cut both boot at once: the edge would end with code 2, and no supervisor starts it again."""
    with socket.create_server(("127.0.0.1", 0)) as booting:

        def hang_up() -> None:
            booting.accept()[0].close()

        grabber = StreamGrabber(f"rtsp://127.0.0.1:{booting.getsockname()[1]}/cam", open_s=0.5)
        if hangs_up:
            threading.Thread(target=hang_up).start()
        with pytest.raises(NotYetError, match="no answer of RTSP in time"):
            grabber.open()


def test_a_missing_camera_is_one_sentence():
    """A wrong device number would end in OpenCV's own words."""
    assert "/dev/video97 does not exist" in refused("/dev/video97")
    assert "no video device" in refused(os.devnull)


@pytest.mark.parametrize("coded", [False, True])
def test_a_name_that_none_can_have_is_one_sentence(coded):
    """A pasted text would end in a traceback."""
    assert ("is a device" if coded else "cannot be looked at") in refused("/dev/" + "x" * 300, coded=coded)
    assert "does not exist" in refused("x" * 300, coded=coded)


@pytest.mark.parametrize("growing", [False, True])
def test_a_pipe_is_no_clip(tmp_path, growing):
    """It was called an empty file, and with ``--follow`` waited for without a word."""
    os.mkfifo(tmp_path / "a.ts")
    for spec in (tmp_path / "a.ts", "-", "pipe:0", "rtspsrc location=rtsp://10.0.0.5/1 ! appsink"):
        assert "is neither a file nor a folder" in refused(str(spec), growing=growing)


def test_a_clip_in_memory_is_no_camera():
    """/dev/shm is where a clip is put that no disk should slow down."""
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as clip:
        assert "is an empty file" in refused(clip.name)


@pytest.mark.parametrize("size", [(1281, 720), (1280, 719), (62, 720), (1280, 8194), (0, 0), (-64, 64)])
def test_impossible_sizes_are_refused(size):
    """The encoder would crash later, with no hint of the cause."""
    assert f"{size[0]}x{size[1]}" in refused("demo", size=size)


@pytest.mark.parametrize("fps", [0.0, -1.0, 240.5, float("nan"), float("inf")])
def test_impossible_rates_are_refused(fps):
    """A rate of nought would divide by it."""
    assert "fps" in refused("demo", fps=fps)
    assert "source-fps" in refused("demo", source_fps=-1.0)


def test_a_file_that_another_program_will_write_is_waited_for(tmp_path, monkeypatch):
    """An edge that starts before the recorder would end with code 2, and no supervisor starts it again."""
    with pytest.raises(NotYetError, match="does not exist"):
        open_source(str(tmp_path / "growing.ts"), size=(320, 180), fps=15, fit="letterbox", growing=True)
    monkeypatch.setattr(container, "QUIET_S", 0.0)
    for content, says in ((b"", "empty so far"), (bytes(100), "is not a video that can be read")):
        (tmp_path / "growing.ts").write_bytes(content)
        with pytest.raises(NotYetError, match=says):
            open_source(str(tmp_path / "growing.ts"), size=(320, 180), fps=15, fit="letterbox", growing=True)
