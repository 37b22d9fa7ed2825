"""Network streams (RTSP, RTMP, HTTP, UDP, TCP, SRT, and RTP as an SDP file describes it) through PyAV."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from fractions import Fraction
from functools import partial
from typing import Any

import av
import av.container.core
import av.error

from hvt_common.errors import NotYetError, UserError
from hvt_common.redaction import redacted
from hvt_common.units import SECOND_NS
from hvt_edge.source.contract import Notes
from hvt_edge.source.decoding.container import (
    DEMUX_OPTIONS,
    Decoder,
    cause_of,
    choose_stream,
    is_local,
    is_picture_each,
)
from hvt_edge.source.decoding.pictures import Pictures
from hvt_edge.source.live import LEAST_PATIENCE_S, Shot, SignalLost

LIVE_SCHEMES = frozenset({"rtsp", "rtsps", "rtmp", "rtmps", "http", "https", "udp", "rtp", "tcp", "srt"})

_OPEN_S = 10.0
_UNDECODED_S, FIRST_S = 10.0, 30.0
"""Longest time without a picture while packets come, and before the first: x264 sends each 250 one a keyframe."""
NO_PICTURE = "what it sends gives no picture: does a keyframe come?"
_MOST_TIMES = 64

_NEVER = (
    *(av.error.HTTPUnauthorizedError, av.error.HTTPForbiddenError, av.error.HTTPBadRequestError),
    *(av.error.ProtocolNotFoundError, av.error.InvalidDataError, av.error.PermissionError, ValueError),
)
"""Errors that waiting cannot mend; with any other the camera or server may start after us."""
_STAMPED = frozenset({"mpegts", "rtsp", "rtp", "sdp", "flv"})
"""Formats whose time stamps are the sender's; for pictures in a row FFmpeg invents them."""
_IN_SEGMENTS = "hls"
"""The format in which seconds come at once: each packet is held back until it is due by its own time."""
_OF_NO_SIZE = ("_pipe", "jpeg", "hls", "sdp")
"""Endings of the formats of which the size is one picture's, a description's, or invented by a camera."""
_LEAST_INVENTED = 2**31 - 1
"""Cameras that send for ever give such lengths, for HTTP wants one."""
_PLAYLIST = ".m3u8"
_BEHIND_S, _MOST_STEP_S = 1.0, 1
_WINDOW_S, _WAITS_SHARE = 1.0, 0.1
"""Who has waited for packets for a tenth of the last second has none that wait for him."""
_GROWS, _KNOWN_S = 5, 60.0
"""Who falls behind in so many seconds in a row is too slow; for a minute after that one is enough."""
_MOST_LATE_S, _MOST_EARLY_S = 0.5, 1.0
"""A packet later or earlier than this sets the time for the next ones: after a stall, or a jump of the stamps."""
_OPTIONS = {
    **DEMUX_OPTIONS,
    "rtsp_flags": "prefer_tcp",  # by UDP, where a camera has no more, a busy switch loses packets of keyframes
    "fflags": "nobuffer",
    "flags": "low_delay",
    "analyzeduration": "2000000",
    "buffer_size": "4194304",  # of a UDP socket, where the system allows that much (net.core.rmem_max)
    "reorder_queue_size": "500",  # FFmpeg's own, which `nobuffer` removes; late datagrams are waited for
}


class StreamGrabber:
    """Decodes a stream as it arrives, without frame threading, which would hold frames back.

    A password in ``url`` is never printed; ``open_s`` bounds each opening, which takes two seconds from a
    keyframe on; ``read_s`` bounds the wait for more.
    """

    notes: Notes | None = None

    def __init__(self, url: str, *, open_s: float = _OPEN_S, read_s: float = LEAST_PATIENCE_S) -> None:
        self.name = redacted(url)
        self._url, self._open_s = url, open_s
        self._read_s = max(read_s, _UNDECODED_S) if _PLAYLIST in url.lower() else read_s
        self._container: Any = None
        self.notes = notes = Notes(self.name)
        self._choose = partial(choose_stream, note=notes)
        self._pictures = Pictures(notes)
        self._shots: Iterator[Shot] = iter(())

    def open(self) -> None:
        """Open, if it is not open yet. Raises `UserError` if there is no video within ``open_s``."""
        if self._container is None:
            self._start()

    @property
    def holds_a_clip(self) -> bool:
        """Whether it has a known duration, or a size: a file behind an address, not a live stream."""
        sized = 0 < self._container.size < _LEAST_INVENTED
        return (sized and not self._container.format.name.endswith(_OF_NO_SIZE)) or bool(
            self._container.duration
        )

    def restart(self) -> None:
        self.close()
        self._start()

    def grab(self) -> Shot:
        """The next frame, at most the read timeout from now."""
        try:
            shot = next(self._shots, None)
        except av.error.ExitError as error:
            raise SignalLost(f"nothing came for {self._read_s:.3g} s") from error
        except (av.error.FFmpegError, OSError) as error:
            raise SignalLost(cause_of(error)) from error
        if shot is None:
            raise SignalLost("it ended")
        return shot

    def close(self) -> None:
        self._shots = iter(())
        if self._container is not None:
            self._container.close()
            self._container = None

    def _start(self) -> None:
        container = _open(self._url, open_s=self._open_s, read_s=self._read_s)
        stream = self._choose(container)
        if stream is None:
            may_come = not container.duration  # a booting camera describes itself before its encoder runs
            container.close()
            kind = NotYetError if may_come else UserError
            raise kind(f"source {self.name} holds no video stream")
        try:
            shots = self._read(container, stream)
        except UserError:
            container.close()
            raise
        self._container, self._shots = container, shots

    def _read(self, container: Any, stream: Any) -> Iterator[Shot]:
        # Read from now on; raises UserError if the stream is refused.
        stream.thread_type = "SLICE"
        self._pictures.begin(stream)
        return _decoded(container, stream, self._pictures)


