"""Stills that a ground requests: cropped at once from the frames of the last seconds, sent before all others.

A request only crops (`OnDemand.request`, in the link's callback). Coding and sending have a thread of their own
(`hvt_edge.stills.worker`), so that no detection delays them, within the budget as for every other still.
`code_requested` codes them: at the source's pixels, and better than the base. Video frames are left out for their
bytes (`hvt_edge.link.budget`), whatever share of the budget stills have. While one is pending, no other is sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import numpy as np

from hvt_common.errors import foreign
from hvt_common.protocol.messages import MAX_TRACKS_NOW, TrackNow
from hvt_common.runtime.failures import reason_of
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS
from hvt_common.values import Boxes, Image, View
from hvt_common.video.base_crop import MAX_REQUESTED_SIDE_PX, coded_size
from hvt_common.video.hevc import YuvPicture
from hvt_edge.link.stills import Box, Crop, Still
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.candidates import MIN_SIDE_PX, crop_box
from hvt_edge.perception.frame_ring import FrameRing, RingFrame
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.outbox import Outbox, OutboxStill, StillState
from hvt_edge.stills.policy.base import CostModel
from hvt_edge.stills.requested_coding import Capacity, RefusedError, code_requested

ON_DEMAND = "asked"
"""The reason of a requested still on the wire and in the ledger."""


@dataclass(frozen=True, slots=True)
class OnDemandRequest:
    """A track or a box, or neither for the whole frame; at a frame or ``ago_ms``, or neither for the newest."""

    track_id: int | None = None
    box_xywh_px: tuple[int, int, int, int] | None = None
    """Left, top, width and height in source pixels."""
    frame_index: int | None = None
    ago_ms: int | None = None
    quality_pct: int | None = None
    """None for the quality of all stills."""


def frame_for(request: OnDemandRequest, ring: FrameRing) -> RingFrame:
    """The requested frame, or the nearest in the ring; raises `RefusedError` where it is gone or yet to come.

    The newest means the newest coded frame, unless the track is not in it. Only analyzed frames have tracks; a
    request without a track may also get the camera's newest frame.
    """
    tracked = request.track_id is not None
    newest, newest_held = ring.newest(tracked=False), ring.newest(tracked=tracked)
    if newest is None or newest_held is None:
        raise RefusedError("no frame was looked at yet, or none is kept (--ring)")
    if request.frame_index is not None:
        if request.frame_index > newest.frame_index:
            raise RefusedError(
                f"frame {request.frame_index} is yet to come: the newest is {newest.frame_index}"
            )
        index = min(request.frame_index, newest_held.frame_index)
        frame, wanted = ring.near_index(index, tracked=tracked), f"frame {request.frame_index}"
    elif not request.ago_ms:
        coded = ring.newest_coded(tracked=tracked)
        lacks = coded is None or (tracked and request.track_id not in coded.tracks.ids)
        return newest_held if lacks or coded is None else coded
    else:
        ago_ms = request.ago_ms
        frame = ring.near_time(newest.capture_ns - ago_ms * 1_000_000, tracked=tracked)
        wanted = f"the frame of {ago_ms / 1000:g} s ago"
    if frame is None:
        raise RefusedError(f"{wanted} is not held: frames go back {ring.reach_s():.1f} s")
    return frame


def crop_for(
    request: OnDemandRequest, frame: RingFrame, *, maker: StillMaker, view: View, class_names: tuple[str, ...]
) -> Still:
    """Crop the requested region out of that frame; raises `RefusedError` where it is not in it."""
    width, height = frame.size
    box: Box
    if request.track_id is not None:
        row = _row(frame, request.track_id)
        box = box_of(
            np.clip(view.to_source(frame.tracks.boxes_xyxy_px), 0, (width, height, width, height)), row
        )
        crop = crop_box(box, padding=maker.padding, source_size=(width, height))
        if box[2] - box[0] < 1 or box[3] - box[1] < 1:
            raise RefusedError(
                f"track {request.track_id} is outside the picture at frame {frame.frame_index}"
            )
        class_id = int(frame.tracks.class_ids[row])
        name, confidence = class_names[class_id], float(frame.tracks.confidences[row])
    else:
        crop = _inside(request.box_xywh_px or (0, 0, width, height), (width, height))
        box, name, confidence = (*map(float, crop),), "", 0.0  # type: ignore[assignment]
    return Still.cropped(
        frame.source_bgr,
        crop,
        coded_size(crop, max_side_px=MAX_REQUESTED_SIDE_PX),
        codec=maker.without_base,
        frame_index=frame.frame_index,
        capture_ns=frame.capture_ns,
        track_id=-1 if request.track_id is None else request.track_id,
        box_source_px=box,
        class_name=name,
        confidence=confidence,
        reason=ON_DEMAND,
        quality_pct=maker.quality_pct if request.quality_pct is None else request.quality_pct,
    )


def _row(frame: RingFrame, track_id: int) -> int:
    rows = np.flatnonzero(frame.tracks.ids == track_id)
    if len(rows):
        return int(rows[0])
    known = frame.tracks.ids.tolist()
    listed = ", ".join(map(str, known[:12])) + (" and more" if len(known) > 12 else "")
    raise RefusedError(
        f"there is no track {track_id} at frame {frame.frame_index}: the edge's own tracks there are "
        f"{listed or 'none'}"
    )


def _inside(box_xywh_px: tuple[int, int, int, int], size: tuple[int, int]) -> Crop:
    x, y, w, h = box_xywh_px
    if x < 0 or y < 0 or w < 1 or h < 1 or x + w > size[0] or y + h > size[1]:
        raise RefusedError(
            f"box {x},{y},{w},{h} is not inside the frame of {size[0]}x{size[1]} source pixels (x,y,w,h)"
        )
    if min(w, h) < MIN_SIDE_PX:
        raise RefusedError(f"box {x},{y},{w},{h} is too small: {MIN_SIDE_PX} pixels a side at least")
    return x, y, x + w, y + h


def box_of(boxes: Boxes, row: int) -> Box:
    x1, y1, x2, y2 = (float(one) for one in boxes[row])
    return x1, y1, x2, y2


REQUEST_PARAMETER = "ask"

_PROMPT_SHARE = 0.6
"""Share of the video's rate for an on-demand still: on a link as thin as the budget it takes about a second."""
_MARGIN_BYTES = 64
"""Bytes by which a header may be longer than its estimate."""
_MAX_PENDING = 4
_AGAIN_NS = 2 * SECOND_NS
"""Time for which a ground waits for an answer, and repeats its request meanwhile."""
_TRACKED_NS = 30_000_000_000
"""Time after a request for tracks during which objects are tracked, even if nothing else needs them."""
_OUTCOMES = 64
_ENDED = "the edge has ended"
_OFFLINE = "no ground receives the video of this edge: until one does, stills are stored"


