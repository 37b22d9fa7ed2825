"""A network stream that goes on without its picture."""

import io
import itertools
import socket
import threading
from contextlib import suppress
from fractions import Fraction
from types import SimpleNamespace
from unittest import mock

import av
import cv2
import numpy as np
import pytest

from hvt_codecs.passthrough import sources
from hvt_codecs.passthrough.camera import Passthrough
from hvt_codecs.passthrough.sources import CodedStreamGrabber
from hvt_common.errors import NotYetError, UserError
from hvt_edge.source import stream
from hvt_edge.source.decoding.container import choose_stream
from hvt_edge.source.live import SignalLost
from hvt_edge.source.opening import open_source
from hvt_edge.source.stream import StreamGrabber, _decoded, _in_time
from media.numbered import numbered


def film_that_stops(*, pictures: int = 10, tones: int = 200, **options: str) -> io.BytesIO:
    """MPEG-TS: pictures, sound beside them and for long after."""
    data = io.BytesIO()
    with av.open(data, "w", format="mpegts", options=options) as output:
        film, sound = output.add_stream("libx265", rate=25), output.add_stream("mp2", rate=48_000)
        film.width, film.height, film.options = 128, 64, {"tune": "zerolatency", "x265-params": "log-level=0"}
        for number in range(pictures):
            picture = av.VideoFrame.from_ndarray(np.full((64, 128, 3), number, np.uint8), format="rgb24")
            output.mux(film.encode(picture))
        output.mux(film.encode(None))
        for number in range(tones):
            tone = av.AudioFrame.from_ndarray(np.zeros((1, 2 * 1152), np.int16), layout="stereo")
            tone.sample_rate, tone.pts, tone.time_base = 48_000, 1152 * number, Fraction(1, 48_000)
            output.mux(sound.encode(tone))
    data.seek(0)
    return data


@pytest.fixture
def quarters(monkeypatch):
    """Each look at the clock takes a quarter of a second."""
    seconds = itertools.count()
    for module in (stream, sources):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(seconds) / 4))


def stops(grabber, url: str, says: str, *, shows: bool = False) -> None:
    camera = grabber(url)
    camera.open()
    assert not shows or camera.grab()
    with pytest.raises(SignalLost, match=says):
        all(iter(camera.grab, None))
    camera.close()


@pytest.mark.parametrize("grabber", [StreamGrabber, CodedStreamGrabber])
def test_a_camera_of_which_sound_alone_goes_on_has_stopped(monkeypatch, grabber, quarters):
    """It would never be opened again: where a camera's encoder hangs, its microphone or its telemetry does not."""
    connection = av.open(film_that_stops())
    monkeypatch.setattr(av, "open", lambda _url, **_settings: connection)
    stops(grabber, "tcp://camera", "no picture", shows=True)


def test_a_stream_that_comes_in_segments_is_played_by_its_own_time(tmp_path, monkeypatch):
    """Of two seconds of live HLS, which come at once, one picture was shown."""
    now_s = [0.0]
    clock = SimpleNamespace(
        monotonic=lambda: now_s[0], sleep=lambda wait_s: now_s.append(now_s.pop() + wait_s)
    )
    monkeypatch.setattr(stream, "time", clock)
    with av.open(str(tmp_path / "a.m3u8"), "w", options={"hls_time": "0.4"}) as output:
        film = output.add_stream("libx264", rate=25, options={"bf": "0", "g": "10"})
        film.width, film.height, film.pix_fmt = 128, 64, "yuv420p"
        for _ in range(30):
            output.mux(film.encode(av.VideoFrame(128, 64, "yuv420p")))
        output.mux(film.encode(None))
    with av.open(str(tmp_path / "a.m3u8")) as live:
        came_s = [now_s[0] for packet in stream.live_packets_of(live, live.streams.video[0]) if packet.size]
    assert came_s == pytest.approx([number / 25 for number in range(30)])


