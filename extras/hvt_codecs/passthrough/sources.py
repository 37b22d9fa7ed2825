"""An HEVC camera, or a clip, whose own units are the base stream, each with its picture.

A camera's packets wait in a queue, in order, and are decoded as they are taken. Of pictures only the newest counts
(`hvt_edge.source.live`); each unit builds on the one before. So none is left out while the queue holds them, and when
it overflows all units up to the next keyframe are.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from hvt_codecs.passthrough.stream import (
    LONG_STEP_S,
    REENCODE,
    CameraDecoder,
    CameraStream,
    CameraUnits,
    SeenUnit,
    check_picture,
    check_stream,
    open_units,
    rate_of,
    without_jumps,
)
from hvt_common.errors import FlightError, NotYetError, UserError
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS, exact_rate
from hvt_common.values import Frame, Image
from hvt_edge.source.contract import IDLE_S, BaseSize, ClipSource, Notes, SourceSettings
from hvt_edge.source.decoding.container import about_times, name_of, open_video, packets_of, survey
from hvt_edge.source.decoding.timeline import Stamps
from hvt_edge.source.live import SOURCE_PART, Grabber, LiveSource, Shot, SignalLost
from hvt_edge.source.resample import Resizer
from hvt_edge.source.stream import (
    FIRST_S,
    NO_PICTURE,
    StreamGrabber,
    camera_time_ns,
    is_stamped,
    live_packets_of,
)

_LEAST_SURVEY_S, _MOST_SURVEY_S = 3.0, 10.0
"""A camera is surveyed before the flight until its second keyframe, within these bounds."""
MOST_OTHER_NS = 10 * SECOND_NS
"""A camera that sends pictures of another size or format for longer does not return to those of the start."""
QUEUE_S, _LEAST_QUEUED, _MOST_QUEUED_BYTES = 1.0, 8, 8 * 2**20


@dataclass(frozen=True, slots=True)
class CameraPacket:
    """A frame as coded by the camera; packets of one decoder come in order, and it needs each of them."""

    data: bytes
    at_s: float | None
    """The stream's own time stamps; None without any."""
    decoder: CameraDecoder


class CodedStreamGrabber(StreamGrabber):
    """The packets of an HEVC stream, not decoded."""

    size: tuple[int, int] | None = None
    """(width, height) of accepted pictures; None before the first."""
    said_fps: float | None = None
    """The rate in the stream's description."""

    def _read(self, container: Any, stream: Any) -> Iterator[Shot]:
        check_stream(self.name, stream)
        self.said_fps = float(stream.average_rate or 0) or None
        decoder = CameraDecoder(open_units(self.name, stream))
        decoder.expect(self.size)
        return _packets(container, stream, decoder)


def _packets(container: Any, stream: Any, decoder: CameraDecoder) -> Iterator[Shot]:
    stamped, until_s = is_stamped(container), time.monotonic() + FIRST_S
    for packet in live_packets_of(container, stream):
        if decoder.whole:
            until_s = time.monotonic() + FIRST_S
        elif time.monotonic() > until_s:  # a new connection begins with a keyframe
            raise SignalLost(NO_PICTURE)
        if packet.size:
            at_s = None if packet.pts is None else float(packet.pts * packet.time_base)
            taken = CameraPacket(bytes(packet), at_s, decoder)
            yield Shot(partial(_picture, taken), camera_time_ns(packet, stamped=stamped), taken)


def _picture(packet: CameraPacket) -> Image:
    decoded = packet.decoder.decode(packet.data)
    if decoded is None:
        raise SignalLost(packet.decoder.trouble or "no keyframe has come")
    return decoded[1].bgr()


@dataclass(frozen=True, slots=True)
class _Queued:
    number: int
    """Number of the camera's packet; a gap was lost here."""
    capture_ns: int
    packet: CameraPacket


