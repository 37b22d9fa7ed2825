"""Tracks: MOTA and IDF1 by the kept library ``motmetrics``, HOTA by `hota`.

HOTA is after Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 129 (2021), and
gives the authors' figures to the last digit. Their package (``trackeval``) brings ``opencv-python`` with it, which
overwrites the headless OpenCV of HVT.

CLEAR MOT: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance", 2008. IDF1: Ristani et al.,
"Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016. A box is on a label from an IoU
of 0.5 on, whatever the classes. All figures of several sequences are pooled by adding up their counts, as the
benchmarks do.

Continuity says how steadily labelled objects are held. A gap is a run of an object's frames in which it is missed
after it was found once; the time before is no gap: recall has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import motmetrics
import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from hvt_common.values import iou
from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.judged import LEAST_IOU, LabelledFrames, judged, matched_rows

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
"""(19,) least IoU of a match; HOTA is the mean over them (section 3.4 of the paper)."""

_EPSILON: Final = float(np.finfo(float).eps)

IdBoxes = tuple[npt.NDArray[np.integer[Any]], npt.NDArray[np.floating[Any]]]
"""Ids (N,), each once, and their boxes (N, 4) x1 y1 x2 y2, of one frame."""

_Overlaps = list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.float64]]]


def _zeros() -> npt.NDArray[np.float64]:
    return np.zeros(len(ALPHAS))


@dataclass(frozen=True, slots=True)
class Hota:
    """Counts for each alpha, (19,); those of several sequences can be added up, which is how benchmarks pool them."""

    true_positives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    false_negatives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    false_positives: npt.NDArray[np.float64] = field(default_factory=_zeros)
    association: npt.NDArray[np.float64] = field(default_factory=_zeros)
    """Sum of A(c) over all true positives c (equation 13)."""

    def __add__(self, other: Hota) -> Hota:
        return Hota(
            self.true_positives + other.true_positives,
            self.false_negatives + other.false_negatives,
            self.false_positives + other.false_positives,
            self.association + other.association,
        )

    @property
    def hota(self) -> float:
        """Mean over alpha of sqrt(DetA AssA) (equations 12 and 17); NaN where no track was labelled."""
        return self._mean(np.sqrt(self._detection() * self._association()))

    @property
    def deta(self) -> float:
        """Detection accuracy, mean over alpha of TP / (TP + FN + FP) (equation 14)."""
        return self._mean(self._detection())

    @property
    def assa(self) -> float:
        """Association accuracy, mean over alpha of the mean of A(c) (equation 15)."""
        return self._mean(self._association())

    def _detection(self) -> npt.NDArray[np.float64]:
        total = self.true_positives + self.false_negatives + self.false_positives
        return np.asarray(self.true_positives / np.maximum(1, total))

    def _association(self) -> npt.NDArray[np.float64]:
        return np.asarray(self.association / np.maximum(1, self.true_positives))

    def _mean(self, values: npt.NDArray[np.float64]) -> float:
        labelled = self.true_positives[0] + self.false_negatives[0] > 0
        return float(values.mean()) if labelled else math.nan


def hota(frames: Iterable[tuple[IdBoxes, IdBoxes]]) -> Hota:
    """Of one sequence: for each frame the true tracks and those that are shown, in one pixel space.

    As in the authors' program one matching serves all alphas of a frame: the assignment of the greatest sum of
    overlap times global alignment of the two tracks (section 3.3 of the paper and its appendix).
    """
    overlaps, true_lengths, lengths = _overlaps(frames)
    together = np.zeros((len(true_lengths), len(lengths)))
    for true, shown, overlap in overlaps:
        rest = overlap.sum(axis=0)[None, :] + overlap.sum(axis=1)[:, None] - overlap
        share = np.divide(overlap, rest, out=np.zeros_like(overlap), where=rest > _EPSILON)
        together[true[:, None], shown[None, :]] += share
    either = true_lengths[:, None] + lengths[None, :]
    alignment = together / (either - together)
    pairs = [np.empty(0, np.int64)]
    at = [np.empty(0)]
    for true, shown, overlap in overlaps:
        value = alignment[true[:, None], shown[None, :]] * overlap
        rows, columns = linear_sum_assignment(value, maximize=True)
        pairs.append(true[rows] * len(lengths) + shown[columns])
        at.append(overlap[rows, columns])
    known, pair = np.unique(np.concatenate(pairs), return_inverse=True)
    enough = np.concatenate(at)[None, :] >= ALPHAS[:, None] - _EPSILON
    matches = np.stack([np.bincount(pair[row], minlength=len(known)) for row in enough])  # (19, pairs)
    hits = matches.sum(axis=1).astype(np.float64)
    return Hota(
        true_positives=hits,
        false_negatives=true_lengths.sum() - hits,
        false_positives=lengths.sum() - hits,
        association=(matches**2 / np.maximum(1, either.ravel()[known] - matches)).sum(axis=1),
    )


def _overlaps(
    frames: Iterable[tuple[IdBoxes, IdBoxes]],
) -> tuple[_Overlaps, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Rows of true and of shown tracks with their IoU, of each frame that has both; then all lengths of tracks."""
    true_of: dict[int, int] = {}
    shown_of: dict[int, int] = {}
    seen: list[list[int]] = [[], []]
    overlaps: _Overlaps = []
    for (true_ids, true_boxes), (ids, boxes) in frames:
        true, shown = _numbered(true_ids, true_of), _numbered(ids, shown_of)
        seen[0] += true.tolist()
        seen[1] += shown.tolist()
        if len(true) and len(shown):
            overlaps.append((true, shown, iou(true_boxes, boxes)))
    return overlaps, _lengths(seen[0], len(true_of)), _lengths(seen[1], len(shown_of))