def is_stamped(container: Any) -> bool:
    """Whether the container's time stamps are the sender's."""
    return not _STAMPED.isdisjoint(container.format.name.split(","))


def _decoded(container: Any, stream: Any, pictures: Pictures) -> Iterator[Shot]:
    # Undecodable packets are left out: joined between keyframes, and not counted, or losses.
    times: dict[Fraction, int] = {}
    damaged: int | None = None
    until_s, stamped, decoder = time.monotonic() + FIRST_S, is_stamped(container), Decoder(stream)
    missed = 0
    for packet, left_out in _in_time(
        live_packets_of(container, stream), partial(_note_gap, stream, pictures)
    ):
        missed += left_out
        camera_ns = camera_time_ns(packet, stamped=stamped)
        if packet.pts is not None and camera_ns is not None:
            times[packet.pts * packet.time_base] = camera_ns
        try:
            decoded = decoder.decode(packet, now_s=time.monotonic())
        except av.error.FFmpegError:
            decoded = []
            damaged = None if damaged is None else damaged + is_picture_each(stream)
        if decoder.patched:
            pictures.say("damaged pictures come, shown as the decoder has patched them")
        if decoded or left_out:
            until_s = time.monotonic() + _UNDECODED_S
        elif time.monotonic() > until_s:
            raise SignalLost(NO_PICTURE)
        for coded in decoded:
            for frame in pictures.frames(coded):
                base = frame.time_base
                at_s = None if frame.pts is None or base is None else frame.pts * base
                camera_ns = None if at_s is None else times.pop(at_s, None)
                yield Shot(partial(pictures.bgr, frame), camera_ns, missed=missed, damaged=damaged or 0)
                damaged = missed = 0
        if len(times) > _MOST_TIMES:
            times.clear()


def _note_gap(stream: Any, pictures: Pictures) -> None:
    stream.codec_context.flush_buffers()
    pictures.say(
        "it comes faster than this machine decodes it: its pictures stop up to a keyframe at times; let the camera "
        "send fewer or smaller ones"
    )


def _in_time(packets: Iterator[Any], note_gap: Callable[[], None]) -> Iterator[tuple[Any, int]]:
    # Each packet, and how many were left out before it. Where decoding falls behind for seconds, those up to a
    # keyframe are: they would wait longer and longer, and be called live (to `CameraClock` a queue that grows looks
    # like stamps that count another second). After one stall it catches up, and nothing is left out.
    late_s = was_late_s = waited_s = 0.0
    grew = left_out = count = between = 0
    requested_s = since_s = before_s = time.monotonic()
    known_s = -math.inf
    before_at: Fraction | None = None
    for packet in packets:
        now_s, at = time.monotonic(), None if packet.dts is None else packet.dts * packet.time_base
        waited_s += now_s - requested_s
        if at is not None and before_at is not None and 0 <= at - before_at < _MOST_STEP_S:
            late_s = max(0.0, late_s + now_s - before_s - float(at - before_at))
        before_s, before_at = now_s, at
        if now_s - since_s > _WINDOW_S:
            late_s *= waited_s < _WAITS_SHARE * (now_s - since_s)
            grew = grew + 1 if late_s > was_late_s else 0
            was_late_s, waited_s, since_s = late_s, 0.0, now_s
        count += 1
        if packet.is_keyframe:
            between, count = count, 0
        if left_out:
            leave = not packet.is_keyframe or late_s > _BEHIND_S / 2
        else:  # a film that is refreshed without keyframes is decoded whole
            slow = grew >= (1 if now_s - known_s < _KNOWN_S else _GROWS)
            leave = slow and late_s > _BEHIND_S and count < 2 * between
        if leave:
            left_out += 1
        else:
            if left_out:
                note_gap()
                grew, known_s = 0, now_s
                was_late_s, waited_s, since_s = late_s, 0.0, now_s
            yield packet, left_out
            left_out = 0
        requested_s = time.monotonic()


