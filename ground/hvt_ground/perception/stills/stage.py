"""Stills at the ground: each waits for its base frame, is decoded, read, matched to its track, shown and answered."""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from hvt_common.protocol.messages import Flags, RoiHeader, StillResult, fitted_text
from hvt_common.values import Image, Posterior, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.still_codecs import BaseMissingError, StillError, psnr_y_db, still_codec
from hvt_ground.events import Event, Notice, Refinement
from hvt_ground.perception.fusion.fuse import Fusion
from hvt_ground.perception.history import History
from hvt_ground.perception.stills.classify import ObjectReading, StillReader
from hvt_ground.perception.stills.decode import (
    Box,
    DecodedStill,
    ReceivedStill,
    box_of,
    decode_still,
    needs_base,
)
from hvt_ground.perception.stills.match import StillSeen
from hvt_ground.perception.stills.refine import Refiner

_log = logging.getLogger(__name__)

SAME_DB, OTHER_DB = 38.0, 26.0
"""Luma PSNR between a still and the base of the same place: at the first it says nothing new, at the second all."""
_MOST_SPOILT, _SPOILT_FRAMES = 32, 150
"""After 32 undecodable stills in 150 frames the next are dropped unseen until those frames are over."""
MAX_PENDING, MAX_PENDING_BYTES = 64, 16 * 2**20
"""Stills that wait for their base frame; beyond, the oldest is read without it."""


@dataclass(frozen=True, slots=True)
class Progress:
    """The ground's progress."""

    frame_index: int = 0
    """The newest frame of which anything is known; new events are shown there."""
    capture_ns: int = 0
    picture_index: int = -1
    """The newest decoded frame; -1 before the first."""


