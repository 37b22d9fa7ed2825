"""What every metric is given: for each tick what was there, and what the ground showed.

All boxes are x1 y1 x2 y2 in source pixels. A tick is a frame of the source at the study's rate (15 a second); the
ground's list is judged at every one of them, coded or not, unless a metric says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes
from hvt_study.datasets.labels import NO_ID, FrameLabels

__all__ = ["NO_ID", "FrameLabels", "FrameView", "Rows", "Tick", "Ticks", "rows_of"]

Rows: TypeAlias = npt.NDArray[np.bool_] | npt.NDArray[np.intp]
"""Which rows of parallel arrays: a mask, or indices."""


def _no_boxes() -> Boxes:
    return np.empty((0, 4), np.float32)


def _no_ids() -> npt.NDArray[np.int64]:
    return np.empty(0, np.int64)


def _no_numbers() -> npt.NDArray[np.float32]:
    return np.empty(0, np.float32)


@dataclass(frozen=True, slots=True)
class FrameView:
    """What the ground shows at one tick, N boxes; an empty one shows nothing."""

    boxes_xyxy_px: Boxes = field(default_factory=_no_boxes)
    """(N, 4) float32, source pixels, inside the frame."""
    ids: npt.NDArray[np.int64] = field(default_factory=_no_ids)
    """(N,) of the ground's tracks; `NO_ID` for plain detections."""
    class_names: tuple[str, ...] = ()
    """N names as shown, after refinement."""
    confidences: npt.NDArray[np.float32] = field(default_factory=_no_numbers)
    """(N,) of the class that is shown, 0…1."""
    names_before: tuple[str, ...] = ()
    """N names without refinement: what the base stream says."""

    def __post_init__(self) -> None:
        counts = {len(self.boxes_xyxy_px), len(self.ids), len(self.class_names), len(self.confidences)}
        assert counts == {len(self.names_before)}, "parallel arrays have one length"

    def __len__(self) -> int:
        return len(self.ids)

    def before(self) -> FrameView:
        """The same boxes with the classes that they had without refinement."""
        names = self.names_before
        return FrameView(self.boxes_xyxy_px, self.ids, names, self.confidences, names)

    def rows(self, keep: Rows) -> FrameView:
        """Only these rows."""
        return FrameView(
            self.boxes_xyxy_px[keep],
            self.ids[keep],
            rows_of(self.class_names, keep),
            self.confidences[keep],
            rows_of(self.names_before, keep),
        )


def rows_of(names: Sequence[str], keep: Rows) -> tuple[str, ...]:
    """The names of some rows."""
    indices = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep
    return tuple(names[index] for index in indices.tolist())


Tick: TypeAlias = tuple[FrameLabels, FrameView]
"""What was there, and what was shown."""

Ticks: TypeAlias = Sequence[Tick]
"""Of one sequence, in order; it may be empty."""
