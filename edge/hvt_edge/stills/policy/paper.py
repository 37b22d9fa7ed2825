"""The paper's methods M0 to M5, R0, which every still has to beat, and the pilot's selectors. M6 is ours (`m6`).

M5 is the paper's utility per cost, ``S = (0.5 U + 0.3 S_small + 0.2 N) / C``, with every term in 0…1. The paper gives
weights and terms; the normalisation of each is ours, and docs/methods.md explains it.

A selector of the pilot, with its published parameters, filters the raw detections of one frame and selects the best
few by a score of smallness and doubt. *Small* is a yes or no, and `strict_small_only` falls back to objects that are
not small where there is no small one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import same_kind
from hvt_common.values import Boxes
from hvt_edge.stills.policy.base import Method, Request, Step, ranked

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate


@dataclass(frozen=True, slots=True)
class VideoOnly(Method):
    """M0, the baseline: no stills; the whole budget may go to the base stream."""

    name: ClassVar[str] = "M0"
    video_only: ClassVar[bool] = True

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        return []


@dataclass(frozen=True, slots=True)
class TracksFirst(VideoOnly):
    """R0: no stills, as M0; the encoder spends its bits on the tracks (``--roi-depth``)."""

    name: ClassVar[str] = "R0"


@dataclass(frozen=True, slots=True)
class Periodic(Method):
    """M1: each active track falls due at a fixed interval, from its first frame on; most overdue first."""

    every_frames: int = 15
    """The paper's interval: one second at 15 fps."""
    name: ClassVar[str] = "M1"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Tracks whose last still is ``every_frames`` or more behind."""
        return ranked(candidates, score=lambda one: self._overdue_frames(one, step), reason="due")

    def _overdue_frames(self, candidate: Candidate, step: Step) -> float | None:
        if candidate.last_sent_frame is None:
            return float(step.frame_index - candidate.born_frame)
        overdue = step.frame_index - candidate.last_sent_frame - self.every_frames
        return float(overdue) if overdue >= 0 else None


@dataclass(frozen=True, slots=True)
class OnStart(Method):
    """M2: a still when a track begins, and when it is found again; the longest waiting come first."""

    patience_s: float = 1.0
    """How long a start may wait for its still, either for its allowance or to come away from the border."""
    name: ClassVar[str] = "M2"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """Tracks whose last start has not been answered yet."""
        return ranked(candidates, score=lambda one: self._frames_unanswered(one, step), reason="new")

    def _frames_unanswered(self, candidate: Candidate, step: Step) -> float | None:
        start_frame = step.frame_index - candidate.frames_since_start
        if candidate.last_sent_frame is not None and candidate.last_sent_frame >= start_frame:
            return None
        elapsed = candidate.frames_since_start
        fresh = candidate.started or elapsed <= self.patience_s * step.fps
        return float(elapsed) if fresh else None


@dataclass(frozen=True, slots=True)
class Uncertain(Method):
    """M3: confidence below a threshold: the classifier's once the ground has named the track, else the detector's."""

    detector_confidence: float = 0.5
    """Confidence below which the detector is unsure (0.50 is the strictest confidence in the pilot's table)."""
    classifier_confidence: float = 0.5
    """Confidence below which no class has the absolute majority."""
    name: ClassVar[str] = "M3"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        return ranked(candidates, score=self._doubt, reason="uncertain")

    def _doubt(self, candidate: Candidate) -> float | None:
        if candidate.posterior is not None:
            confidence, limit = candidate.posterior.confidence, self.classifier_confidence
        else:
            confidence, limit = candidate.confidence, self.detector_confidence
        return 1 - confidence if confidence < limit else None


@dataclass(frozen=True, slots=True)
class Small(Method):
    """M4: area below a threshold, smallest first."""

    area_share: float = 0.015
    """Share of the base frame (the pilot's "small"): 118x118 pixels of 1280x720."""
    name: ClassVar[str] = "M4"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:  # noqa: ARG002
        """Tracks whose box takes less of the frame than ``area_share``."""
        return ranked(candidates, score=self._smallness, reason="small")

    def _smallness(self, candidate: Candidate) -> float | None:
        small = candidate.area_share < self.area_share
        return 1 - candidate.area_share / self.area_share if small else None


@dataclass(frozen=True, slots=True)
class Utility(Method):
    """M5: highest score first, above a threshold that follows from the budget's allowance."""

    uncertainty_weight: float = 0.5
    small_weight: float = 0.3
    novelty_weight: float = 0.2
    area_share: float = 0.015
    """Share of the base frame at which ``S_small`` reaches 0."""
    novelty_s: float = 5.0
    """Time constant with which a track becomes new again after a still."""
    min_cost: float = 0.25
    """Least ``C``: keeps a wrong cost estimate from ruling the order."""
    min_score: float = 0.1
    """Least score of a still, whatever the budget allows."""
    name: ClassVar[str] = "M5"

    def requests(self, candidates: Sequence[Candidate], step: Step) -> list[Request]:
        """As many of the best as the allowance holds, and always the best one, so that it waits for its allowance.

        So the threshold is the score of the last request that fits, from the scores of this step alone.
        """
        scored = ranked(candidates, score=lambda one: self.score(one, step), reason="utility")
        wanted = [one for one in scored if one.score >= self.min_score]
        spent = 0.0
        for count, request in enumerate(wanted):
            spent += step.cost.of(request.candidate)
            if spent > step.allowance_bytes:
                return wanted[: max(count, 1)]
        return wanted

    def score(self, candidate: Candidate, step: Step) -> float:
        gain = (
            self.uncertainty_weight * uncertainty(candidate)
            + self.small_weight * smallness(candidate, area_share=self.area_share)
            + self.novelty_weight * novelty(candidate, now_ns=step.now_ns, time_constant_s=self.novelty_s)
        )
        return gain / max(self.min_cost, step.cost.of(candidate) / step.cost.mean_bytes)


def uncertainty(candidate: Candidate) -> float:
    """``U``: one minus the detector's confidence; once the ground has answered, ``1 - exp(-H)`` of its entropy.

    ``exp(H)`` is the perplexity, the number of classes still in play, so both are 0 for certainty and need no
    knowledge of how many classes there are.
    """
    if candidate.posterior is not None:
        return 1 - math.exp(-max(0.0, candidate.posterior.entropy_nats))
    return min(1.0, max(0.0, 1 - candidate.confidence))


def smallness(candidate: Candidate, *, area_share: float) -> float:
    """``S_small``: 1 for a point, falling in a straight line to 0 at ``area_share`` of the frame."""
    return max(0.0, 1 - candidate.area_share / area_share) if area_share > 0 else 0.0


def novelty(candidate: Candidate, *, now_ns: int, time_constant_s: float) -> float:
    """``N``: 1 while nothing was sent; after a still 0, and back towards 1 as ``1 - exp(-t / time_constant_s)``."""
    if candidate.last_sent_ns is None or time_constant_s <= 0:
        return 1.0
    return 1 - math.exp(-max(0, now_ns - candidate.last_sent_ns) / 1e9 / time_constant_s)


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
