"""Stills that somebody asked for: cut at once from the frames of the last seconds, sent before all others.

Asking only cuts (`OnDemand.ask`, in the link's callback); coding and sending are the still thread's
(`OnDemand.stills`), under the same budget as every other still. One that was asked for is not held to what the base
shows of the place: whoever asks has a reason. It is coded at the quality asked for as soon as the budget has that
much room; where it never has, or not within `OnDemandSettings.patience_ns`, at the largest size, then the best
quality, for which there is. While one waits for room, no other still takes it away.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from hvt_common.protocol.messages import MAX_TRACKS_NOW, TrackNow
from hvt_common.values import Still, View
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.crop_job import CropJob
from hvt_edge.stills.maker import NoStill, Room, StillMaker
from hvt_edge.stills.on_demand_crop import Ask, RefusedError, box_of, crop_job_for, frame_for, shrunk

__all__ = ["REQUEST_PARAMETER", "OnDemand", "OnDemandSettings"]

REQUEST_PARAMETER = "ask"
"""The parameter that carries its number."""

_FULL_SHARE = 0.9
"""With so much of the most a still can ever be given, it is no use to wait for more."""
_LEAST_BYTES = 400
"""A budget that never gives a still more than this has none to give."""
_SHRINKS = (1.0, 0.7, 0.5, 0.35, 0.25)
_FLOOR_PCT = 20
"""Below it a smaller picture of better quality shows more."""
_NO_LIMIT_BYTES = 2**31
_OUTCOMES = 64


@dataclass(frozen=True, slots=True)
class OnDemandSettings:
    """Bounds: how many wait, how long the first in line waits for its full size, and all of them for any."""

    max_waiting: int = 4
    patience_ns: int = 2_000_000_000
    max_age_ns: int = 10_000_000_000
    retry_ns: int = 250_000_000
    """Between two tries to fit one that is too large: each try codes it several times."""


@dataclass(slots=True)
class _PendingRequest:
    number: int
    cut: CropJob
    maker: StillMaker
    since_ns: int | None = None
    """When the still thread first saw it."""
    first_ns: int | None = None
    """When it became the first in line."""
    whole: Still | None = None
    """Coded as asked for, once."""
    tried_ns: int | None = None


class OnDemand:
    """The edge's end of ``control: still``. `ask`, `outcome` and `tracks` may be called from any thread.

    Args:
        ring: where frames come from; filled by `see`.
        maker: how stills are made; asked ones never build on the base.
        view: between source and base pixels.
        class_names: the detector's.
        most_bytes: the largest payload that the budget ever admits, as it is now.
        settings: the bounds.
    """

    def __init__(
        self,
        ring: FrameRing,
        *,
        maker: StillMaker,
        view: View,
        class_names: tuple[str, ...],
        most_bytes: Callable[[], int],
        settings: OnDemandSettings = OnDemandSettings(),
    ) -> None:
        self._ring = ring
        self._maker = replace(maker, codec=maker.without_base, fallback=None, fidelity_db=0.0)
        self._view = view
        self._class_names = class_names
        self._most_bytes = most_bytes
        self._settings = settings
        self._lock = threading.Lock()
        self._line: deque[_PendingRequest] = deque()
        self._outcomes: OrderedDict[int, str] = OrderedDict()
        """Number → why it was given up, or nothing where it waits or was sent; of the last ones."""
        self._next_number = 0
        self._ended = False

    @property
    def waiting(self) -> int:
        """How many wait for room."""
        return len(self._line)

    def see(self, seen: AnalyzedFrame) -> None:
        """Keep a frame with its tracks."""
        self._ring.add(seen.frame, seen.tracks)

    # What is asked

    def ask(self, ask: Ask) -> tuple[int, int]:
        """Take one in; return its number and the index of the frame that it will show.

        Raises:
            RefusedError: with the reason.
        """
        with self._lock:
            if self._ended:
                raise RefusedError("the session is ending")
            if len(self._line) >= self._settings.max_waiting:
                raise RefusedError(
                    f"{len(self._line)} stills that were asked for wait already: ask again later"
                )
        if self._most_bytes() < _LEAST_BYTES:
            raise RefusedError("the budget leaves nothing for stills: raise it, or lower --video-share")
        kept = frame_for(ask, self._ring)
        cut = crop_job_for(ask, kept, maker=self._maker, view=self._view, class_names=self._class_names)
        quality_pct = self._maker.quality_pct if ask.quality_pct is None else ask.quality_pct
        maker = replace(self._maker, quality_pct=quality_pct, floor_pct=min(_FLOOR_PCT, quality_pct))
        with self._lock:
            number = self._next_number
            self._next_number += 1
            parameters = {**cut.header.parameters, REQUEST_PARAMETER: number}
            header = replace(cut.header, quality_pct=quality_pct, parameters=parameters)
            self._line.append(_PendingRequest(number, replace(cut, header=header), maker))
            self._note(number, "")
        return number, kept.frame_index

    def outcome(self, number: int) -> None:
        """Return where that still waits or was sent.

        Raises:
            RefusedError: it was given up, or is not known (any more).
        """
        with self._lock:
            if number not in self._outcomes:
                raise RefusedError(f"nothing is known of a still of the number {number}")
            if self._outcomes[number]:
                raise RefusedError(self._outcomes[number])

    def tracks(self) -> tuple[int, tuple[TrackNow, ...]]:
        """The newest frame's index, and its tracks by id; of too many, those of most confidence."""
        newest = self._ring.newest
        if newest is None:
            raise RefusedError("there is no frame yet, or none is kept (--ring)")
        tracks = newest.tracks
        width, height = self._view.source_size  # a box that is only predicted may be far outside
        boxes = np.clip(self._view.to_source(tracks.boxes_xyxy_px), 0, (width, height, width, height))
        rows = sorted(np.argsort(-tracks.confidences, kind="stable")[:MAX_TRACKS_NOW].tolist())
        listed = [
            TrackNow(
                track_id=int(tracks.ids[row]),
                class_id=int(tracks.class_ids[row]),
                confidence=float(tracks.confidences[row]),
                box_source_px=box_of(boxes, row),
            )
            for row in rows
        ]
        return newest.frame_index, tuple(listed)

    # What is sent

    def stills(self, *, now_ns: int, room: Room, next_sequence: Callable[[], int]) -> Iterator[Still]:
        """Yield those that may go now; the caller sends each before it asks for the next."""
        self._give_up_old(now_ns)
        while (waiting := self._first(now_ns)) is not None:
            still = self._coded(waiting, now_ns=now_ns, room=room, sequence=next_sequence())
            if still is None:
                return
            with self._lock:
                self._line.popleft()
            yield still

    def close(self) -> None:
        """What still waits will not be sent any more."""
        with self._lock:
            self._ended = True
            while self._line:
                self._note(self._line.popleft().number, "the session ended before there was room for it")

    def _first(self, now_ns: int) -> _PendingRequest | None:
        with self._lock:
            waiting = self._line[0] if self._line else None
        if waiting is not None and waiting.first_ns is None:
            waiting.first_ns = now_ns
        return waiting

    def _give_up_old(self, now_ns: int) -> None:
        limit_ns = self._settings.max_age_ns
        with self._lock:
            for waiting in tuple(self._line):
                if waiting.since_ns is None:
                    waiting.since_ns = now_ns
                if now_ns - waiting.since_ns > limit_ns:
                    self._line.remove(waiting)
                    self._note(waiting.number, f"in {limit_ns / 1e9:g} s the budget had no room for it")

    def _coded(self, waiting: _PendingRequest, *, now_ns: int, room: Room, sequence: int) -> Still | None:
        """As asked for; or, when waiting longer is of no use, what there is room for."""
        if waiting.whole is None:
            made = waiting.maker.code(waiting.cut, sequence=sequence, room=lambda _: _NO_LIMIT_BYTES)
            assert isinstance(made, Still), "without a limit and without a rival there is a still"
            waiting.whole = made
        whole = replace(waiting.whole, sequence=sequence)
        limit_bytes = room(whole)
        if len(whole.data) <= limit_bytes:
            return whole
        assert waiting.first_ns is not None, "it is the first in line"
        patient = now_ns - waiting.first_ns < self._settings.patience_ns
        most_bytes = _FULL_SHARE * self._most_bytes()
        if patient and limit_bytes < most_bytes:
            return None
        if waiting.tried_ns is not None and now_ns - waiting.tried_ns < self._settings.retry_ns:
            return None
        waiting.tried_ns = now_ns
        return _fitted(waiting, sequence=sequence, room=room)

    def _note(self, number: int, outcome: str) -> None:
        self._outcomes[number] = outcome
        while len(self._outcomes) > _OUTCOMES:
            self._outcomes.popitem(last=False)


def _fitted(waiting: _PendingRequest, *, sequence: int, room: Room) -> Still | None:
    """The largest picture of which some quality fits; None where nothing does."""
    for shrink in _SHRINKS:
        made = waiting.maker.code(shrunk(waiting.cut, shrink), sequence=sequence, room=room)
        if not isinstance(made, NoStill):
            return made
    return None