class _PyAvClock:
    # PyAV skips packets of a stream number that was not there at the start, as of another program, and restarts its
    # timeout at each. From the time that `live_packets_of` sets on, this clock leaps ahead, so that PyAV gives up.

    here = threading.local()
    _leaps = itertools.count(1)

    @classmethod
    def monotonic(cls) -> float:
        now_s = time.monotonic()
        late = now_s > getattr(cls.here, "until_s", math.inf)
        return now_s + 3600 * next(cls._leaps) if late else now_s


av.container.core.time = _PyAvClock  # type: ignore[attr-defined]


def live_packets_of(container: Any, stream: Any) -> Iterator[Any]:
    """The packets of the film as they come. Raises `SignalLost` after ten seconds of other packets alone."""
    packets = container.demux()  # for the film alone it would not return while others come
    until_s = time.monotonic() + _UNDECODED_S
    in_segments, zero_s = container.format.name == _IN_SEGMENTS, None
    while True:
        packet: Any = None
        _PyAvClock.here.until_s = until_s
        try:
            packet = next(packets)
        except (StopIteration, IndexError):  # the second as in `container.packets_of`
            return
        except av.error.ExitError:
            if time.monotonic() <= until_s:
                raise
        finally:
            _PyAvClock.here.until_s = math.inf
        late = time.monotonic() > until_s
        if packet is not None and packet.stream.index == stream.index:
            if in_segments and packet.dts is not None:
                zero_s = _held_back(float(packet.dts * packet.time_base), zero_s)
            yield packet
            until_s = time.monotonic() + _UNDECODED_S
        if late:
            raise SignalLost("it sends no picture")


def _held_back(at_s: float, zero_s: float | None) -> float:
    # Wait until a packet of that time is due; ``zero_s`` is the clock's time of stamp 0, which it returns.
    now_s = time.monotonic()
    if zero_s is None or not -_MOST_LATE_S < zero_s + at_s - now_s < _MOST_EARLY_S:
        return now_s - at_s
    time.sleep(max(0.0, zero_s + at_s - now_s))
    return zero_s


def camera_time_ns(packet: av.Packet[Any], *, stamped: bool) -> int | None:
    """The packet's capture time by the camera's clock, in nanoseconds; None where unknown.

    With RTCP sender reports, which carry the camera's time (RFC 3550, 6.4.1), it is Unix time; of the stream's own
    stamps, if it is ``stamped``, only the differences count.
    """
    if packet.has_sidedata("prft"):
        return 1000 * int.from_bytes(bytes(packet.get_sidedata("prft"))[:8], "little")
    if not stamped or packet.pts is None or packet.time_base is None:
        return None
    return round(packet.pts * packet.time_base * SECOND_NS)


def is_description(spec: str) -> bool:
    """Whether it is a file that describes a stream which is sent to us (SDP, RFC 8866)."""
    return spec.lower().endswith(".sdp") and is_local(spec)


def _open(url: str, *, open_s: float, read_s: float) -> Any:
    how: dict[str, Any] = {"options": _OPTIONS, "timeout": (open_s, read_s)}
    try:
        if is_description(url):
            how["options"] = {**_OPTIONS, "protocol_whitelist": "file,udp,rtp"}
            return av.open(f"file:{url}", format="sdp", **how)
        container = av.open(url, **how)
        if container.format.name != "mpjpeg" or container.streams.video[0].codec_context.width:
            return container
        container.close()
        raise av.error.InvalidDataError(1, "no picture")
    except (av.error.FFmpegError, OSError, ValueError) as error:
        name, cause = redacted(url), cause_of(error)
        kind = UserError if isinstance(error, _NEVER) else NotYetError
        if isinstance(error, av.error.ProtocolNotFoundError):
            cause = (
                "PyAV is built without it: ffmpeg -i ADDRESS -c copy -f mpegts udp://127.0.0.1:PORT brings it"
            )
        if isinstance(error, av.error.InvalidDataError) and url.lower().startswith("rtsp"):
            # FFmpeg reports no answer, or half of one, like this too: a camera that boots opens its port first.
            kind, cause = NotYetError, "no answer of RTSP in time"
        if isinstance(error, av.error.InvalidDataError) and url.lower().startswith("http"):
            # Its JPEGs without the first boundary, as image/jpg, or of another length than it says: FFmpeg finds them
            # by their own beginnings.
            with suppress(av.error.FFmpegError, OSError):
                return _pictures_of(av.open(url, format="mjpeg", **how), name)
    # A password was probably misread as part of the address.
    odd = set("/?#[]") & set(url.partition("://")[2].rpartition("@")[0])
    spelt = "; in a password write / ? # [ ] as %2F %3F %23 %5B %5D" if odd else ""
    raise kind(f"source {name} cannot be opened within {open_s:g} s ({cause}){spelt}")


def _pictures_of(container: Any, name: str) -> Any:
    # The container, if it holds pictures; raises `OSError` where other data was taken for pictures.
    if container.size == 0:
        container.close()
        raise NotYetError(f"source {name} is empty so far")
    codec = next(iter(container.streams.video)).codec_context
    if codec.width and codec.height:
        return container
    container.close()
    raise OSError
