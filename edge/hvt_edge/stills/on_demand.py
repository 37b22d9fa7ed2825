"""Stills that a ground requests: cropped at once from the frames of the last seconds, sent before all others.

A request only crops (`OnDemand.request`, in the link's callback); coding and sending are the stills' thread's, under
the same budget as every other still. What the base shows of the place does not matter: whoever requests has a reason.
It is coded at the requested quality as soon as the budget allows it; where the budget never does, or not within
`_PATIENCE_NS`, at the largest size, then the best quality, that it allows. While one is pending, no
other still is sent.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from hvt_common.protocol.messages import MAX_TRACKS_NOW, TrackNow
from hvt_common.values import Still, View
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.maker import Allowance, NoStill, StillMaker
from hvt_edge.stills.on_demand_crop import (
    OnDemandRequest,
    RefusedError,
    box_of,
    crop_job_for,
    frame_for,
    shrunk,
)
from hvt_edge.stills.outbox import Outbox, OutboxStill

__all__ = ["REQUEST_PARAMETER", "OnDemand", "OnDemandStill"]

REQUEST_PARAMETER = "ask"
"""The parameter that carries its number."""

_FULL_SHARE = 0.9
"""With so much of the most a still can ever be given, it is no use to wait for more."""
_LEAST_BYTES = 400
"""A budget that never allows a still more than this has none to give."""
_SHRINKS = (1.0, 0.7, 0.5, 0.35, 0.25)
_FLOOR_PCT = 20
"""Below it a smaller picture of better quality shows more."""
_NO_LIMIT_BYTES = 2**31
_OUTCOMES = 64
_MAX_PENDING = 4
_PATIENCE_NS = 2_000_000_000
"""For so long the first waits for its full size."""
_RETRY_NS = 250_000_000
"""Between two tries to fit one that is too large: each codes it several times."""
_TRACKED_NS = 30_000_000_000
"""For so long after a request for tracks they are followed, where nothing else needs them."""
_REFUSALS = {
    "stale": "in 10 s the budget had no room for it",
    "ended": "the session ended before there was room for it",
}


@dataclass(slots=True, eq=False)
class OnDemandStill(OutboxStill):
    """One that a ground requested."""

    number: int = -1
    maker: StillMaker | None = None
    first_ns: int | None = None
    """When it became the first in the queue."""
    full: Still | None = None
    """Coded as requested, once."""
    tried_ns: int | None = None


@dataclass(eq=False)
class OnDemand:
    """The edge's end of ``control: still``. `request`, `outcome` and `tracks` may be called from any thread.

    ``most_bytes()`` is the largest payload that the budget admits now. These stills never build on the base.
    """

    ring: FrameRing
    _: KW_ONLY
    outbox: Outbox
    maker: StillMaker
    view: View
    class_names: tuple[str, ...]
    most_bytes: Callable[[], int]

    def __post_init__(self) -> None:
        self._maker = replace(
            self.maker, fidelity_db=0.0
        )  # of crops without a base: never one that builds on it
        self._lock = threading.Lock()
        self._refusals: OrderedDict[int, str] = OrderedDict()
        """Number → why it was given up, or nothing where it is pending or was sent; of the last ones."""
        self._next_number = 0
        self._tracks_requested_ns: int | None = None
        """Capture time of the newest frame then."""
        self._followed = True
        """Objects were, in the newest frame."""
        self._ended = False

    def add(self, analyzed: AnalyzedFrame) -> None:
        """Hold a frame with its tracks."""
        self._followed = analyzed.followed
        self.ring.add(analyzed.frame, analyzed.tracks)

    # From any thread

    def request(self, request: OnDemandRequest) -> tuple[int, int]:
        """Crop a still; return its number and frame index. Raises `RefusedError` with the reason."""
        if self._ended:
            raise RefusedError("the session is ending")
        self._check_queue()
        if self.most_bytes() < _LEAST_BYTES:
            raise RefusedError("the budget leaves nothing for stills: raise it, or lower --video-share")
        frame = frame_for(request, self.ring)
        if request.track_id is not None:
            self._follow(frame.capture_ns)
        job = crop_job_for(request, frame, maker=self._maker, view=self.view, class_names=self.class_names)
        quality_pct = self._maker.quality_pct if request.quality_pct is None else request.quality_pct
        maker = replace(self._maker, quality_pct=quality_pct, floor_pct=min(_FLOOR_PCT, quality_pct))
        with self._lock:
            self._check_queue()
            number = self._next_number
            parameters = {**job.header.parameters, REQUEST_PARAMETER: number}
            header = replace(job.header, quality_pct=quality_pct, parameters=parameters)
            pending = OnDemandStill(
                replace(job, header=header), None, float("inf"), None, number=number, maker=maker
            )
            self.outbox.offer_on_demand(pending)
            self._next_number += 1
            self._note(number, "")
        return number, frame.frame_index

    def outcome(self, number: int) -> None:
        """Return where that still is pending or was sent.

        Raises `RefusedError` where it was given up, or is not known (any more).
        """
        with self._lock:
            if number not in self._refusals:
                raise RefusedError(f"nothing is known of a still of the number {number}")
            if self._refusals[number]:
                raise RefusedError(self._refusals[number])

    def tracks(self) -> tuple[int, tuple[TrackNow, ...]]:
        """The newest frame's index, and its tracks by id; of too many, those of most confidence."""
        newest = self.ring.newest
        if newest is None:
            raise RefusedError("there is no frame yet, or none is kept (--ring)")
        self._follow(newest.capture_ns)
        tracks = newest.tracks
        width, height = self.view.source_size  # a box that is only predicted may be far outside
        boxes = np.clip(self.view.to_source(tracks.boxes_xyxy_px), 0, (width, height, width, height))
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

    # In the stills' thread

    def wants_tracks(self, capture_ns: int) -> bool:
        """Whether a ground has requested tracks shortly before this frame."""
        requested_ns = self._tracks_requested_ns
        return requested_ns is not None and capture_ns - requested_ns < _TRACKED_NS

    def code(
        self, pending: OnDemandStill, *, now_ns: int, allowance: Allowance, sequence: int
    ) -> Still | None:
        """As requested; or, when waiting longer is of no use, what the budget allows. None: it waits."""
        assert pending.maker is not None, "`request` has given it one"
        pending.first_ns = now_ns if pending.first_ns is None else pending.first_ns
        if pending.full is None:
            made = pending.maker.code(pending.crop, sequence=sequence, allowance=lambda _: _NO_LIMIT_BYTES)
            assert isinstance(made, Still), "without a limit, and without a base to beat, there is a still"
            pending.full = made
        full = replace(pending.full, sequence=sequence)
        limit_bytes = allowance(full)
        if len(full.data) <= limit_bytes:
            return full
        patient = now_ns - pending.first_ns < _PATIENCE_NS
        if patient and limit_bytes < _FULL_SHARE * self.most_bytes():
            return None
        if pending.tried_ns is not None and now_ns - pending.tried_ns < _RETRY_NS:
            return None
        pending.tried_ns = now_ns
        for shrink in _SHRINKS:  # the largest picture of which some quality fits
            fitted = pending.maker.code(shrunk(pending.crop, shrink), sequence=sequence, allowance=allowance)
            if not isinstance(fitted, NoStill):
                return fitted
        return None

    def expired(self, pending: OnDemandStill, reason: str) -> None:
        """It was given up: ``stale`` or ``ended``."""
        with self._lock:
            self._note(pending.number, _REFUSALS[reason])

    def close(self) -> None:
        """No more is accepted."""
        self._ended = True

    def _follow(self, capture_ns: int) -> None:
        """Tracks are wanted; raises `RefusedError` where there are none because nobody wanted them until now."""
        self._tracks_requested_ns = capture_ns
        if not self._followed:
            raise RefusedError(
                "this edge sends video alone and followed no objects; it does from now on: request again in a second"
            )

    def _check_queue(self) -> None:
        pending = self.outbox.on_demand_pending
        if pending >= _MAX_PENDING:
            raise RefusedError(f"{pending} stills that were asked for wait already: ask again later")

    def _note(self, number: int, refusal: str) -> None:
        self._refusals[number] = refusal
        while len(self._refusals) > _OUTCOMES:
            self._refusals.popitem(last=False)
