"""The parameters of the tracker."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

_LOW_CONFIDENCE: Final = 0.1


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """The parameters of ByteTrack, with the authors' defaults."""

    track_confidence: float = 0.5
    """Detections above it are matched first and may start tracks (``track_thresh``)."""
    low_confidence: float = _LOW_CONFIDENCE
    """Detections above it and below ``track_confidence`` may only carry a track on."""
    new_confidence: float | None = None
    """Least confidence that starts a track; None is ``track_confidence`` + 0.1."""
    match_iou: float = 0.2
    """Least IoU (times confidence, with ``fuse_scores``) of a first match; 1 - ``match_thresh``."""
    track_buffer: int = 30
    """How long a lost track is remembered, in frames at 30 fps; scaled to the real rate. Where detections are
    further apart than that: for three of them."""
    fuse_scores: bool = True
    """Weigh overlaps by the detection's confidence, except for weak detections (off with ``mot20``)."""
    min_box_area_px2: float = 10.0
    """Tracks whose box is not larger than this are not listed."""
    search_growth_per_s: float = 3.0
    """After frames without detection, the rest is matched once more with boxes larger on every side, by this many
    of their own lengths for a second without (0.75 at most). Where every frame of 15 a second is
    searched nothing changes; 0 is off."""
    class_decay: float = 0.9
    """The remaining weight of a class vote one matched detection later: 1 never forgets."""
    camera_motion: Literal["off", "flow"] = "off"
    """How to estimate the camera's motion, which then moves all tracks before they are matched."""

    @classmethod
    def starting_at(cls, confidence: float, *, camera_motion: Literal["off", "flow"]) -> TrackerSettings:
        """The settings of both sides: detections from ``confidence`` start tracks, weaker ones carry them on."""
        return cls(
            track_confidence=confidence,
            low_confidence=weak_confidence(confidence),
            new_confidence=confidence,
            camera_motion=camera_motion,
        )

    def __post_init__(self) -> None:
        """Check every bound; a `ValueError` names the setting."""
        for name in ("track_confidence", "low_confidence", "match_iou", "class_decay"):
            _check_range(name, getattr(self, name), 0.0, 1.0)
        if self.new_confidence is not None:
            _check_range("new_confidence", self.new_confidence, 0.0, math.inf)
        _check_range("search_growth_per_s", self.search_growth_per_s, 0.0, math.inf)
        _check_range("min_box_area_px2", self.min_box_area_px2, 0.0, math.inf)
        _check_range("track_buffer", self.track_buffer, 0, math.inf)
        if self.low_confidence > self.track_confidence:
            raise ValueError(
                f"low_confidence is {self.low_confidence}, must not exceed track_confidence {self.track_confidence}"
            )
        if self.camera_motion not in ("off", "flow"):
            raise ValueError(f"camera_motion is {self.camera_motion!r}, must be 'off' or 'flow'")

    @property
    def birth_confidence(self) -> float:
        """The least confidence that starts a track."""
        return self.track_confidence + 0.1 if self.new_confidence is None else self.new_confidence


def weak_confidence(confidence: float) -> float:
    """From where a detector is to report, so that weak detections may carry on tracks begun at ``confidence``."""
    return min(confidence, _LOW_CONFIDENCE)


def _check_range(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # also refuses NaN
        raise ValueError(f"{name} is {value}, must be from {low} to {high}")