@pytest.mark.parametrize(
    ("from_s", "until_s", "decoding_s"),
    [(0, 0.1, 4.3), (20, 20.1, 1.5), (20, 20.1, 3.0), (20, 23, 0.1)],
    ids=["a slow first picture", "a stall", "a long stall", "busy for three seconds"],
)
@pytest.mark.parametrize("phase_s", [0, 0.25, 0.5, 0.75])
def test_what_is_caught_up_with_leaves_nothing_out(monkeypatch, from_s, until_s, decoding_s, phase_s):
    """A machine that was busy for a moment would freeze the picture up to the camera's next keyframe."""
    now_s, busy_until_s = [0.0], until_s + phase_s
    monkeypatch.setattr(stream, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def packets():
        for number in range(60 * 25):
            now_s[0] = max(now_s[0], number / 25)
            yield SimpleNamespace(dts=number, time_base=Fraction(1, 25), is_keyframe=number % 250 == 0)

    count = 0
    for _, left_out in _in_time(packets(), lambda: None):
        assert not left_out
        count += 1
        now_s[0] += decoding_s if from_s + phase_s <= now_s[0] < busy_until_s else 0.005
    assert count == 60 * 25


@pytest.mark.parametrize(
    ("decoding_s", "rate", "keyframes", "kept"),
    [
        (0.03, 25, 50, (1.0, 1.0)),
        (0.045, 25, 50, (0.7, 0.9)),
        (0.1, 25, 50, (0.2, 0.4)),
        (0.1, 25, 1, (0.4, 0.4)),
        (0.1, 25, 10**6, (1.0, 1.0)),
        (0.1, 8, 50, (1.0, 1.0)),
    ],
    ids=["quick", "a little slow", "slow", "slow, JPEGs", "slow, never a keyframe", "quick, wrong stamps"],
)
def test_a_camera_that_is_decoded_too_slowly_stays_live(monkeypatch, decoding_s, rate, keyframes, kept):
    """Its pictures came later and later, 14 s after half a minute, and were called live."""
    now_s, late_s, count = [0.0], [], 0
    monkeypatch.setattr(stream, "time", SimpleNamespace(monotonic=lambda: now_s[0]))

    def packets():
        for number in range(120 * rate):
            now_s[0] = max(now_s[0], number / rate)  # one that has come already is there at once
            yield SimpleNamespace(dts=number, time_base=Fraction(1, 25), is_keyframe=number % keyframes == 0)

    for packet, left_out in _in_time(packets(), lambda: None):
        assert not left_out or packet.is_keyframe
        count, late_s = count + 1, [*late_s, now_s[0] - packet.dts / rate]
        now_s[0] += decoding_s
    assert kept[0] <= count / (120 * rate) <= kept[1] + 0.02
    assert max(late_s[400:]) < 1.6 or keyframes > 50, "once the camera's second keyframe has come"


@pytest.mark.parametrize("whole", [0, 1])
def test_jpegs_that_come_slowly_are_shown_where_none_is_whole(monkeypatch, whole):
    """One each 3 s was dark after the first, and the camera opened again for ever."""
    jpeg = cv2.imencode(".jpg", numbered(0))[1].tobytes()
    broken = jpeg[: len(jpeg) // 2] + jpeg[len(jpeg) // 2 + 188 :]
    now_s, said = [0.0], []

    def packets(opened, _):
        for packet in filter(lambda one: one.size, opened.demux()):
            yield packet
            now_s[0] += 3

    monkeypatch.setattr(stream, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    monkeypatch.setattr(stream, "live_packets_of", packets)
    pictures = SimpleNamespace(say=said.append, frames=lambda frame: [frame], bgr=id)
    with av.open(io.BytesIO(jpeg * whole + broken * 6), format="mjpeg") as opened:
        shots = list(_decoded(opened, choose_stream(opened), pictures))
    assert len(shots) == whole + 5, "the first that is damaged may be one alone"
    assert set(said) == {"damaged pictures come, shown as the decoder has patched them"}


def test_a_camera_of_which_another_program_alone_goes_on_has_stopped(quarters):
    """It was dark for ever: PyAV passes over each packet of it, and waits for more of the one before."""
    another = {"mpegts_service_id": "7", "mpegts_pmt_start_pid": "496", "mpegts_start_pid": "300"}
    one, other = (film_that_stops(pictures=100, tones=0, **options).getvalue() for options in ({}, another))
    with socket.create_server(("127.0.0.1", 0)) as server:

        def send():
            with server.accept()[0] as line, suppress(OSError):
                for data in (one, *itertools.repeat(other, 500)):
                    line.sendall(data)

        sender = threading.Thread(target=send)
        sender.start()
        stops(StreamGrabber, f"tcp://127.0.0.1:{server.getsockname()[1]}", "no picture")
        sender.join()


@pytest.mark.parametrize(("grabber", "codec"), [(StreamGrabber, "libx264"), (CodedStreamGrabber, "libx265")])
def test_a_camera_that_sends_no_keyframe_is_opened_again(monkeypatch, grabber, codec, quarters):
    """The edge waited for ever, without a word: H.264 without its keyframe is no error to FFmpeg."""
    data = io.BytesIO()
    with av.open(data, "w", format="matroska") as output:
        film = output.add_stream(codec, rate=25, options={"tune": "zerolatency", "g": "1000"})
        film.width, film.height, film.pix_fmt = 128, 64, "yuv420p"
        grey = np.full(
            (96, 128), 128, np.uint8
        )  # a new frame holds anything, which may come as a cut, with a keyframe
        frames = (av.VideoFrame.from_ndarray(grey, format="yuv420p") for _ in range(200))
        packets = [one for frame in frames for one in film.encode(frame)]
        output.mux(packets[1:])
    connection = av.open(io.BytesIO(data.getvalue()))
    monkeypatch.setattr(av, "open", lambda _url, **_settings: connection)
    stops(grabber, "tcp://camera", "does a keyframe come")


@pytest.mark.parametrize("opens", [open_source, Passthrough.open_source])
@pytest.mark.parametrize(("fps", "waits_s"), [(15, 2), (0.3, 20 / 3), (0.01, 10)])
def test_a_camera_that_is_as_slow_as_was_asked_is_not_gone(monkeypatch, fps, waits_s, opens):
    """One that gives a picture each three seconds would be opened again and again, and show nothing."""
    waited = []

    def away(_url, *, timeout, **_settings):
        waited.append(timeout[1])
        raise ConnectionRefusedError

    monkeypatch.setattr(av, "open", away)
    with pytest.raises(NotYetError):
        opens("tcp://camera:554", size=(320, 180), fps=fps)
    assert waited == [pytest.approx(waits_s)]


@pytest.mark.parametrize(
    ("address", "says"), [("rtsp://camera", "holds no video"), ("http://camera", "is empty so far")]
)
def test_a_camera_that_has_no_picture_yet_is_waited_for(monkeypatch, address, says):
    """One that boots describes no stream, or answers with nothing: the edge ended with code 2, for good."""

    def answer(_url, *, format=None, **_settings):  # noqa: A002 - as PyAV has it
        if address.startswith("http") and format is None:
            raise av.error.InvalidDataError(1094995529, "Invalid data found when processing input")
        of_kind = {"format": SimpleNamespace(name="rtsp"), "streams": SimpleNamespace(video=())}
        return SimpleNamespace(**of_kind, duration=None, size=0, close=lambda: None)

    monkeypatch.setattr(av, "open", answer)
    with pytest.raises(NotYetError, match=says):
        open_source(address, size=(320, 180), fps=15)


def test_a_camera_has_as_long_when_it_is_opened_again(monkeypatch):
    """With a keyframe each 2 s one by UDP, back after a pause, was not opened within 2.5 s, and again and again."""
    opened, films = [], [av.open(film_that_stops()) for _ in range(2)]
    monkeypatch.setattr(
        av, "open", lambda _url, *, timeout, **_settings: opened.append(timeout) or films.pop()
    )
    camera = StreamGrabber("tcp://camera", read_s=7)
    camera.open()
    camera.restart()
    camera.close()
    assert opened == [(10, 7)] * 2


@pytest.mark.parametrize(
    ("lacks", "addresses"),
    [
        ("port: give", "udp://5600 udp://:5600x udp://0.0.0.0:99999 rtp://[::1] tcp://a"),
        ("port: give", "udp://127.0.0.1?localport=99999"),
        ("host: give one", "rtsp:// rtsp:///stream1 http://:80/video RTMP://user:word@/live"),
    ],
)
def test_a_stream_without_a_port_or_host_is_refused(lacks, addresses):
    """FFmpeg took 99999 or no number at all for a port, and asked this machine for the camera, for ever."""
    for address in addresses.split():
        with pytest.raises(UserError, match=f"names no {lacks}"):
            open_source(address, size=(320, 180), fps=15)


def test_a_protocol_that_pyav_lacks_is_said_with_a_way_round(monkeypatch):
    """Of SRT, which its wheels are built without, the sentence was "within 10 s (Protocol not found)"."""
    lacks = mock.Mock(side_effect=av.error.ProtocolNotFoundError(-1330794744, "Protocol not found"))
    monkeypatch.setattr(av, "open", lacks)
    with pytest.raises(UserError, match="built without it: ffmpeg -i ADDRESS -c copy"):
        open_source("srt://camera:9000", size=(320, 180), fps=15)


@pytest.mark.parametrize(
    ("given", "opened"),
    [
        *(
            (f"{one}://127.0.0.1:5600/", f"{one.lower()}://127.0.0.1:5600/")
            for one in ("RTSP", "Http", "UDP")
        ),
        ("udp://127.0.0.1?pkt_size=1316&localport=5600", "udp://127.0.0.1?…"),
    ],
)
def test_a_scheme_in_capitals_and_a_port_to_listen_on_are_taken(monkeypatch, given, opened):
    """FFmpeg knows no RTSP://, which a phone's keyboard writes (RFC 3986, 3.1), and listens on ?localport=."""
    seen = []
    monkeypatch.setattr(StreamGrabber, "open", lambda self: seen.append(self.name) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        open_source(given, size=(320, 180), fps=15)
    assert seen == [opened]
