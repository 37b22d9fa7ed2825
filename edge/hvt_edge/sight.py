"""What the edge sees: its own decoded stream, the detections on it, the tracks on every frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from hvt_common.values import AccessUnit, Detections, Frame, Image, Tracks, View
from hvt_common.vision.detect import Detector
from hvt_common.vision.hevc import BaseDecoder
from hvt_common.vision.track import ByteTracker

__all__ = ["Seen", "Sight", "SightSettings"]


@dataclass(frozen=True, slots=True)
class SightSettings:
    """``candidates`` says on which pixels the detector runs."""

    detect_every: int = 5
    candidates: Literal["decoded", "source"] = "decoded"


@dataclass(frozen=True, slots=True)
class Seen:
    """One frame with all that is known of it; ``detected`` marks a decision step."""

    frame: Frame
    base_bgr: Image
    """The decoded base frame: what the ground has."""
    tracks: Tracks
    detected: bool


class _Decoder(Protocol):
    def decode(self, data: bytes) -> Image | None: ...


class Sight:
    """Decodes the edge's own access units, detects on every n-th frame and tracks on each."""

    def __init__(
        self,
        detector: Detector,
        tracker: ByteTracker,
        *,
        view: View,
        settings: SightSettings = SightSettings(),
        decoder: _Decoder | None = None,
    ) -> None:
        self._detector = detector
        self._tracker = tracker
        self._view = view
        self._settings = settings
        self._decoder = decoder or BaseDecoder()
        self._detected_frame: int | None = None

    def see(self, frame: Frame, unit: AccessUnit, *, hurry: bool = False) -> Seen:
        """Take in the next frame; with ``hurry`` detection waits for a later one, decoding never does."""
        base_bgr = self._decoder.decode(unit.data)
        assert base_bgr is not None, "the edge decodes what it has just encoded"
        last = self._detected_frame
        due = last is None or frame.index - last >= self._settings.detect_every
        if not due or hurry:
            tracks = self._tracker.predict(frame_index=frame.index, image_bgr=base_bgr)
            return Seen(frame, base_bgr, tracks, detected=False)
        self._detected_frame = frame.index
        detections = self._detect(frame, base_bgr)
        tracks = self._tracker.update(detections, frame_index=frame.index, image_bgr=base_bgr)
        return Seen(frame, base_bgr, tracks, detected=True)

    def _detect(self, frame: Frame, base_bgr: Image) -> Detections:
        if self._settings.candidates == "decoded":
            return self._detector.detect(base_bgr)
        found = self._detector.detect(frame.source_bgr)
        width, height = self._view.base_size
        boxes = self._view.to_base(found.boxes_xyxy_px)
        # With --fit crop the source shows more than the base does; what lies outside is no candidate.
        limits = np.array([width, height, width, height], np.float32)
        boxes = np.clip(boxes, 0, limits)
        inside = (boxes[:, 2] - boxes[:, 0] > 1) & (boxes[:, 3] - boxes[:, 1] > 1)
        return Detections(boxes[inside], found.confidences[inside], found.class_ids[inside])