def _numbered(ids: npt.NDArray[np.integer[Any]], row_of: dict[int, int]) -> npt.NDArray[np.int64]:
    return np.array([row_of.setdefault(one, len(row_of)) for one in ids.tolist()], np.int64)


def _lengths(rows: Sequence[int], count: int) -> npt.NDArray[np.float64]:
    return np.bincount(np.asarray(rows, np.int64), minlength=count).astype(np.float64)


_COUNTS: Final = {
    "num_objects": "objects",
    "num_misses": "misses",
    "num_false_positives": "false_positives",
    "num_switches": "switches",
    "idtp": "id_true_positives",
    "idfp": "id_false_positives",
    "idfn": "id_false_negatives",
}


@dataclass(frozen=True, slots=True)
class TrackingScore:
    """Counts of one sequence, or, added up, of several."""

    objects: int = 0
    """Labels that belong to a track, over all frames."""
    misses: int = 0
    false_positives: int = 0
    switches: int = 0
    """How often a true track was found under another id than when it was last found."""
    id_true_positives: int = 0
    id_false_positives: int = 0
    id_false_negatives: int = 0
    higher_order: Hota = field(default_factory=Hota)

    def __add__(self, other: TrackingScore) -> TrackingScore:
        counts = {name: getattr(self, name) + getattr(other, name) for name in _COUNTS.values()}
        return TrackingScore(**counts, higher_order=self.higher_order + other.higher_order)

    @property
    def mota(self) -> float:
        """1 - (misses + false positives + switches) / objects; NaN where no track was labelled."""
        wrong = self.misses + self.false_positives + self.switches
        return 1 - wrong / self.objects if self.objects else math.nan

    @property
    def idf1(self) -> float:
        """2 IDTP / (2 IDTP + IDFP + IDFN); NaN where no track was labelled."""
        hits = 2 * self.id_true_positives
        total = hits + self.id_false_positives + self.id_false_negatives
        return hits / total if self.objects else math.nan

    @property
    def hota(self) -> float:
        """See `Hota.hota`; NaN where no track was labelled."""
        return self.higher_order.hota


def tracking_score(
    labelled: LabelledFrames, *, word: Callable[[str], str] = str, classes: Collection[str] | None = None
) -> TrackingScore:
    """Compare what is shown at every frame with the labelled tracks; ``word`` and ``classes`` as in `judged.judged`.

    Labels without ids say nothing of tracks: where none has one, every figure is NaN.
    """
    frames: list[tuple[IdBoxes, IdBoxes]] = []
    for one in judged(labelled, word=word, classes=classes):
        known, tracked = one.ids != NO_ID, one.view.ids != NO_ID
        true = one.ids[known], one.boxes_xyxy_px[known]
        frames.append((true, (one.view.ids[tracked], one.view.boxes_xyxy_px[tracked])))
    return compare_tracks(frames)


def compare_tracks(
    frames: Iterable[tuple[IdBoxes, IdBoxes]], *, least_iou: float = LEAST_IOU
) -> TrackingScore:
    """The same for plain ids and boxes: for each frame, in order, the true tracks and those that are shown.

    Ids are unique within a frame; boxes are x1 y1 x2 y2 in one pixel space.
    """
    sequence = list(frames)
    if not any(len(ids) for (ids, _), _ in sequence):
        # motmetrics has no answer here.
        false = sum(len(ids) for _, (ids, _) in sequence)
        return TrackingScore(false_positives=false, id_false_positives=false, higher_order=hota(sequence))
    events = motmetrics.MOTAccumulator()
    for number, ((true_ids, true_boxes), (ids, boxes)) in enumerate(sequence):
        distance = 1 - iou(true_boxes, boxes)  # motmetrics' own needs NumPy 1
        distance[distance > 1 - least_iou] = np.nan
        events.update(true_ids.tolist(), ids.tolist(), distance, frameid=number)
    summary = _judge().compute(events, metrics=list(_COUNTS), return_dataframe=False)
    counts = {name: round(float(summary[key])) for key, name in _COUNTS.items()}
    return TrackingScore(**counts, higher_order=hota(sequence))


@cache
def _judge() -> Any:
    return motmetrics.metrics.create()


@dataclass(frozen=True, slots=True)
class Continuity:
    """Of the labelled objects of one sequence."""

    objects: int
    found_share: float
    """Mean over objects of the share of their frames at which they are found, 0…1; NaN without objects."""
    gaps: int
    longest_gap: int


def continuity(
    labelled: LabelledFrames, *, word: Callable[[str], str] = str, classes: Collection[str] | None = None
) -> Continuity:
    """Follow every object with an id through its frames; ``word`` and ``classes`` as in `judged.judged`."""
    lives: dict[int, list[bool]] = {}
    for one in judged(labelled, word=word, classes=classes):
        pairs = matched_rows(one.boxes_xyxy_px, one.view.boxes_xyxy_px)
        found = set(pairs[:, 0].tolist())
        for row, number in enumerate(one.ids.tolist()):
            if number != NO_ID:
                lives.setdefault(number, []).append(row in found)
    gaps = [gap for life in lives.values() for gap in _gaps(life)]
    shares = [sum(life) / len(life) for life in lives.values()]
    return Continuity(
        objects=len(lives),
        found_share=sum(shares) / len(shares) if shares else math.nan,
        gaps=len(gaps),
        longest_gap=max(gaps, default=0),
    )


def _gaps(life: list[bool]) -> list[int]:
    """Lengths of the runs of misses after the first find."""
    known = life[life.index(True) :] if True in life else []
    runs = "".join("+" if found else "-" for found in known).split("+")
    return [len(run) for run in runs if run]
