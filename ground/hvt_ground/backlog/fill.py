"""Puts what an edge kept of one session into its recording: video into its holes, and words on how much it was."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from hvt_common.protocol.messages import BacklogUnit, Info
from hvt_common.values import Image
from hvt_ground.backlog.perception import BacklogPerception
from hvt_ground.backlog.video import BacklogVideo
from hvt_ground.events import Event, Overlay, VideoSample
from hvt_ground.link.sequence_window import SequenceWindow

__all__ = ["BacklogFill", "BacklogTotals", "Work"]

_SECOND_NS = 1_000_000_000
_LONGEST_S = 1.0
"""For so long one frame counts as video, where the next was left out."""

Work = Generator[None, None, bool | None]
"""Done step by step; returns whether that was of any use, or None where it was not done."""


@dataclass(slots=True)
class BacklogTotals:
    """How much came of what was kept."""

    stills: int = 0
    frames: int = 0
    """That can be shown and were missing."""
    left_out: int = 0
    """That are missing still, for no decoder can use them."""
    video_s: float = 0.0
    first: tuple[int, int] | None = None
    """Frame index and capture time of the oldest of it."""

    def add_still(self, frame_index: int, capture_ns: int) -> None:
        """Count a still."""
        self.stills += 1
        self._note(frame_index, capture_ns)

    def add_frame(self, frame_index: int, capture_ns: int, *, lasts_s: float) -> None:
        """Count a frame."""
        self.frames += 1
        self.video_s += lasts_s
        self._note(frame_index, capture_ns)

    def amount(self) -> str:
        """``12 stills and 31 s of video``."""
        parts = [f"{self.stills} still{'s' * (self.stills != 1)}"] if self.stills else []
        if self.frames:
            parts.append(f"{self.video_s:.{int(self.video_s < 1)}f} s of video")
        return " and ".join(parts)

    def _note(self, frame_index: int, capture_ns: int) -> None:
        if self.first is None or frame_index < self.first[0]:
            self.first = frame_index, capture_ns


class BacklogFill:
    """Of one session. All of it is for the receiving thread, save what it hands to the one that sees.

    Args:
        info: of the session.
        log: takes the events; they may lie before others that it has.
        look: finds boxes in the video; None leaves it without.
    """

    def __init__(
        self, info: Info, *, log: Callable[[Event], None], perception: BacklogPerception | None
    ) -> None:
        self._info = info
        self._log = log
        self._perception = perception
        self._frame_ns = round(_SECOND_NS / info.fps)
        self._video = BacklogVideo(base_size=info.base_size)
        self._lock = threading.Lock()
        self._frames = SequenceWindow()
        self.arrived = BacklogTotals()
        """Since the start."""
        self._news = BacklogTotals()

    def live(self, frame_index: int, data: bytes, *, keyframe: bool, after_gap: bool) -> None:
        """Note a unit that came over the link at once and was decoded."""
        with self._lock:
            self._frames.add([frame_index])
        self._video.live(frame_index, data, keyframe=keyframe, after_gap=after_gap)

    def note_still(self, frame_index: int, capture_ns: int) -> None:
        """Count a still that somebody else reads."""
        with self._lock:
            self.arrived.add_still(frame_index, capture_ns)
            self._news.add_still(frame_index, capture_ns)

    def take_news(self) -> BacklogTotals:
        """Return and forget what has come since the last call."""
        with self._lock:
            news, self._news = self._news, BacklogTotals()
            return news

    def fill(self, units: Sequence[BacklogUnit], *, boxes: Callable[[Work], bool]) -> Work:
        """Log those frames of a stretch that are missing and can be decoded.

        ``boxes`` takes the work of finding boxes in them, for the thread that sees; False where it has too much of
        that, and only the video is shown.
        """
        last: BacklogUnit | None = None
        logged: set[int] = set()
        for shown in self._video.pictures(units):
            if shown is not None and self._show(*shown, after=last):
                last = shown[0]
                logged.add(last.frame_index)
            yield
        if self._perception is not None and logged:
            boxes(self._watch(units, logged))
        return True

    def _show(self, unit: BacklogUnit, image: Image | None, *, after: BacklogUnit | None) -> bool:
        """Log a frame that is missing; False where it is not, or cannot be shown."""
        if image is None:
            with self._lock:
                self.arrived.left_out += unit.frame_index not in self._frames
            return False
        if not self._is_missing(unit.frame_index):
            return False
        self._log(VideoSample(unit.frame_index, unit.capture_ns, unit.data, unit.keyframe, stored=True))
        self._note_frame(unit, after)
        return True

    def _watch(self, units: Sequence[BacklogUnit], frames: AbstractSet[int]) -> Work:
        """Log boxes for those frames of a stretch."""
        assert self._perception is not None, "nobody watches without"
        last: BacklogUnit | None = None
        with self._perception.watch(self._log) as tracker:
            for shown in self._video.pictures(units):
                if shown is not None and shown[1] is not None and shown[0].frame_index in frames:
                    last, image = shown[0], shown[1]
                    tracker.analyze(last.frame_index, last.capture_ns, image)
                yield
        if last is not None:
            self._take_off(last)
        return True

    def _note_frame(self, unit: BacklogUnit, before: BacklogUnit | None) -> None:
        frames = 1 if before is None else unit.frame_index - before.frame_index
        lasts_s = min(frames / self._info.fps, _LONGEST_S)
        with self._lock:
            self.arrived.add_frame(unit.frame_index, unit.capture_ns, lasts_s=lasts_s)
            self._news.add_frame(unit.frame_index, unit.capture_ns, lasts_s=lasts_s)

    def _is_missing(self, frame_index: int) -> bool:
        with self._lock:
            return self._frames.add([frame_index]) > 0

    def _take_off(self, last: BacklogUnit) -> None:
        """The boxes of a stretch end with it, where nothing goes on from there."""
        with self._lock:
            if last.frame_index + 1 in self._frames:
                return
        self._log(
            Overlay(
                frame_index=last.frame_index + 1,
                capture_ns=last.capture_ns + self._frame_ns,
                track_ids=np.empty(0, np.int64),
                boxes_base_px=np.empty((0, 4), np.float32),
                base_classes=(),
                classes=(),
                confidences=np.empty(0, np.float32),
                refined=np.empty(0, np.bool_),
                stored=True,
            )
        )
