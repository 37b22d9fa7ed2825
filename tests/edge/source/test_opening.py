"""Every kind of source, on real files and real sockets."""

import errno
import fcntl
import io
import itertools
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
from contextlib import contextmanager, suppress
from fractions import Fraction
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from types import SimpleNamespace
from unittest import mock

import av
import cv2
import numpy as np
import psutil
import pytest

from hvt_common.errors import NotYetError, UserError
from hvt_common.runtime.clock import SteadyClock
from hvt_edge.source.contract import SourceSettings
from hvt_edge.source.decoding import container
from hvt_edge.source.folder import sequence_files
from hvt_edge.source.live import LiveSource
from hvt_edge.source.opening import open_source
from hvt_edge.source.stream import StreamGrabber, is_description
from hvt_scene import Scene
from hvt_scene.source import DemoSource
from media.numbered import number_of, numbered, write_numbered
from programs.processes import eventually

BASE = {"size": (320, 180), "fps": 15.0}


def numbers(frames):
    return [number_of(frame.source_bgr) for frame in frames]


def play(spec, **settings):
    """Play a source to its end; returns it, closed, and its frames."""
    with open_source(str(spec), **{**BASE, **settings}) as source:
        return source, list(source.frames(start_ns=1_000))


def refused(spec, **settings):
    """The sentence with which a source is refused."""
    with pytest.raises(UserError) as caught:
        open_source(str(spec), **{**BASE, **settings})
    sentence = str(caught.value)
    assert "\n" not in sentence
    assert not sentence.endswith(".")
    return sentence


# -- video files ------------------------------------------------------------


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("clip", "count", "size"),
    [("drone_carpark.mp4", 220, (1100, 720)), ("intel_car-detection.mp4", 453, (768, 432))],
)
def test_a_real_clip_gives_the_frames_its_duration_holds(data, clip, count, size):
    """A user's clip would run fast, slow or short, or its boxes would be stretched."""
    with open_source(str(data / "clips" / clip), size=(1280, 720), fps=15) as source:
        assert (source.view.source_size, source.frame_count, source.live) == (size, count, False)
        seen = 0
        for frame in source.frames(start_ns=10**18):
            assert (frame.index, frame.capture_ns) == (seen, 10**18 + round(Fraction(seen, 15) * 10**9))
            assert (frame.source_bgr.shape, frame.base_bgr.shape) == ((size[1], size[0], 3), (720, 1280, 3))
            seen += 1
    assert seen == count