class CodedLiveSource(LiveSource):
    """Every unit of the camera with its picture. ``fps`` follows its time stamps; see `LiveSource` for the rest.

    Opening takes three to ten seconds, in which `camera_stream` is measured. Raises `UserError` where its units
    cannot be the base stream.
    """

    def __init__(
        self,
        grabber: CodedStreamGrabber,
        settings: SourceSettings,
        *,
        clock: Callable[[], int] | None = None,
        failures: Failures | None = None,
    ) -> None:
        self.warning = ""
        self._queue: deque[_Queued] = deque()
        self._queued_bytes = self._number = 0
        self._other_since_ns: int | None = None
        self._skips = False
        """Units are left out up to the next keyframe because the reader was too slow for some."""
        super().__init__(grabber, replace(settings, fps=1.0), clock=clock, failures=failures)

    def steps(self, *, start_ns: int) -> Iterator[Frame | None]:  # noqa: ARG002 - a camera has its own time
        """See `Source`. The first frame is a keyframe."""
        first = newest = None
        decoder: CameraDecoder | None = None
        count = 0
        while count != self._limit:
            with self._news:
                self._news.wait_for(lambda: self._queue or self._stop.is_set(), IDLE_S)
                item = self._queue.popleft() if self._queue else None
                self._queued_bytes -= 0 if item is None else len(item.packet.data)
            if self._stop.is_set():
                return
            if item is None:
                yield None
                continue
            if item.packet.decoder is not decoder or newest is None or item.number != newest + 1:
                self._skips = item.packet.decoder is decoder  # a camera that begins anew has lost them itself
                decoder = item.packet.decoder
                decoder.skip()
            newest = item.number
            frame = self._frame(item, index=0 if first is None else item.number - first)
            if frame is None:
                if first is not None:  # before its first keyframe there is no flight
                    self._note_left_out()
                yield None
                continue
            first = item.number if first is None else first
            yield frame
            count += 1

    def _frame(self, item: _Queued, *, index: int) -> Frame | None:
        # None where the unit cannot be sent: damaged, or of a picture of which units were missed.
        decoder = item.packet.decoder
        decoded = decoder.decode(item.packet.data)
        if decoded is None:
            if decoder.trouble:
                self._failures.failed(
                    SOURCE_PART, f"{self._grabber.name} sends what cannot be passed on ({decoder.trouble})"
                )
                self._check_other(decoder, item.capture_ns)
            return None
        self._failures.works(SOURCE_PART)
        self._skips, self._other_since_ns = False, None
        unit, picture = decoded
        frame = self._resizer.frame(picture.bgr(), index=index, capture_ns=item.capture_ns)
        return replace(frame, camera_unit=unit)

    def _check_other(self, decoder: CameraDecoder, now_ns: int) -> None:
        # A new start accepts the size and format that the camera sends now.
        if not decoder.is_other:
            self._other_since_ns = None
            return
        self._other_since_ns = self._other_since_ns or now_ns
        if now_ns - self._other_since_ns > MOST_OTHER_NS:
            raise FlightError(
                f"source {self._grabber.name} has changed ({decoder.trouble}), and --encoder passthrough sends what"
                " it began with: start the edge again"
            )

    def _note_left_out(self) -> None:
        with self._news:
            self.missed += self._skips
            self.unreadable += not self._skips

    def _take(self, shot: Shot, capture_ns: int, *, jitter_ns: int) -> None:  # noqa: ARG002 - each has its place
        packet = shot.packet
        assert isinstance(packet, CameraPacket), "a CodedStreamGrabber gives no other"
        with self._news:
            self._number += 1
            self._queue.append(_Queued(self._number, capture_ns, packet))
            self._queued_bytes += len(packet.data)
            most = max(_LEAST_QUEUED, round(QUEUE_S * self.fps))
            if len(self._queue) > most or self._queued_bytes > _MOST_QUEUED_BYTES:
                self.missed += len(self._queue)
                self._queue.clear()
                self._queued_bytes = 0
            self._news.notify_all()

    def _first_size(self, grabber: Grabber, size: BaseSize) -> tuple[int, int]:
        # Survey the camera until its second keyframe.
        assert isinstance(grabber, CodedStreamGrabber), "the constructor takes no other"
        seen: list[SeenUnit] = []
        began_s, trouble = time.monotonic(), "no keyframe came"
        while (surveyed_s := time.monotonic() - began_s) < _MOST_SURVEY_S:
            if surveyed_s > _LEAST_SURVEY_S and sum(unit.keyframe for unit in seen) > 1:
                break
            packet = grabber.grab().packet
            assert isinstance(packet, CameraPacket), "a CodedStreamGrabber gives no other"
            decoded = packet.decoder.decode(packet.data)
            if decoded is None:
                trouble = packet.decoder.trouble or trouble
                continue
            unit, picture = decoded
            if grabber.size is None:
                self.warning = check_picture(grabber.name, picture.frame, size=size)
                grabber.size = picture.size
                packet.decoder.expect(picture.size)
            at_s = time.monotonic() - began_s if packet.at_s is None else packet.at_s
            seen.append(SeenUnit(at_s, len(unit.data), unit.keyframe))
        if grabber.size is None or len(seen) < 2:
            raise NotYetError(
                f"source {grabber.name} gave no HEVC picture that can be passed on within {_MOST_SURVEY_S:g} s "
                f"({trouble})"
            )
        self.fps = rate_of(grabber.name, seen, said=grabber.said_fps)
        self.camera_stream = CameraStream(without_jumps(seen), self.fps)
        return grabber.size


_log = logging.getLogger(__name__)

