"""What the ground sees: detections and tracks on the base stream, and what the stills say of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hvt_common.distinct import DistinctIds
from hvt_common.errors import UserError
from hvt_common.link.wire import RoiHeader, StillResult, fitted_text
from hvt_common.values import Image, Posterior, Tracks, View
from hvt_common.vision.detect import Detector
from hvt_common.vision.still_codecs import StillError, still_codec
from hvt_common.vision.track import ByteTracker
from hvt_ground.classify_stills import Decoded, StillReader
from hvt_ground.events import Event, Notice, Overlay, Refinement
from hvt_ground.history import History
from hvt_ground.refine import Refiner, Settled, StillSeen

__all__ = ["GroundSight", "Picture", "ReceivedStill"]


@dataclass(frozen=True, slots=True)
class Picture:
    """A decoded base frame."""

    frame_index: int
    capture_ns: int
    reference_ns: int
    """The moment on our clock that latency counts from: capture, or in lockstep the receiving."""
    image_bgr: Image


@dataclass(frozen=True, slots=True)
class ReceivedStill:
    """A still as it came, its header checked."""

    header: RoiHeader
    data: bytes
    media_type: str


@dataclass(frozen=True, slots=True)
class _Carried:
    """What a still brings along while it waits for its track."""

    received: ReceivedStill
    base_crop_bgr: Image | None
    known: bool
    """False where nothing could be said of it."""


class GroundSight:
    """One session's eyes. Used by one thread; ``emit`` takes the events."""

    def __init__(
        self,
        detector: Detector,
        tracker: ByteTracker,
        *,
        reader: StillReader,
        refiner: Refiner[_Carried],
        view: View,
        detect_every: int,
        emit: Callable[[Event], None],
    ) -> None:
        self._detector = detector
        self._tracker = tracker
        self._reader = reader
        self._refiner = refiner
        self._view = view
        self._detect_every = detect_every
        self._emit = emit
        self._history = History()
        self._detected_frame: int | None = None
        self._newest = (0, 0)
        self._results: list[StillResult] = []
        self._track_ids = DistinctIds()
        self.detections_run = 0
        self.stills_dropped: Counter[str] = Counter()
        """Stills of which nothing could be made, by reason."""
        self.outcomes: Counter[str] = Counter()
        """What became of the others."""

    @property
    def tracks(self) -> int:
        """Distinct tracks so far."""
        return self._track_ids.count

    @property
    def refined(self) -> int:
        """Distinct tracks on whose class a still has spoken."""
        return self._refiner.counters.tracks_refined

    @property
    def class_changes(self) -> int:
        """Stills after which the class that is shown was another."""
        return self._refiner.counters.class_changes

    def see(self, picture: Picture, *, hurry: bool) -> None:
        """Take the next frame; with ``hurry`` detection waits for a later one."""
        index, image = picture.frame_index, picture.image_bgr
        self._newest = (index, picture.capture_ns)
        self._history.add_frame(index, image)
        due = self._detected_frame is None or index - self._detected_frame >= self._detect_every
        if due and not hurry:
            self._detected_frame = index
            self.detections_run += 1
            tracks = self._tracker.update(self._detector.detect(image), frame_index=index, image_bgr=image)
        else:
            tracks = self._tracker.predict(frame_index=index, image_bgr=image)
        self._history.add_tracks(tracks)
        self._track_ids.add(tracks.ids.tolist())
        self._settle()
        self._emit(self._overlay(tracks, picture.capture_ns))

    def read(self, stills: Sequence[ReceivedStill]) -> None:
        """Take stills, in the order in which they came; those of one frame are looked at together."""
        by_frame: dict[int, list[tuple[ReceivedStill, Decoded]]] = {}
        for still in stills:
            decoded = self._decode(still)
            if decoded is not None:
                by_frame.setdefault(still.header.frame_index, []).append((still, decoded))
        for frame_index, pairs in by_frame.items():
            base_bgr = self._history.frame(frame_index)
            posteriors = self._reader.read([decoded for _, decoded in pairs], base_bgr)
            for (still, decoded), posterior in zip(pairs, posteriors, strict=True):
                self._offer(still, decoded, posterior, base_bgr)
        self._settle()

    def take_results(self) -> list[StillResult]:
        """Return and forget what the edge wants to hear of its stills."""
        results, self._results = self._results, []
        return results

    def end(self) -> None:
        """The session is over: what still waits is given out as unmatched."""
        for settled in self._refiner.end():
            self._settled(settled)

    # Stills

    def _decode(self, still: ReceivedStill) -> Decoded | None:
        header = still.header
        try:
            image = still_codec(header.codec).decode(
                still.data, size=self._coded_size(header), parameters=header.parameters
            )
        except (StillError, UserError) as error:
            self.stills_dropped["undecodable"] += 1
            self._notice("warning", f"still {header.sequence} cannot be decoded: {error}")
            self._answer(header, None)
            return None
        return Decoded(image, header.crop_source_px, self._box_base_px(header), header.frame_index)

    def _coded_size(self, header: RoiHeader) -> tuple[int, int]:
        """(width, height) as announced. A still may be shrunk, never be larger than what it shows."""
        x1, y1, x2, y2 = header.crop_source_px
        size = header.parameters.get("w", x2 - x1), header.parameters.get("h", y2 - y1)
        inside = x2 <= self._view.source_size[0] and y2 <= self._view.source_size[1]
        width, height = size
        if not (inside and isinstance(width, int) and isinstance(height, int)):
            raise StillError(f"crop {header.crop_source_px} is not of this source")
        if not (0 < width <= x2 - x1 and 0 < height <= y2 - y1):
            raise StillError(f"size {width}x{height} is larger than what it shows")
        return width, height

    def _offer(
        self, still: ReceivedStill, decoded: Decoded, posterior: Posterior | None, base_bgr: Image | None
    ) -> None:
        header = still.header
        crop = None if base_bgr is None else _cut(base_bgr, decoded.crop_source_px, view=self._view)
        carried = _Carried(still, crop, known=posterior is not None)
        self._answer(header, posterior)
        if posterior is None:
            self.outcomes["unread"] += 1
            self._emit(
                self._refinement(carried, None, header.class_name, header.class_name, header.confidence)
            )
            return
        seen = StillSeen(
            sequence=header.sequence,
            frame_index=header.frame_index,
            capture_ns=header.capture_ns,
            edge_track_id=header.track_id,
            box_base_px=decoded.box_base_px,
            class_name=header.class_name,
            posterior=posterior,
            carried=carried,
        )
        for settled in self._refiner.offer(seen, now_frame=self._newest[0]):
            self._settled(settled)

    def _settle(self) -> None:
        for settled in self._refiner.settle(self._history, now_frame=self._newest[0]):
            self._settled(settled)

    def _settled(self, settled: Settled[_Carried]) -> None:
        self.outcomes[settled.outcome] += 1
        if settled.track_id is not None:
            self._name_track(settled.still.sequence, settled.track_id)
        before, after = settled.class_before, settled.class_after
        self._emit(
            self._refinement(settled.still.carried, settled.track_id, before, after, settled.confidence)
        )

    def _refinement(
        self, carried: _Carried, track_id: int | None, before: str, after: str, confidence: float
    ) -> Refinement:
        header = carried.received.header
        # It is shown when it is known, not at the frame that it was cut from: that one has been drawn already.
        frame_index, capture_ns = self._newest
        return Refinement(
            frame_index=frame_index,
            capture_ns=capture_ns,
            still_sequence=header.sequence,
            track_id=track_id,
            edge_track_id=header.track_id,
            box_base_px=self._box_base_px(header),
            still=carried.received.data,
            media_type=carried.received.media_type,
            base_crop_bgr=carried.base_crop_bgr,
            class_before=before,
            class_after=after,
            confidence=confidence,
            reason=header.reason,
            quality_pct=header.quality_pct,
        )

    def _answer(self, header: RoiHeader, posterior: Posterior | None) -> None:
        """The edge hears of every still, so that a lockstep edge waits for none in vain; no name is no opinion."""
        self._results.append(
            StillResult(
                still_sequence=header.sequence,
                track_id=header.track_id,
                class_name=fitted_text(posterior.class_name, 64) if posterior else "",
                confidence=posterior.confidence if posterior else 0.0,
                entropy_nats=min(20.0, posterior.entropy_nats) if posterior else 0.0,
                ground_track_id=-1,  # until it has settled
                again=False,
            )
        )

    def _name_track(self, still_sequence: int, ground_track_id: int) -> None:
        """Add the track that a still refined to its answer, if that has not been reported yet."""
        for place, result in enumerate(self._results):
            if result.still_sequence == still_sequence:
                self._results[place] = replace(result, ground_track_id=ground_track_id)

    # Tracks

    def _overlay(self, tracks: Tracks, capture_ns: int) -> Overlay:
        shown = self._refiner.shown(tracks)
        return Overlay(
            frame_index=tracks.frame_index,
            capture_ns=capture_ns,
            track_ids=tracks.ids,
            boxes_base_px=tracks.boxes_xyxy_px,
            base_classes=shown.base_classes,
            classes=shown.classes,
            confidences=shown.confidences,
            refined=shown.refined,
        )

    def _box_base_px(self, header: RoiHeader) -> tuple[float, float, float, float]:
        x1, y1, x2, y2 = self._view.to_base(np.array([header.box_source_px], np.float32))[0].tolist()
        return x1, y1, x2, y2

    def _notice(self, level: str, text: str) -> None:
        assert level in ("info", "warning", "error")
        self._emit(Notice(*self._newest, level, text))  # type: ignore[arg-type]


def _cut(base_bgr: Image, crop_source_px: tuple[int, int, int, int], *, view: View) -> Image | None:
    """The same padded box of the base frame, whole pixels, clipped; None where nothing of it is inside."""
    x1, y1, x2, y2 = view.to_base(np.array([crop_source_px], np.float32))[0]
    height, width = base_bgr.shape[:2]
    left, top = max(0, int(np.floor(x1))), max(0, int(np.floor(y1)))
    right, bottom = min(width, int(np.ceil(x2))), min(height, int(np.ceil(y2)))
    if right <= left or bottom <= top:
        return None
    return base_bgr[top:bottom, left:right].copy()
