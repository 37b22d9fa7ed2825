"""What every metric is given: for each frame what was there, and what the ground showed.

All boxes are x1 y1 x2 y2 in source pixels. A frame is a frame of the source at the study's rate (15 a second); the
ground's list is judged at every one of them, coded or not, unless a metric says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes
from hvt_study.datasets.labels import NO_ID, FrameLabels, no_boxes, no_ids

Rows: TypeAlias = npt.NDArray[np.bool_] | npt.NDArray[np.intp]
"""Which rows of parallel arrays: a mask, or indices."""


def no_numbers() -> npt.NDArray[np.float32]:
    """(0,) float32."""
    return np.empty(0, np.float32)


@dataclass(frozen=True, slots=True)
class FrameView:
    """What the ground shows at one frame, N boxes; an empty one shows nothing."""

    boxes_xyxy_px: Boxes = field(default_factory=no_boxes)
    """(N, 4) float32, source pixels, inside the frame."""
    ids: npt.NDArray[np.int64] = field(default_factory=no_ids)
    """(N,) of the ground's tracks; `NO_ID` for plain detections."""
    class_names: tuple[str, ...] = ()
    """N names as shown, after refinement."""
    confidences: npt.NDArray[np.float32] = field(default_factory=no_numbers)
    """(N,) of the class that is shown, 0…1."""
    names_before: tuple[str, ...] = ()
    """N names without refinement: what the base stream says."""

    def __post_init__(self) -> None:
        counts = {len(self.boxes_xyxy_px), len(self.ids), len(self.class_names), len(self.confidences)}
        assert counts == {len(self.names_before)}, "parallel arrays have one length"

    @classmethod
    def plain(
        cls, boxes: npt.ArrayLike, names: Sequence[str], confidences: npt.NDArray[np.float32] | None = None
    ) -> FrameView:
        """Boxes of no track, which nothing has refined; without ``confidences`` all are sure."""
        sure = np.ones(len(names), np.float32) if confidences is None else confidences
        array, ids = np.asarray(boxes, np.float32).reshape(-1, 4), np.full(len(names), NO_ID, np.int64)
        return cls(array, ids, tuple(names), sure, tuple(names))

    def __len__(self) -> int:
        return len(self.ids)

    def rows(self, chosen: Rows) -> FrameView:
        """Only these rows."""
        return FrameView(
            self.boxes_xyxy_px[chosen],
            self.ids[chosen],
            rows_of(self.class_names, chosen),
            self.confidences[chosen],
            rows_of(self.names_before, chosen),
        )


def rows_of(names: Sequence[str], chosen: Rows) -> tuple[str, ...]:
    """The names of some rows."""
    indices = np.flatnonzero(chosen) if chosen.dtype == np.bool_ else chosen
    return tuple(names[index] for index in indices.tolist())


LabelledFrame: TypeAlias = tuple[FrameLabels, FrameView]
"""What was there, and what was shown."""

LabelledFrames: TypeAlias = Sequence[LabelledFrame]
"""Of one sequence, in order; it may be empty."""
