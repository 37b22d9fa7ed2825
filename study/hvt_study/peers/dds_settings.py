"""What the two-pass peer may be told; the defaults are those of a small sweep (docs/design-notes/dds.md)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from hvt_common.errors import UserError
from hvt_edge.video.encoder_settings import PRESETS
from hvt_study.datasets.clip import NOMINAL_FPS

RATES = (NOMINAL_FPS, 7.5, 5.0, 3.0, 2.0)
"""Those that the study's video-only methods choose from too."""
_LEAST_BITS_PER_PX = 0.1
"""Of the whole budget, for each frame: with less, both passes are too coarse (docs/design-notes/dds.md)."""


@dataclass(frozen=True, slots=True)
class DdsSettings:
    """Sizes are shares of the picture, thresholds are confidences and IoUs (0…1).

    Raises:
        UserError: one of them is out of its range.
    """

    share: float = 0.5
    """Of the budget without requests that the first pass takes; the second has the rest."""
    segment_s: float = 1.0
    """So much media time is asked about at once."""
    fps: float | None = None
    """Frames a second of both passes; None: the most of `RATES` that leaves each frame a tenth of a bit a pixel."""
    scale: float = 1.0
    """Of the first pass: its width and height as shares of the base size. The second has all of it."""
    low: float = 0.1
    """From here a result of the first pass is uncertain: what DDS takes from a region proposal network."""
    high: float = 0.4
    """From here it is confident (``prune_score``)."""
    overlap_iou: float = 0.3
    """What overlaps a confident result with more is known already (``objfilter_iou``)."""
    max_area: float = 0.04
    """A larger region is not asked for (``size_obj``)."""
    merge_iou: float = 0.3
    """Regions that overlap more become one."""
    enlarge: float = 0.1
    """By so much of its own length a region grows on every side (``rpn_enlarge_ratio``)."""
    align_px: int = 16
    """Regions are made of whole blocks of this side."""
    steady: bool = False
    """A region that is asked for in one frame of a segment is asked for in all of them."""
    confidence: float = 0.25
    """From which a final result starts a track."""
    nms_iou: float = 0.45
    """Results of both passes that overlap more are one."""
    camera_motion: Literal["off", "flow"] = "flow"
    """Of the tracker, as at the ground that flies."""
    preset: str = "veryfast"
    """Of x265, both passes."""
    bundle_bytes: int = 4000
    """Access units of the second pass share a message up to about so much: DDS sends a segment's as one file."""
    request_bytes: int = 700
    """Line bytes that are kept free for each request. A larger one waits until there is room."""

    def __post_init__(self) -> None:
        for name, low, high in _RANGES:
            value = getattr(self, name)
            if value is None:  # by the budget
                continue
            if not low <= value <= high:  # also refuses NaN
                raise UserError(f"DDS {name} {value:g} is not accepted; {low:g} to {high:g} is")
        if self.low > self.high:
            raise UserError(f"DDS low {self.low:g} is above high {self.high:g}; it may not be")
        if self.preset not in PRESETS:
            raise UserError(f"DDS preset {self.preset!r} is not known: choose from {', '.join(PRESETS)}")

    def resolved(self, budget_bps: int, *, size: tuple[int, int]) -> DdsSettings:
        """The same with a frame rate, chosen by the budget where none was given."""
        if self.fps is not None:
            return self
        most = budget_bps / (_LEAST_BITS_PER_PX * size[0] * size[1])
        return replace(self, fps=next((fps for fps in RATES if fps <= most), RATES[-1]))

    @property
    def rate(self) -> float:
        """``fps`` of settings that are `resolved`."""
        assert self.fps is not None, "settled() comes first"
        return self.fps

    @property
    def segment_frames(self) -> int:
        """At least one."""
        return max(1, round(self.segment_s * NOMINAL_FPS))

    @property
    def window_ns(self) -> int:
        """Of the budget: a second, or what holds two frames."""
        return round(1e9 * max(1.0, 2 / self.rate))

    @property
    def request_bps(self) -> float:
        """What requests may take of the budget."""
        return 8 * self.request_bytes * NOMINAL_FPS / self.segment_frames

    def first_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the first pass, even numbers."""
        width, height = (max(2, 2 * math.floor(side * self.scale / 2 + 0.5)) for side in size)
        return width, height


_RANGES: tuple[tuple[str, float, float], ...] = (
    ("share", 0.05, 0.95),
    ("segment_s", 1 / NOMINAL_FPS, 10),
    ("fps", 0.5, NOMINAL_FPS),
    ("scale", 0.1, 1),
    ("low", 0, 1),
    ("high", 0, 1),
    ("overlap_iou", 0, 1),
    ("max_area", 0, 1),
    ("merge_iou", 0, 1),
    ("enlarge", 0, 2),
    ("align_px", 2, 128),
    ("confidence", 0.01, 1),
    ("nms_iou", 0, 1),
    ("bundle_bytes", 1, 100_000),
    ("request_bytes", 0, 100_000),
)
