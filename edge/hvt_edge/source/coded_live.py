"""An HEVC camera whose own units are the base stream: packets in a queue, in order, decoded as they are taken.

Of pictures only the newest counts (`hvt_edge.source.live`); each unit builds on the one before. So none is left
out while the queue holds them, and when it overflows all units up to the next keyframe are.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from hvt_common.errors import FlightError, NotYetError
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame, Image
from hvt_edge.source.camera_stream import (
    CameraDecoder,
    check_picture,
    check_stream,
    open_units,
    rate_of,
    without_jumps,
)
from hvt_edge.source.contract import BaseSize, CameraStream, SeenUnit, SourceSettings
from hvt_edge.source.live import IDLE_S, SOURCE_PART, CameraPacket, Grabber, LiveSource, Shot, SignalLost
from hvt_edge.source.stream import (
    FIRST_S,
    NO_PICTURE,
    StreamGrabber,
    camera_time_ns,
    is_stamped,
    packets_of,
)

_LEAST_SURVEY_S, _MOST_SURVEY_S = 3.0, 10.0
"""A camera is surveyed before the flight until its second keyframe, within these bounds."""
MOST_OTHER_NS = 10 * SECOND_NS
"""A camera that sends pictures of another size or format for longer does not return to those of the start."""
QUEUE_S, _LEAST_QUEUED, _MOST_QUEUED_BYTES = 1.0, 8, 8 * 2**20


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
    for packet in packets_of(container, stream):
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
        return self._resizer.coded_frame(picture.bgr(), unit, index=index, capture_ns=item.capture_ns)

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
        assert packet is not None, "a CodedStreamGrabber gives no other"
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
            assert packet is not None, "a CodedStreamGrabber gives no other"
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