_MOST_CLIP_S, _MOST_SURVEYED = 600.0, 40_000
"""The part of a clip that is surveyed before the flight."""


class CodedVideoSource(ClipSource):
    """A clip by presentation time, from its first keyframe on. No frame is left out: its rate is the base rate.

    Raises `UserError` where its units cannot be the base stream.
    """

    def __init__(self, spec: str, settings: SourceSettings) -> None:
        self._spec, self._name = spec, name_of(spec)
        self._limit, self._growing = settings.max_frames, settings.growing
        self._hidden = 0
        """Pictures that a player does not show."""
        notes = Notes(self._name)
        container, stream = open_video(spec, growing=self._growing, note=notes)
        with container:
            check_stream(self._name, stream)
            self._stamps, first = survey(container, stream, name=self._name)
            if settings.source_fps is not None:
                self._stamps = Stamps(1 / exact_rate(settings.source_fps), usable=False)
        self.warning = check_picture(self._name, first, size=settings.size)
        self._size = (first.width, first.height)
        self._resizer = Resizer(self._size, settings.size, fit=settings.fit)
        self.view = self._resizer.view
        container, stream = open_video(spec, growing=self._growing)
        with container:
            said = float(1 / self._stamps.period_s)
            seen = _seen(self._timed(container, stream), open_units(self._name, stream))
            if len(seen) < 2:
                raise UserError(f"source {self._name!r} holds no keyframe that a ground could begin with")
            self.fps = rate_of(self._name, seen, said=said)
            frames = stream.frames
            self.frame_count = None if not frames else min(frames, settings.max_frames or frames)
            if settings.source_fps is None:
                notes(about_times(stream, self._stamps))
            if self._hidden:
                notes(
                    f"its edit list hides {self._hidden} of its pictures, and --encoder passthrough sends all: times"
                    f" and poses count from the first of them; {REENCODE} to leave them out"
                )
        self.notes = notes.taken()
        self.camera_stream = CameraStream(without_jumps(seen), self.fps)

    def _play(self, start_ns: int) -> Generator[Frame, None, None]:
        container, stream = open_video(self._spec, growing=self._growing)
        left_out, before, count, zero_s, begun, last_ns = 0, 0, 0, 0.0, False, -1
        decoder = CameraDecoder(open_units(self._name, stream))
        decoder.expect(self._size)
        packets = self._timed(container, stream, say=True)
        with container, closing(packets):
            for at_s, packet in packets:
                if count == self._limit:
                    return
                decoded = decoder.decode(packet)
                if decoded is None:
                    left_out += 1
                    self.unreadable = left_out - before if begun else 0
                    continue
                if not begun:
                    begun, zero_s, before = True, at_s, left_out
                unit, picture = decoded
                # Two pictures with one time would count as one at the ground.
                last_ns = max(last_ns + 1, round((at_s - zero_s) * SECOND_NS))
                index, capture_ns = count + left_out - before, start_ns + last_ns
                frame = self._resizer.frame(picture.bgr(), index=index, capture_ns=capture_ns)
                yield replace(frame, camera_unit=unit)
                count += 1
        if left_out:
            why = f" ({decoder.trouble})" if decoder.trouble else ""
            _log.warning("%s: %d units could not be passed on%s", self._name, left_out, why)

    def _timed(
        self, container: Any, stream: Any, *, say: bool = False
    ) -> Generator[tuple[float, bytes], None, None]:
        # (seconds, packet) in order; a jump of the time stamps is mended, and logged if ``say``.
        timeline = self._stamps.timeline(stream)
        for packet in packets_of(container, stream):
            if isinstance(packet, Exception) or not packet.size:  # a broken file plays so far
                continue
            self._hidden += packet.is_discard
            usable = self._stamps.usable and packet.pts is not None
            yield float(timeline.at(packet.pts * packet.time_base if usable else None)), bytes(packet)
        if say and (sentence := timeline.says):
            _log.warning("%s: %s", self._name, sentence)


def _seen(packets: Iterator[tuple[float, bytes]], units: CameraUnits) -> list[SeenUnit]:
    # Measure the bytes of the clip, without decoding it.
    seen: list[SeenUnit] = []
    surveyed_s = before_s = 0.0
    for at_s, packet in packets:
        try:
            unit = units.unit(packet)
        except ValueError:
            continue  # as in flight, where it is counted
        if seen or unit.keyframe:
            seen.append(SeenUnit(at_s, len(unit.data), unit.keyframe))
        surveyed_s += min(LONG_STEP_S, max(0.0, at_s - before_s))  # a jump of the time stamps is no time
        before_s = at_s
        if len(seen) == _MOST_SURVEYED or surveyed_s > _MOST_CLIP_S:
            break
    return seen