@pytest.mark.realdata
def test_a_real_clip_shows_the_right_frames_without_distortion(data):
    """At 24 to 15 fps a wrong choice of frames makes cars jump to and fro; stretched cars would be misjudged."""
    clip = str(data / "clips" / "drone_carpark.mp4")
    with av.open(clip) as film:
        decoded = [one.to_ndarray(format="bgr24") for one in itertools.islice(film.decode(video=0), 41)]
    with open_source(clip, size=(1280, 720), fps=15, max_frames=25) as source:
        for frame in source.frames(start_ns=0):
            assert np.array_equal(frame.source_bgr, decoded[frame.index * 24 // 15])
            assert np.array_equal(frame.base_bgr[:, 90:1190], frame.source_bgr), "1100x720 between borders"
            assert not frame.base_bgr[:, :90].any()
            assert not frame.base_bgr[:, 1190:].any()


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
    pictures = [numbered(number, size=size) for number in range(20)]
    source, frames = play(write_numbered(tmp_path / name, codec=codec, pixels=pixels, pictures=pictures))
    assert source.view.source_size == size
    assert numbers(frames) == list(range(0, 20, 2))
    assert {frame.source_bgr.shape for frame in frames} == {(size[1], size[0], 3)}
    red = frames[0].source_bgr[:20, :20].astype(int)
    assert "gray" in pixels or np.abs(red - (0, 0, 191)).max() < 24


def test_a_variable_rate_and_a_late_start_are_kept(tmp_path):
    """A screen or phone recording would play at the wrong speed; a cut clip would begin with seconds of nothing."""
    times = [5000, 5100, 5500, 5533, 5567, 6000]
    _, frames = play(write_numbered(tmp_path / "vfr.mkv", 6, times_ms=times), fps=10)
    assert numbers(frames)[:11] == [0, 1, 1, 1, 1, 2, 4, 4, 4, 4, 5]


def test_a_clip_plays_twice_and_stops_early(tmp_path):
    """A second pass would be empty, or a stop in the middle would hang."""
    with open_source(str(write_numbered(tmp_path / "clip.mp4")), **BASE) as source:
        first = source.frames(start_ns=0)
        assert [next(first).index for _ in range(3)] == [0, 1, 2]
        assert [frame.index for frame in source.frames(start_ns=0)] == list(range(30))


def test_source_fps_overrides_a_clips_own_times(tmp_path):
    """A time lapse could not be played at the rate it was taken."""
    source, frames = play(write_numbered(tmp_path / "lapse.mp4", 30), source_fps=5, fps=5)
    assert source.frame_count == 30
    assert numbers(frames) == list(range(30))


# -- image folders ------------------------------------------------------------


def write_pictures(folder, pattern, numbers):
    for number in numbers:
        assert cv2.imwrite(str(folder / pattern.format(number)), numbered(number))


@pytest.mark.parametrize(
    "pattern", ["{:07d}.jpg", "img{:06d}.jpg", "shot-{}.png", "{}.bmp", "a{}.webp", "b{}.tif", "²{}.png"]
)
def test_sequence_folders_play_in_order(tmp_path, pattern):
    """VisDrone and UAVDT sequences would not play as they are, or play 1, 10, 11, 2, or at half speed."""
    write_pictures(tmp_path, pattern, range(1, 13))
    (tmp_path / "gt.txt").write_text("1,1,1,1")
    source, frames = play(tmp_path)
    assert (source.frame_count, source.live) == (12, False)
    assert numbers(frames) == list(range(1, 13))
    assert frames[-1].capture_ns == 1_000 + round(11 / 15 * 1e9)
    source, frames = play(tmp_path, source_fps=30)
    assert source.frame_count == 6
    assert numbers(frames) == [1, 3, 5, 7, 9, 11]


def test_an_unreadable_image_is_held_over_and_shifts_nobody(tmp_path, caplog):
    """One bad file would end the run, put others against the wrong truth, or be said to show what never was."""
    write_pictures(tmp_path, "{}.jpg", range(6))
    # Where it begins anew at each block, FFmpeg sees no damage in half of a picture.
    _, restarts = cv2.imencode(".jpg", numbered(0), [cv2.IMWRITE_JPEG_RST_INTERVAL, 1])
    half = restarts.tobytes()[: restarts.size // 2]
    for number, content in ((0, b"no picture"), (2, half), (3, b"")):
        (tmp_path / f"{number}.jpg").write_bytes(content)
    for number in (1, 4, 5):  # some programs leave out the end marker
        file = tmp_path / f"{number}.jpg"
        file.write_bytes(file.read_bytes()[:-2])
    assert numbers(play(tmp_path)[1]) == [1, 1, 1, 1, 4, 5]
    said = [one.getMessage().partition(" cannot be read as an image; the ")[2] for one in caplog.records]
    assert [one.split(" is shown")[0] for one in said] == ["first that can", "one before", "one before"]


def test_another_size_among_images_is_fitted_into_the_first_ones(tmp_path):
    """A sequence with one odd image would crash the encoder."""
    for number, wide in enumerate((200, 100)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((100, wide, 3), 92, np.uint8))
    odd = play(tmp_path)[1][1].source_bgr
    assert odd.shape == (100, 200, 3)
    assert (odd[:, 50:150] == 92).all()
    assert not odd[:, :50].any()


def test_files_that_are_no_pictures_by_their_names_are_said(tmp_path):
    """Photographs of a phone among the others were left out without a word; a Mac's thumbnails were shown."""
    for name in ("1.jfif", "2.HEIC", "3.heic", "4.avif", ".hidden", "._1.png", "README"):
        (tmp_path / name).write_bytes(cv2.imencode(".jpg", numbered(1))[1])
    source, _ = play(tmp_path)
    assert source.frame_count == 1
    assert "others of their names: 1 .avif, 2 .heic, 1 without one" in source.notes[-1]
    assert [file.name for file in sequence_files(tmp_path)] == ["1.jfif"]


def test_masks_beside_pictures_are_left_out_or_said(tmp_path):
    """Each second picture was a mask, and the clip lasted twice as long, without a word."""
    for pattern in ("{}.jpg", "{}.png", "{}_mask.png"):
        write_pictures(tmp_path, pattern, (1, 2))
    write_pictures(tmp_path, "cover.jpg", (9,))
    source, _ = play(tmp_path)
    said = " ".join(source.notes)
    names = ["1.jpg", "1_mask.png", "2.jpg", "2_mask.png", "cover.jpg"]
    assert [file.name for file in sequence_files(tmp_path)] == names
    assert "all are shown: 2 '#', 2 '#_mask'" in said
    assert "left out by their endings, or beside others of their names: 2 .png" in said


def test_each_of_a_drones_series_is_said_by_its_whole_name(tmp_path):
    """Five bands of one flight were one film without a word, or had all the same name."""
    bands = [f"a_flight_over_the_vineyard_behind_the_{band}" for band in ("g", "r", "re", "nir", "rgb")]
    for band in bands:
        write_pictures(tmp_path, "{}_" + band + ".png", (1, 2))
    said = " ".join(play(tmp_path)[0].notes)
    assert all(f"2 '#_{band}'" in said for band in bands)


@pytest.mark.parametrize(
    ("pictures", "bands", "said"),
    [
        (6, range(1, 6), "6 'IMG_#_1', 6 'IMG_#_2', 6 'IMG_#_3', 6 'IMG_#_4', 5 'IMG_#_5'"),
        (11, range(1, 11), "11 'IMG_#_1', 10 'IMG_#_10', 11 'IMG_#_2'"),
        (2, range(1, 10), ""),  # two clips of nine pictures
        (5, range(1, 4), ""),  # bursts
        (5, (0, 5), ""),  # tenths of a second
        (6, (0, 2, 4, 6, 8), ""),
        (11, range(10), ""),
    ],
)
def test_bands_that_are_numbered_are_said(tmp_path, pictures, bands, said):
    """A camera's five bands in turn were one film without a word, also with a lost one and another file."""
    for number in range(pictures):
        write_pictures(tmp_path, f"IMG_{number:04}_{{}}.png", bands)
    write_pictures(tmp_path, "cover.png", (9,))
    (tmp_path / f"IMG_{pictures - 1:04}_{bands[-1]}.png").unlink()
    notes = " ".join(play(tmp_path)[0].notes)
    assert said in notes
    assert ("several series" in notes) == bool(said)


@pytest.mark.parametrize(
    ("shown", "size", "other"), [(".png", 1, ".tiff"), (".tif", 2, ".jpg"), (".jpg", 1, ".png")]
)
def test_of_files_of_one_name_the_picture_is_shown(tmp_path, shown, size, other):
    """Depth was shown in place of colours, and a thumbnail in place of its photograph."""
    for number in range(2):
        small = np.full((32, 32), 5, np.float32 if other == ".tiff" else np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}{other}"), small)
        cv2.imwrite(str(tmp_path / f"{number}{shown}"), np.full((32 * size, 32 * size, 3), 92, np.uint8))
    source, frames = play(tmp_path)
    assert [frame.source_bgr[9, 9, 0] for frame in frames] == [92, 92]
    assert f"names: 2 {other}" in " ".join(source.notes)


def test_a_folder_that_may_not_be_read_is_said(tmp_path, monkeypatch):
    """Another user's folder would be a traceback."""
    denied = mock.Mock(side_effect=PermissionError(errno.EACCES, "Permission denied"))
    monkeypatch.setattr(type(tmp_path), "iterdir", denied)
    assert "cannot be read (Permission denied)" in refused(tmp_path)


def test_a_folder_may_change_while_it_plays(tmp_path, caplog):
    """Somebody who tidies up would end the flight in a traceback; new pictures were left out without a word."""
    write_pictures(tmp_path, "{}.png", range(4))
    with open_source(str(tmp_path), **BASE) as source:
        frames = source.frames(start_ns=0)
        first = next(frames)
        (tmp_path / "2.png").unlink()
        write_pictures(tmp_path, "{}.png", (4, 5))
        assert numbers((first, *frames)) == [0, 1, 1, 3]
    assert "1 images came after the start and are not shown" in caplog.text
    assert "--follow waits for no other" in refused(tmp_path, growing=True)


# -- demo ------------------------------------------------------------


def test_the_demo_is_a_source_with_truth_that_begins_anew_for_its_next_reader(tmp_path):
    """A flight whose encoder was tried first would show a picture of the trial, or `make demo` measure against it."""
    with open_source("demo:codes", size=(640, 360), fps=12.5, seed=2) as source:
        assert isinstance(source, DemoSource)
        assert (source.live, source.frame_count, source.view.source_size) == (False, 250, (1920, 1080))
        assert source.class_names[:2] == ("car", "van")
        tried = [next(source.frames(start_ns=0)).base_bgr for _ in range(2)]
        source.write_truth(tmp_path / "gt.txt", fps=2.0)
        first, second = itertools.islice(source.frames(start_ns=50), 2)
    assert all(np.array_equal(one, first.base_bgr) for one in tried)
    assert np.array_equal(second.source_bgr, Scene(2, codes=True).image(0.08))
    assert not np.array_equal(second.base_bgr, first.base_bgr)
    assert (first.capture_ns, second.capture_ns) == (50, 50 + 80_000_000)
    assert first.base_bgr.shape == (360, 640, 3)
    assert len((tmp_path / "gt.txt").read_text().splitlines()) > 1000


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


def test_a_demo_that_nobody_draws_any_more_ends_with_a_sentence(drawn_by, monkeypatch):
    """Where the system had no memory left for it, a traceback would tell of a broken pipe, or of pickle."""
    with open_source("demo", size=(64, 64), fps=5) as source:
        assert isinstance(source, DemoSource)
        drawn_by[0].kill()
        drawn_by[0].wait()
        for use in (lambda: next(source.frames(start_ns=0)), source.poses):
            with pytest.raises(UserError, match="the process that draws the scene has ended"):
                use()
    half = io.BytesIO(pickle.dumps(((3840, 2160), ("car",) * 100, 10.0))[:-9])
    killed = mock.Mock(stdin=io.BytesIO(), stdout=half)
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


@contextmanager
def served(answer):
    """The address of a server that calls ``answer(handler)`` until its reader has gone."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_words):
            """Say nothing."""

        def do_GET(self):
            with suppress(OSError):
                answer(self)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    with running(server.serve_forever), server:
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()


@contextmanager
def running(work):
    """``work()`` runs beside what follows, which ends it."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join()


@pytest.fixture
def recording(tmp_path):
    """A server of ``bytes``: ``/live`` without a length and at a few times its pace, ``/whole`` at once.

    It hangs up at the end, like a camera that restarts. ``/invented`` has the length that some cameras invent.
    """
    clip = write_numbered(tmp_path / "live.ts", 200, codec="mpeg2video", rate=25)
    made = SimpleNamespace(bytes=clip.read_bytes())

    def answer(handler):
        handler.send_response(200)
        handler.send_header("Content-Type", "video/mp2t")
        lengths = {"/whole.ts": len(made.bytes), "/invented.ts": 2**31 - 1}
        if (length := lengths.get(handler.path)) is not None:
            handler.send_header("Content-Length", str(length))
        handler.end_headers()
        for start in range(0, len(made.bytes), 188 * 8):
            handler.wfile.write(made.bytes[start : start + 188 * 8])
            time.sleep(0 if handler.path == "/whole.ts" else 0.01)

    with served(answer) as made.url:
        yield made


@pytest.mark.parametrize("length", ["live", "invented"])
def test_an_http_stream_plays_live_and_comes_back_after_it_ends(recording, caplog, length):
    """A camera that restarts would end the flight's telemetry."""
    began = time.time_ns()
    with open_source(f"{recording.url}/{length}.ts", size=(320, 180), fps=100) as source:
        assert (source.live, source.frame_count, source.view.source_size) == (True, None, (320, 240))
        frames = []
        for frame in source.frames(start_ns=0):
            frames.append(frame)
            if source.restarts and len(frames) > 20:
                break
    assert [frame.index for frame in frames] == list(range(len(frames)))
    times = [began, *(frame.capture_ns for frame in frames)]
    assert times == sorted(times)
    assert frames[0].base_bgr.shape == (180, 320, 3)
    assert "source: http://127.0.0.1" in caplog.text
    assert not [thread for thread in threading.enumerate() if thread.name == "hvt-source"]


@pytest.mark.parametrize("ending", ["ts", "mpg", "h264"])
def test_a_recording_that_a_server_sends_as_a_whole_is_a_clip(tmp_path, recording, ending):
    """It was a camera that sends in bursts and stops each time: a few pictures of each minute, over and over."""
    codec = "libx264" if ending == "h264" else "mpeg2video"
    recording.bytes = write_numbered(tmp_path / f"a.{ending}", 200, codec=codec, rate=25, bf="0").read_bytes()
    source, frames = play(f"{recording.url}/whole.ts", fps=25)
    assert not source.live
    assert len(frames) == 200


def test_an_mp4_whose_index_cannot_be_reached_says_how_it_can(tmp_path, recording):
    """Of a whole file it was said that no frame can be decoded; its server sends no ranges."""
    recording.bytes = write_numbered(tmp_path / "a.mp4", codec="mjpeg", pixels="yuvj420p").read_bytes()
    said = refused(f"{recording.url}/whole.ts")
    assert "without HTTP ranges plays an MP4 whose index (moov) comes first (+faststart)" in said


@pytest.mark.parametrize("keeps", [True, False])
def test_an_mp4_whose_index_comes_last_is_played_from_its_first_frame(tmp_path, keeps):
    """The first keyframe was lost, without a word, or all, where a server answers on new lines alone."""
    data = write_numbered(tmp_path / "a.mp4", codec="mjpeg", pixels="yuvj420p").read_bytes()

    def answer(handler):
        begin = int(handler.headers["Range"].strip("bytes=-"))
        handler.protocol_version = "HTTP/1.1"
        handler.close_connection = handler.headers["Connection"] == "close" or not keeps  # without a word
        if handler.headers["Connection"] != "close" and not keeps:
            return
        handler.send_response(206)
        handler.send_header("Content-Range", f"bytes {begin}-{len(data) - 1}/{len(data)}")
        handler.send_header("Content-Length", str(len(data) - begin))
        handler.end_headers()
        handler.wfile.write(data[begin:])

    with served(answer) as url:
        _, frames = play(f"{url}/a.mp4", fps=30)
    assert numbers(frames) == list(range(not keeps, 60))


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_a_clock_that_is_set_neither_stops_a_camera_nor_dates_it_anew(recording, monkeypatch, step_s):
    """NTP would silence the camera for as long as the clock was ahead, or put an hour into the recording."""
    wall_ns, set_by_s, times = time.time_ns, [0], []
    monkeypatch.setattr(time, "time_ns", lambda: wall_ns() + set_by_s[0] * 1_000_000_000)
    with open_source(f"{recording.url}/live.ts", size=(320, 180), fps=20, clock=SteadyClock()) as source:
        for frame in itertools.islice(source.frames(start_ns=0), 25):
            times.append(frame.capture_ns)
            set_by_s[0] = step_s if len(times) >= 10 else 0
    assert all(0 < later - earlier < 30_000_000_000 for earlier, later in pairwise(times))


def test_closing_ends_a_reader_that_waits(recording):
    """Ctrl-C would hang while the camera is silent."""
    grabber = StreamGrabber(f"{recording.url}/live.ts")
    source = LiveSource(grabber, SourceSettings(size=(320, 180), fps=15))
    closer = threading.Timer(0.3, source.close)
    closer.start()
    list(source.frames(start_ns=0))
    closer.join()
    source.close()


def test_a_stream_that_is_joined_between_two_keyframes_plays_from_the_next(tmp_path, free_port):
    """A drone whose picture is whole once in four seconds would be refused until the start hits that moment."""
    data = write_numbered(tmp_path / "whole.ts", 520, g="260", bf="0").read_bytes()
    packets = [data[at : at + 188] for at in range(0, len(data), 188)]
    video = [at for at, one in enumerate(packets) if one[1] & 0x40 and (one[1] & 31) << 8 | one[2] == 256]
    stop = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for packet in packets[video[7] :]:
                out.sendto(packet, ("127.0.0.1", free_port))
                if stop.wait(0.01):
                    return

    with running(send):
        try:
            assert len(play(f"udp://127.0.0.1:{free_port}", fps=30, max_frames=2)[1]) == 2
        finally:
            stop.set()


@pytest.fixture
def jpegs():
    """Serves JPEGs; ``/cut`` without the first boundary, ``/jpg`` of that kind, ``/torn`` halves, ``/page`` none."""
    stop = threading.Event()

    def answer(handler):
        page = handler.path == "/page"
        handler.send_response(200)
        kind = "text/html" if page else "multipart/x-mixed-replace; boundary=frame"
        handler.send_header("Content-Type", kind)
        handler.end_headers()
        form = "jpg" if handler.path == "/jpg" else "jpeg"
        for number in itertools.takewhile(lambda _: not stop.wait(0.02), itertools.count()):
            data = cv2.imencode(".jpg", numbered(number % 1000))[1].tobytes()
            data = data[: len(data) // 2] if handler.path == "/torn" and number % 2 else data
            head = f"Content-Type: image/{form}\r\nContent-Length: {len(data)}\r\n\r\n".encode()
            between = b"--frame\r\n" if number or handler.path != "/cut" else b""
            handler.wfile.write(b"<html>" if page else between + head + data + b"\r\n")

    with served(answer) as url:
        yield url
        stop.set()


@pytest.mark.parametrize("path", ["whole", "cut", "jpg", "torn"])
def test_a_camera_plays_whatever_its_boundaries_and_a_picture_that_is_cut_is_counted(jpegs, path):
    """A camera that every browser shows would be refused; in place of half a picture was half of an older one."""
    source, frames = play(f"{jpegs}/{path}", fps=25, max_frames=5)
    assert (source.live, source.unreadable > 0, len(frames)) == (True, path == "torn", 5)
    assert numbers(frames) == sorted(numbers(frames))
    assert path != "torn" or not any(number % 2 for number in numbers(frames))


def test_a_page_is_no_camera(jpegs, monkeypatch):
    """What is no picture would be searched for pictures for ever."""
    monkeypatch.setitem(StreamGrabber.__init__.__kwdefaults__, "open_s", 1.0)
    said = refused(f"{jpegs}/page")
    assert "cannot be opened" in said or "holds no video" in said


# -- wrong input ------------------------------------------------------------


def test_missing_and_unusable_files_are_one_sentence(tmp_path):
    """A typing error would end in a traceback."""
    for folder in ("bare", "broken", "sequence/img1"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "sequence/img1/1.jpg").touch()
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "notes.txt").write_text("not a video\n" * 50)
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(20_000))
    (tmp_path / "broken/1.jpg").write_bytes(b"no picture")
    with av.open(str(tmp_path / "tone.wav"), "w") as output:
        stream = output.add_stream("pcm_s16le", rate=8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        output.mux(stream.encode(frame))
    clip = write_numbered(tmp_path / "phone.mp4", 2)
    clip.write_bytes(clip.read_bytes().replace(b"isom", b"heic", 1))
    said = {
        "nothere.mp4": "nothere.mp4",
        "empty.mp4": "empty",
        "notes.txt": "video",
        "noise.mp4": "noise.mp4",
    }
    said |= {"bare": "no images;", "sequence": "no images of its own, its folder 'img1' does;"}
    said |= {"broken": "none of which", "tone.wav": "no video"}
    for name, words in (said | {"phone.mp4": "is a HEIC picture: convert it to JPEG"}).items():
        assert words in refused(tmp_path / name)


@pytest.mark.parametrize("spec", ["rtsp:/cam/1", "http:/10.0.0.5/a", "10.0.0.5:554/stream", "rtsp//cam/1"])
def test_an_address_with_a_slip_is_no_disk_that_may_come(spec):
    """It was waited for with exit code 1, and a disk was asked for."""
    assert "does not exist, and an address has a scheme and two slashes" in refused(spec)


def test_a_users_folder_is_found(tmp_path, monkeypatch):
    """No shell replaces the ~ in --source=~/clip.mp4: a disk was asked for."""
    monkeypatch.setenv("HOME", str(tmp_path))
    write_numbered(tmp_path / "a.mp4", 2)
    assert play("~/a.mp4")[0].frame_count == 1
    assert "a user that this machine does not know" in refused("~nobody-here/a.mp4")


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
    assert "does not exist" in refused(tmp_path / "other.sdp")
    assert "source '' does not exist" in refused("")


@pytest.mark.parametrize("hangs_up", [False, True])
def test_a_camera_that_opens_its_port_before_it_answers_is_waited_for(hangs_up):
    """After a power cut both boot at once: the edge would hang, or end with code 2 for good."""
    with socket.create_server(("127.0.0.1", 0)) as booting:

        def hang_up() -> None:
            booting.accept()[0].close()

        grabber = StreamGrabber(f"rtsp://127.0.0.1:{booting.getsockname()[1]}/cam", open_s=0.5)
        if hangs_up:
            threading.Thread(target=hang_up).start()
        with pytest.raises(NotYetError, match=r"within 0\.5 s \(no answer of RTSP in time\)"):
            grabber.open()


@pytest.mark.parametrize(
    ("spec", "settings", "says"),
    [
        ("/dev/video97", {}, "/dev/video97 does not exist"),
        (os.devnull, {}, "no video device"),
        ("/dev/" + "x" * 300, {}, "cannot be looked at"),
        ("x" * 300, {}, "does not exist"),
        *(
            ("demo", {"size": size}, f"{size[0]}x{size[1]}")
            for size in ((1281, 720), (1280, 719), (62, 720), (1280, 8194), (0, 0), (-64, 64))
        ),
        *(("demo", {"fps": fps}, "--fps") for fps in (0.0, -1.0, 240.5, float("nan"), float("inf"))),
        ("demo", {"source_fps": -1.0}, "--source-fps"),
    ],
)
def test_what_cannot_be_is_one_sentence(spec, settings, says):
    """A pasted text would end in a traceback, and a size or a rate in a crash of the encoder."""
    assert says in refused(spec, **settings)


@pytest.mark.parametrize("growing", [False, True])
def test_a_pipe_is_no_clip(tmp_path, growing):
    """It was called an empty file, and with ``--follow`` waited for without a word."""
    os.mkfifo(tmp_path / "a.ts")
    for spec in (tmp_path / "a.ts", "-", "pipe:0", "rtspsrc location=rtsp://10.0.0.5/1 ! appsink"):
        assert "is neither a file nor a folder" in refused(spec, growing=growing)


def test_a_clip_in_memory_is_no_camera():
    """/dev/shm is where a clip is put that no disk should slow down."""
    with tempfile.NamedTemporaryFile(dir="/dev/shm") as clip:
        assert "is an empty file" in refused(clip.name)


def test_a_file_that_another_program_will_write_is_waited_for(tmp_path, monkeypatch):
    """An edge that starts before the recorder would end with code 2, and no supervisor starts it again."""
    monkeypatch.setattr(container, "QUIET_S", 0.0)
    says = ["does not exist", "empty so far", "is not a video that can be read"]
    for content, words in zip((None, b"", bytes(100)), says, strict=True):
        if content is not None:
            (tmp_path / "growing.ts").write_bytes(content)
        with pytest.raises(NotYetError, match=words):
            open_source(str(tmp_path / "growing.ts"), **BASE, growing=True)
