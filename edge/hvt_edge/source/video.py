"""A video file as a source, through PyAV: any codec, any rate, constant or not, upright whatever its metadata say."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from fractions import Fraction
from typing import Any

import av

from hvt_common.units import exact_rate
from hvt_common.values import Frame
from hvt_edge.source.contract import ClipSource, Notes, SourceSettings
from hvt_edge.source.decoding.container import (
    about_times,
    decoded,
    duration_s,
    name_of,
    open_video,
    survey,
)
from hvt_edge.source.decoding.pictures import Pictures
from hvt_edge.source.decoding.timeline import Stamps
from hvt_edge.source.resample import Resizer, base_frame_count, capture_time_ns, hold


class VideoSource(ClipSource):
    """A clip by presentation time; the first frame that decodes is its zero. Every decodable frame is played."""

    def __init__(self, spec: str, settings: SourceSettings) -> None:
        self._spec, self.fps = spec, settings.fps
        self._name, self._growing = name_of(spec), settings.growing
        self._override = None if settings.source_fps is None else exact_rate(settings.source_fps)
        notes = Notes(self._name)
        self._pictures = Pictures(notes)
        container, stream = open_video(spec, growing=self._growing, note=notes)
        with container:
            self._stamps, first = survey(container, stream, name=self._name)
            if self._override is not None:
                self._stamps = Stamps(1 / self._override, usable=False, whole=self._stamps.whole)
            lasts_s = self._duration_s(stream)
            self._pictures.begin(stream)
            _, shown = next(self._shown([(Fraction(0), first)]))
            picture = self._pictures.bgr(shown)
            if self._override is None:
                notes(about_times(stream, self._stamps))
        self.notes = notes.taken()
        shape = (picture.shape[1], picture.shape[0])
        self._resizer = Resizer(shape, settings.size, fit=settings.fit, name=self._name)
        self.view = self._resizer.view
        counts = [] if lasts_s is None else [max(1, base_frame_count(lasts_s, fps=exact_rate(self.fps)))]
        self._limit = settings.max_frames
        counts += [] if self._limit is None else [self._limit]
        self.frame_count = min(counts, default=None) if lasts_s is not None else None

    @property
    def source_fps(self) -> float:
        """The clip's own frame rate, as stored or as overridden."""
        return float(1 / self._stamps.period_s)

    def shown_frames(self) -> tuple[int, tuple[int, ...]]:
        """Number of frames of the clip, and the one that each base frame shows when it is played."""
        container, stream = open_video(self._spec)
        with container:
            times = [at_s for at_s, _ in decoded(container, stream, name=self._name, stamps=self._stamps)]
            slack_s = self._stamps.slack_s(stream)
        timed = ((at_s, index) for index, at_s in enumerate(times))
        held = hold(timed, fps=exact_rate(self.fps), tail_s=self._stamps.period_s, slack_s=slack_s)
        return len(times), tuple(index for _, index in held)

    def _play(self, start_ns: int) -> Generator[Frame, None, None]:
        base_rate = exact_rate(self.fps)
        container, stream = open_video(self._spec, growing=self._growing)
        self._pictures.begin(stream)
        stamps = self._stamps
        with container, closing(decoded(container, stream, name=self._name, stamps=stamps)) as frames:
            slack_s = stamps.slack_s(stream)
            held: tuple[av.VideoFrame, Frame] | None = None
            stamped = self._shown(frames)
            for index, frame in hold(stamped, fps=base_rate, tail_s=stamps.period_s, slack_s=slack_s):
                if index == self._limit:
                    return
                capture_ns = capture_time_ns(index, fps=base_rate, start_ns=start_ns)
                if held is None or held[0] is not frame:  # only shown frames are converted
                    picture = self._pictures.bgr(frame)
                    held = (frame, self._resizer.frame(picture, index=index, capture_ns=capture_ns))
                yield replace(held[1], index=index, capture_ns=capture_ns)

    def _shown(
        self, frames: Iterable[tuple[Fraction, av.VideoFrame]]
    ) -> Iterator[tuple[Fraction, av.VideoFrame]]:
        # Deinterlaces: such a frame comes when the next has been decoded, and keeps its time.
        times: deque[Fraction] = deque()
        for at_s, frame in frames:
            times.append(at_s)
            for whole in self._pictures.frames(frame):
                yield times.popleft(), whole
        for whole in self._pictures.frames(None):
            yield times.popleft(), whole

    def _duration_s(self, stream: Any) -> Fraction | None:
        if self._override:
            return stream.frames / self._override if stream.frames else None
        if not self._stamps.usable:
            return stream.frames * self._stamps.period_s or None
        return duration_s(stream)
