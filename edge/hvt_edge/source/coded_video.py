"""An HEVC clip whose own units are the base stream: each frame once, with its unit, at its own time."""

from __future__ import annotations

import logging
from collections.abc import Generator, Iterator
from contextlib import closing
from typing import Any

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS, exact_rate
from hvt_common.values import Frame
from hvt_edge.source.camera_stream import (
    LONG_STEP_S,
    REENCODE,
    CameraDecoder,
    CameraUnits,
    check_picture,
    check_stream,
    open_units,
    rate_of,
    without_jumps,
)
from hvt_edge.source.contract import CameraStream, ClipSource, Notes, SeenUnit, SourceSettings
from hvt_edge.source.decoding.container import about_times, name_of, open_video, packets_of, survey
from hvt_edge.source.decoding.timeline import Stamps
from hvt_edge.source.resample import Resizer

_log = logging.getLogger(__name__)

_MOST_SURVEY_S, _MOST_SURVEYED = 600.0, 40_000
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
                yield self._resizer.coded_frame(
                    picture.bgr(), unit, index=count + left_out - before, capture_ns=start_ns + last_ns
                )
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
        if len(seen) == _MOST_SURVEYED or surveyed_s > _MOST_SURVEY_S:
            break
    return seen