@dataclass(slots=True, eq=False)
class OnDemandStill(OutboxStill):
    """A still that a ground requested."""

    number: int = -1
    base: YuvPicture | Image | None = None
    """The base picture of its frame; None once the still is coded."""
    ready: Still | None = None
    """The coded still, until it is sent."""
    behind: bool = False
    """Another still was pending when it was requested."""
    link_busy: bool = False
    """At the last try the budget had room for it, and the link had not."""
    on_demand: OnDemandRequest = OnDemandRequest()

    def frame_if_again(self, request: OnDemandRequest, capture_ns: int) -> int | None:
        """The index of its frame if a request, for a frame of that time, repeats the request of this still."""
        job = self.job  # another thread clears it on sending
        if request != self.on_demand or self.state is not StillState.PENDING or job is None:
            return None
        near = abs(capture_ns - job.header.capture_ns) <= _AGAIN_NS
        return job.header.frame_index if near else None


@dataclass(eq=False)
class OnDemand:
    """The edge's end of ``control: still``. `request`, `outcome` and `tracks` may be called from any thread.

    These stills never build on the base.
    """

    ring: FrameRing
    _: KW_ONLY
    outbox: Outbox
    maker: StillMaker
    view: View
    class_names: tuple[str, ...]
    line: Transmitter
    offline: Callable[[], bool] = lambda: False
    """Whether stills are stored instead of sent."""

    def __post_init__(self) -> None:
        self._lock = threading.RLock()
        self._outcomes: Newest[int, tuple[str, str]] = Newest(_OUTCOMES)
        """Number → (reason of giving up, note for the requester), both empty at first; of the newest requests."""
        self._next_number = 0
        self._last: OnDemandStill | None = None
        self._tracks_requested_ns: int | None = None
        """Capture time of the newest frame at the last request for tracks."""
        self._tracked = True
        self._ended = False

    def add(self, analyzed: AnalyzedFrame) -> None:
        self._tracked = analyzed.tracked
        self.ring.add(analyzed.frame, analyzed.tracks, base=analyzed.base)

    # From any thread

    def request(self, request: OnDemandRequest) -> tuple[int, int]:
        """Crop a still; return its number and frame index. Raises `RefusedError` with the reason.

        A repeated request, while its still is pending, returns that still: the first answer may have been lost.
        """
        if self._ended:
            raise RefusedError(_ENDED)
        if self.offline():
            raise RefusedError(_OFFLINE)
        frame = frame_for(request, self.ring)
        with self._lock:
            last = self._last
            again = None if last is None else last.frame_if_again(request, frame.capture_ns)
            if last is not None and again is not None:
                return last.number, again
        self._check_queue()
        if request.track_id is not None:
            self._want_tracks(frame.capture_ns)
        job = crop_for(request, frame, maker=self.maker, view=self.view, class_names=self.class_names)
        with self._lock:
            self._check_queue()
            number = self._next_number
            job = job.with_header(parameters={**job.header.parameters, REQUEST_PARAMETER: number})
            pending = OnDemandStill(
                *(job, None, float("inf"), None),
                number=number,
                base=frame.base,
                behind=self.outbox.on_demand is not None,
                on_demand=request,
            )
            self.outbox.offer_on_demand(pending)
            self._last = pending
            self._next_number += 1
            self._note(number)
        return number, frame.frame_index

    def outcome(self, number: int) -> str:
        """Return the note on that still before it comes; empty where it comes as requested, or has come.

        Raises `RefusedError` where it was given up, or is not known (any more).
        """
        with self._lock:
            if number not in self._outcomes:
                raise RefusedError(f"nothing is known of a still of the number {number}")
            refusal, note = self._outcomes[number]
            if refusal:
                raise RefusedError(refusal)
            return note

    def tracks(self) -> tuple[int, tuple[TrackNow, ...], int]:
        """The newest frame's index, its tracks by id (the most confident of too many), and the number of tracks."""
        newest = self.ring.newest()
        if newest is None:
            raise RefusedError("no frame was looked at yet, or none is kept (--ring)")
        self._want_tracks(newest.capture_ns)
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
        return newest.frame_index, tuple(listed), len(tracks)

    def wants_tracks(self, capture_ns: int) -> bool:
        requested_ns = self._tracks_requested_ns
        return requested_ns is not None and capture_ns - requested_ns < _TRACKED_NS

    # In the thread of requested stills

    def code(self, pending: OnDemandStill, *, now_ns: int, sequence: int, paced: bool) -> Still | None:
        """The coded still, if it may go now. None: it waits, or was given up, and is no longer in the outbox.

        ``paced``: it goes to the link, which has to be free.
        """
        most_bytes = self.line.most_requested_bytes()
        # The rate may have fallen meanwhile.
        if pending.ready is None or len(pending.ready.data) > most_bytes:
            if not self._code_anew(pending, most_bytes, now_ns=now_ns):
                return None
            assert pending.ready is not None, "it was coded just now"
        still = pending.ready = pending.ready.with_header(sequence=sequence)
        fits = len(still.data) <= self.line.requested_allowance_bytes(now_ns, still=still)
        pending.link_busy = fits and paced and not self.line.link_is_free(now_ns)
        if fits and not pending.link_busy:
            return still
        self.line.want_requested(len(still.data), now_ns=now_ns)
        return None

    def _code_anew(self, pending: OnDemandStill, most_bytes: int, *, now_ns: int) -> bool:
        # Code it for the present limits; False where no still results, and its requester is given the reason.
        codec, job = self.maker.without_base, pending.crop
        height, width = job.crop_bgr.shape[:2]
        expected = CostModel.of_codec(codec.name).estimate().of_px(width * height)
        # Coding takes a moment, in which the window gets free.
        self.line.want_requested(min(round(expected), most_bytes), now_ns=now_ns)
        if pending.base is not None:
            pending.job = job = job.beside(pending.base, view=self.view, min_gain_db=0.0)
            pending.base = None
        job = job.without_base(codec)
        capacity = Capacity(
            prompt_bytes=max(0, round(_PROMPT_SHARE * most_bytes) - _MARGIN_BYTES),
            most_bytes=max(0, most_bytes - _MARGIN_BYTES),
            total_bps=self.line.budget.total_bps,
        )
        try:
            pending.ready, note = code_requested(job, codec=codec, capacity=capacity)
        except foreign() as error:  # a requester waits for an answer
            failed = RefusedError(f"it could not be coded ({reason_of(error)})")
            refused = error if isinstance(error, RefusedError) else failed
            self.line.want_requested(None, now_ns=now_ns)
            self.outbox.give_up(pending)
            self._note(pending.number, refusal=str(refused))
            return False
        self._note(pending.number, note=note)
        return True

    def expired(self, pending: OnDemandStill, reason: str, *, now_ns: int) -> None:
        """It was given up: ``stale`` or ``ended``."""
        self.line.want_requested(None, now_ns=now_ns)
        waited_s = self.outbox.settings.max_on_demand_ns / SECOND_NS
        why = "the budget had no room for it"
        if pending.link_busy:
            why = "the link was never free for it"
        elif pending.ready is None and pending.behind:
            why = "those that were requested before it had not gone"
        elif pending.ready is None:  # it was never its turn
            why = "the keyframe that goes before it had no room"
        self._note(pending.number, refusal=_ENDED if reason == "ended" else f"in {waited_s:g} s {why}")

    def close(self) -> None:
        self._ended = True

    def _want_tracks(self, capture_ns: int) -> None:
        # Note that tracks are wanted; raises `RefusedError` if there are none yet because none were wanted before.
        self._tracks_requested_ns = capture_ns
        if not self._tracked:
            raise RefusedError(
                "this edge sends video alone and followed no objects; it does from now on: request again in a second"
            )

    def _check_queue(self) -> None:
        pending = self.outbox.on_demand_pending
        if pending >= _MAX_PENDING:
            raise RefusedError(f"{pending} requested stills are pending already: try again later")

    def _note(self, number: int, *, refusal: str = "", note: str = "") -> None:
        with self._lock:
            self._outcomes[number] = refusal, note
