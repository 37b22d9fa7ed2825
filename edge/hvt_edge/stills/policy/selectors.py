"""The pilot's four selectors on raw detections, with their published parameters.

A selector filters the detections of one frame and selects the best few by a score of smallness and doubt. *Small* is
a yes or no, and `strict_small_only` falls back to objects that are not small where there is no small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import same_kind
from hvt_common.values import Boxes
from hvt_edge.stills.policy.base import Request, Step

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

_ROAD_USERS = ("car", "truck", "bus", "person")


@dataclass(frozen=True, slots=True)
class Selector:
    """One row of the pilot's table, and a `Method`."""

    name: str
    min_confidence: float
    per_frame: int
    min_side_px: float
    """Least side of the box, width and height alike, base pixels."""
    kinds: tuple[str, ...] | None
    """Class words as in `hvt_common.inference.class_names`; None is every class."""
    small_share: float
    """A box that takes less of the frame is small."""
    small_weight: float
    doubt_weight: float
    """The order is ``small_weight · small + doubt_weight · (1 - confidence)``, highest first."""
    video_only: ClassVar[bool] = False

    def select(
        self,
        boxes_xyxy_px: Boxes,
        confidences: npt.ArrayLike,
        class_names: Sequence[str],
        frame_area_px: float,
    ) -> list[tuple[int, float, bool]]:
        """(index, score, whether it is small) of the detections of one frame that the selector takes, best first.

        Ties keep the detections' order. ``boxes_xyxy_px`` is (N, 4) in base pixels, ``class_names`` the N names of
        the detections' classes.
        """
        confidence = np.asarray(confidences, np.float64).reshape(-1)
        boxes = np.asarray(boxes_xyxy_px, np.float64).reshape(-1, 4)
        width, height = boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]
        small = width * height / frame_area_px < self.small_share
        passed = np.array([self._takes(name) for name in class_names], np.bool_)
        passed &= (width >= self.min_side_px) & (height >= self.min_side_px)
        passed &= confidence >= self.min_confidence
        score = self.small_weight * small + self.doubt_weight * (1 - confidence)
        indices = np.flatnonzero(passed)
        best = indices[np.argsort(-score[indices], kind="stable")[: self.per_frame]]
        return list(zip(best.tolist(), score[best].tolist(), small[best].tolist(), strict=True))

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """At most ``per_frame`` requests, of detections of this very frame; nothing between detections."""
        seen = sorted((one for one in candidates if one.detected), key=lambda one: one.track_id)
        boxes = np.array([one.box_base_px for one in seen], np.float32)
        confidences, names = [one.confidence for one in seen], [one.class_name for one in seen]
        area = float(step.base_size[0] * step.base_size[1])
        return [
            Request(seen[index], "small" if small else "low confidence", score)
            for index, score, small in self.select(boxes, confidences, names, area)
        ]

    def _takes(self, class_name: str) -> bool:
        return self.kinds is None or any(same_kind(class_name, kind) for kind in self.kinds)


SELECTORS: tuple[Selector, ...] = (
    Selector("permissive", 0.20, 3, 0, None, 0.015, 2, 1),
    Selector("conf_size_top1", 0.40, 1, 12, _ROAD_USERS, 0.015, 2, 1),
    Selector("strict_small_only", 0.50, 1, 12, _ROAD_USERS, 0.020, 10, 1e-6),
    Selector("balanced_top2", 0.40, 2, 12, _ROAD_USERS, 0.015, 1, 2),
)