@dataclass(eq=False)
class StillStage:
    """One session's stills. Used by one thread; ``emit`` takes the events."""

    reader: StillReader
    refiner: Refiner
    _: KW_ONLY
    history: History
    fusion: Fusion
    view: View
    gap_frames: int
    emit: Callable[[Event], None]

    def __post_init__(self) -> None:
        self._pending: list[ReceivedStill] = []
        self._results: list[StillResult] = []
        self._spoilt: deque[int] = deque(maxlen=_MOST_SPOILT)
        """When the last ones came that could not be decoded, in frames."""
        self.dropped: Counter[str] = Counter()
        self.outcomes: Counter[str] = Counter()

    @property
    def pending(self) -> int:
        """Stills whose base frame may still come."""
        return len(self._pending)

    def take(self, stills: Sequence[ReceivedStill], now: Progress) -> None:
        """Take stills in the order in which they came; those whose base frame may still come wait for it."""
        self._pending += stills
        self.update(now)

    def update(self, now: Progress) -> None:
        """Read stills that need not wait longer, and settle them if possible: call it after each picture and step."""
        ready = [still for still in self._pending if not self._may_wait(still.header, now)]
        self._pending = [still for still in self._pending if self._may_wait(still.header, now)]
        while (
            len(self._pending) > MAX_PENDING
            or sum(len(one.data) for one in self._pending) > MAX_PENDING_BYTES
        ):
            ready.append(self._pending.pop(0))
        self._read(ready, now)
        for resolved in self.refiner.settle(
            self.history, now_frame=now.frame_index, known_as=self.fusion.known_as
        ):
            self._resolved(resolved, now)

    def end(self, now: Progress) -> None:
        """The session is over: waiting stills are given out as they are."""
        ready, self._pending = self._pending, []
        self._read(ready, now)
        for resolved in self.refiner.end():
            self._resolved(resolved, now)

    def take_results(self) -> list[StillResult]:
        results, self._results = self._results, []
        return results

    # From bytes to readings

    def _may_wait(self, header: RoiHeader, now: Progress) -> bool:
        # Whether its picture may yet come. A residual is nothing without it; others wait for the next frame only.
        if header.frame_index <= now.picture_index:
            return False
        return needs_base(header) or (self.reader.wants_base and header.frame_index >= now.frame_index)

    def _read(self, stills: Sequence[ReceivedStill], now: Progress) -> None:
        by_frame: dict[int, list[tuple[ReceivedStill, DecodedStill]]] = {}
        for still in stills:
            decoded = self._decode(still, now)
            if decoded is not None:
                by_frame.setdefault(still.header.frame_index, []).append((still, decoded))
        for frame_index, pairs in by_frame.items():
            # Of an outage there may be no picture, and the last one before it is not the same place any more.
            stored = any(still.header.flags & Flags.STORED for still, _ in pairs)
            base_bgr = self.history.frame_before(frame_index, within=0 if stored else self.gap_frames)
            readings = self.reader.read([decoded for _, decoded in pairs], base_bgr)
            for (still, decoded), objects in zip(pairs, readings.objects, strict=True):
                self._offer(still, decoded, objects, base_bgr, now)
            if len(readings.found):
                known = self.history.tracks(frame_index)
                if known is not None:
                    self.fusion.take_found(readings.found, known=known)

    def _decode(self, still: ReceivedStill, now: Progress) -> DecodedStill | None:
        header, spoilt = still.header, self._spoilt
        # Sent on purpose, then: each costs a line in the recording and, from libjpeg, one on stderr.
        if len(spoilt) == _MOST_SPOILT and abs(now.frame_index - spoilt[0]) < _SPOILT_FRAMES:
            self.dropped["undecodable"] += 1
            self._answer(header, header.track_id, None)
            return None
        try:
            base = self.history.picture(header.frame_index)
            image = decode_still(still, base=base, view=self.view)
        except BaseMissingError:
            self.dropped["base_missing"] += 1
            self._notice(
                now, f"still {header.sequence} is asked for again: the picture it builds on did not come"
            )
            self._answer(header, header.track_id, None, again=True)
            return None
        except StillError as error:
            self.dropped["undecodable"] += 1
            self._spoilt.append(now.frame_index)
            _log.info("still %d cannot be decoded: %s", header.sequence, error)
            self._notice(now, f"still {header.sequence} is damaged: it is not shown")
            for track_id, _ in _shown(header):
                self._answer(header, track_id, None)
            return None
        boxes = tuple(self._to_base(box) for _, box in _shown(header))
        return DecodedStill(image, header.crop_source_px, boxes, header.frame_index)

    # From readings to tracks

    def _offer(
        self,
        still: ReceivedStill,
        decoded: DecodedStill,
        objects: Sequence[ObjectReading],
        base_bgr: Image | None,
        now: Progress,
    ) -> None:
        header = still.header
        crop = None if base_bgr is None else _base_crop_at(base_bgr, header.crop_source_px, view=self.view)
        news = self._news(decoded)
        shown = zip(_shown(header), decoded.boxes_base_px, objects, strict=True)
        for part, ((track_id, _), box, reading) in enumerate(shown):
            side_px = min(box[2] - box[0], box[3] - box[1]) / self.view.scale
            said, note = reading.posterior, ""
            if said is not None:
                said, note = self.refiner.vocabulary.vote(said, called=header.class_name, side_px=side_px)
            self._answer(header, track_id, said)
            event = self._refinement(still, decoded, track_id, box, crop)
            if said is None:
                self.outcomes["unread"] += 1
                self._give_out(replace(event, unread=True, note=note), now)
                continue
            event = replace(event, class_after=said.class_name, confidence=said.confidence)
            seen = StillSeen(event, said, side_px, news, part, reading.box_base_px)
            for resolved in self.refiner.offer(seen, now_frame=now.frame_index):
                self._resolved(resolved, now)

    def _news(self, decoded: DecodedStill) -> float:
        # Pixels named twice were not seen twice; on a base near the source the track's many votes are worth more.
        base_bgr = self.history.frame(decoded.frame_index)
        if base_bgr is None:
            return 1.0
        height, width = decoded.image_bgr.shape[:2]
        seen = base_crop(
            base_bgr, view=self.view, crop_source_px=decoded.crop_source_px, size=(width, height)
        )
        nearness_db = psnr_y_db(seen, decoded.image_bgr)
        return float(np.clip((SAME_DB - nearness_db) / (SAME_DB - OTHER_DB), 0.0, 1.0))

    def _resolved(self, still: StillSeen, now: Progress) -> None:
        event, found = still.event, still.found_base_px
        self.outcomes[str(still.outcome)] += 1
        if event.track_id is not None:
            self._name_track(event, event.track_id)
            if found is not None and not event.stored:
                self.fusion.take_box(event.track_id, found, frame_index=event.shown_at[0])
        self._give_out(event, now)

    def _give_out(self, event: Refinement, now: Progress) -> None:
        # It is shown when it is known, not at the frame that it was cut from: that one has been drawn already. A
        # still stored while the link was down belongs to that time.
        if not event.stored:
            event = replace(event, frame_index=now.frame_index, capture_ns=now.capture_ns)
        self.emit(event)

    def _refinement(
        self, still: ReceivedStill, decoded: DecodedStill, track_id: int, box: Box, crop: Image | None
    ) -> Refinement:
        header = still.header
        return Refinement(
            frame_index=header.frame_index,
            capture_ns=header.capture_ns,
            still_sequence=header.sequence,
            track_id=None,
            edge_track_id=track_id,
            box_base_px=box,
            still=still.data,
            media_type=still_codec(header.codec).media_type,  # Zenoh's encoding is not checked by anybody
            base_crop_bgr=crop,
            class_before=header.class_name,
            class_after=header.class_name,
            confidence=header.confidence,
            reason=header.reason,
            quality_pct=header.quality_pct,
            still_bgr=decoded.image_bgr,
            crop_base_px=self._to_base(header.crop_source_px),
            stored=bool(header.flags & Flags.STORED),
            header=header,
        )

    # Results and notices

    def _answer(
        self, header: RoiHeader, track_id: int, posterior: Posterior | None, *, again: bool = False
    ) -> None:
        # Every still and track, so that the edge waits for none in vain; no name is no opinion; `again` comes once.
        self._results.append(
            StillResult(
                still_sequence=header.sequence,
                track_id=track_id,
                class_name=fitted_text(posterior.class_name, 64) if posterior else "",
                confidence=posterior.confidence if posterior else 0.0,
                entropy_nats=min(20.0, posterior.entropy_nats) if posterior else 0.0,
                ground_track_id=-1,  # until it has settled
                again=again,
            )
        )

    def _name_track(self, event: Refinement, ground_track_id: int) -> None:
        for place, result in enumerate(self._results):
            if (result.still_sequence, result.track_id) == (event.still_sequence, event.edge_track_id):
                self._results[place] = replace(result, ground_track_id=ground_track_id)

    def _to_base(self, box_source_px: Sequence[float]) -> Box:
        return box_of(self.view.to_base(np.array([box_source_px], np.float32))[0])

    def _notice(self, now: Progress, text: str) -> None:
        self.emit(Notice(now.frame_index, now.capture_ns, "warning", text))


def _shown(header: RoiHeader) -> list[tuple[int, Box]]:
    # Edge track and box, source pixels, of each object in a still, the lead's first.
    return [
        (header.track_id, header.box_source_px),
        *((one.track_id, one.box_source_px) for one in header.also),
    ]


def _base_crop_at(base_bgr: Image, crop_source_px: tuple[int, int, int, int], *, view: View) -> Image | None:
    # The same padded box of the base frame, whole pixels, clipped; None where nothing of it is inside.
    x1, y1, x2, y2 = view.to_base(np.array([crop_source_px], np.float32))[0]
    height, width = base_bgr.shape[:2]
    left, top = max(0, int(np.floor(x1))), max(0, int(np.floor(y1)))
    right, bottom = min(width, int(np.ceil(x2))), min(height, int(np.ceil(y2)))
    if right <= left or bottom <= top:
        return None
    return base_bgr[top:bottom, left:right].copy()
