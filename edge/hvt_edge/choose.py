"""From tracks to stills: suppression, method, queue, budget, still stage, in that order.

Pure but for the pixels it codes: no threads, no clock, no network. Every candidate's fate is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from hvt_common.values import Frame, Image, Still, View
from hvt_edge.candidates import Candidate, TrackMemory
from hvt_edge.methods.base import Method, Step
from hvt_edge.methods.cost import CostModel
from hvt_edge.sight import Seen
from hvt_edge.still import NoStill, StillMaker
from hvt_edge.still_queue import QueueSettings, StillQueue, Waiting
from hvt_edge.suppress import Suppression

__all__ = ["Chooser", "ChooserSettings"]

_FULL_SHARE = 0.9
"""With so much of the most a still can ever be given, it is no use to wait for more."""
_PATIENCE_SHARE = 0.75
"""After this share of the longest wait, the most useful wish is coded to whatever room there is: one that never
gets the room it is expected to need must not hold up all others for ever."""


@dataclass(frozen=True, slots=True)
class ChooserSettings:
    """``most_bytes`` is the largest admission the budget can ever give, payload."""

    fps: float
    most_bytes: int
    queue: QueueSettings = field(default_factory=QueueSettings)


class Chooser:
    """Decides at each step who is wanted, and hands out stills as the budget has room for them.

    ``on_fate(fate, reason)`` is called with ``sent``, ``deferred`` or ``dropped`` for every candidate that a step
    did not simply pass over.
    """

    def __init__(
        self,
        method: Method,
        *,
        suppression: Suppression,
        maker: StillMaker,
        memory: TrackMemory,
        view: View,
        class_names: tuple[str, ...],
        settings: ChooserSettings,
        on_fate: Callable[[str, str], None],
    ) -> None:
        self._method = method
        self._suppression = suppression
        self._maker = maker
        self._memory = memory
        self._view = view
        self._class_names = class_names
        self._settings = settings
        self._on_fate = on_fate
        self._cost = CostModel()
        self._queue = StillQueue(settings.queue)
        self._base_frames: dict[int, Image] = {}
        self._held_up: dict[int, int] = {}
        """Track id → since when it has been the most useful and without room (ns)."""
        self._sequence = 0

    @property
    def waiting(self) -> int:
        """How many stills wait for room."""
        return len(self._queue)

    def consider(self, seen: Seen, *, now_ns: int, room_bytes: int) -> None:
        """Take in one frame's tracks; at a decision step let the method say which it wants."""
        if self._method.video_only:
            return
        if not seen.detected:
            self._memory.observe(seen.tracks, now_ns=now_ns)
            return
        candidates = self._memory.candidates(
            seen.tracks,
            view=self._view,
            class_names=self._class_names,
            now_ns=now_ns,
            source_bgr=seen.frame.source_bgr,
        )
        kept, held = self._suppression.apply(candidates, now_ns=now_ns)
        for _, reason in held:
            self._on_fate("deferred", reason)
        step = Step(
            frame_index=seen.frame.index,
            now_ns=now_ns,
            fps=self._settings.fps,
            base_size=self._view.base_size,
            cost=self._cost.estimate(),
            room_bytes=room_bytes,
        )
        for request in self._method.requests(kept, step):
            self._base_frames[seen.frame.index] = seen.base_bgr
            for _left, reason in self._queue.offer(Waiting(request, seen.frame, now_ns)):
                self._on_fate("deferred" if reason == "replaced" else "dropped", reason)

    def stills(self, *, now_ns: int, room_bytes: Callable[[], int]) -> Iterator[Still]:
        """Yield stills that fit ``room_bytes()`` (payload); the caller sends each before it asks for the next."""
        for _, reason in self._queue.expire(now_ns):
            self._on_fate("dropped", reason)
        while (waiting := self._queue.best()) is not None:
            limit_bytes = room_bytes()
            if not self._may_go(waiting, limit_bytes, now_ns=now_ns):
                break  # the most useful waits for its room; a lesser one does not slip in before it
            still = self._make(waiting, limit_bytes, now_ns=now_ns)
            if still is not None:
                yield still
        self._forget()

    def record_feedback(
        self, track_id: int, *, class_name: str, confidence: float, entropy_nats: float
    ) -> None:
        """The ground's classifier has spoken on a still of this track."""
        self._memory.record_feedback(
            track_id, class_name=class_name, confidence=confidence, entropy_nats=entropy_nats
        )

    def close(self) -> None:
        """What still waits will not be sent any more."""
        for _ in self._queue.clear():
            self._on_fate("dropped", "ended")

    def _may_go(self, waiting: Waiting, limit_bytes: int, *, now_ns: int) -> bool:
        """Whether there is as much room as it will need, or it has waited for that long enough."""
        expected_bytes = self._cost.estimate().of(waiting.request.candidate)
        if limit_bytes >= min(expected_bytes, self._settings.most_bytes * _FULL_SHARE):
            return True
        # By track, not by wish: methods wish again at each step, and every new wish takes the place of the last.
        since_ns = self._held_up.setdefault(waiting.request.candidate.track_id, now_ns)
        return now_ns - since_ns >= _PATIENCE_SHARE * self._settings.queue.max_age_ns

    def _make(self, waiting: Waiting, limit_bytes: int, *, now_ns: int) -> Still | None:
        self._queue.remove(waiting)
        self._held_up.pop(waiting.request.candidate.track_id, None)
        candidate, frame = waiting.request.candidate, waiting.frame
        made = self._maker.make(
            frame,
            waiting.request,
            sequence=self._sequence,
            view=self._view,
            limit_bytes=limit_bytes,
            base_bgr=self._base_frames.get(frame.index),
        )
        if isinstance(made, NoStill):
            self._memory.record_refused(candidate.track_id, now_ns=now_ns)
            self._on_fate("dropped", made.reason)
            return None
        self._sequence += 1
        self._record(candidate, frame, made, now_ns=now_ns)
        return made

    def _record(self, candidate: Candidate, frame: Frame, still: Still, *, now_ns: int) -> None:
        self._cost.observe(area_px=candidate.crop_area_px, size_bytes=len(still.data))
        self._memory.record_sent(
            candidate.track_id,
            frame_index=frame.index,
            now_ns=now_ns,
            area_px=candidate.area_px,
            sharpness=candidate.sharpness() if candidate.sharpness else None,
            at_border=candidate.touches_border,
        )
        self._on_fate("sent", still.reason)

    def _forget(self) -> None:
        """Keep nothing of wishes that wait no more."""
        frames = {waiting.frame.index for waiting in self._queue}
        tracks = {waiting.request.candidate.track_id for waiting in self._queue}
        self._base_frames = {index: image for index, image in self._base_frames.items() if index in frames}
        self._held_up = {
            track_id: since_ns for track_id, since_ns in self._held_up.items() if track_id in tracks
        }
