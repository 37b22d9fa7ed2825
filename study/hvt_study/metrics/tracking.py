"""Tracks: MOTA by the kept library ``motmetrics``, HOTA by `hota`, IDF1 by `_in_common`.

HOTA is after Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 129 (2021), and
gives the authors' figures to the last digit. Their package (``trackeval``) brings ``opencv-python`` with it, which
overwrites the headless OpenCV of HVT.

CLEAR MOT: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance", 2008. IDF1: Ristani et al.,
"Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016. A box is on a label from an IoU
of 0.5 on, whatever the classes.

Continuity says how steadily labelled objects are held. A gap is a run of an object's frames in which it is missed
after it was found once; the time before is no gap: recall has it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import motmetrics
import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from hvt_common.values import iou
from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.judged import LEAST_IOU, Judged, matched_rows

ALPHAS: Final = np.arange(0.05, 0.99, 0.05)
"""(19,) least IoU of a match; HOTA is the mean over them (section 3.4 of the paper)."""

_EPSILON: Final = float(np.finfo(float).eps)

IdBoxes = tuple[npt.NDArray[np.integer[Any]], npt.NDArray[np.floating[Any]]]
"""Ids (N,), each once, and their boxes (N, 4) x1 y1 x2 y2, of one frame."""


def hota(frames: Sequence[tuple[IdBoxes, IdBoxes]]) -> float:
    """Mean over `ALPHAS` of sqrt(DetA AssA) (equations 12 and 17); NaN where no track was labelled.

    For each frame of one sequence there are the true tracks and those that are shown, in one pixel space.
    As in the authors' program one matching serves all alphas of a frame: the assignment of the greatest sum of
    overlap times global alignment of the two tracks (section 3.3 of the paper and its appendix).
    """
    true_ids, true_lengths = _each([ids for (ids, _), _ in frames])
    shown_ids, lengths = _each([ids for _, (ids, _) in frames])
    overlaps = [
        (np.searchsorted(true_ids, true), np.searchsorted(shown_ids, shown), iou(true_boxes, boxes))
        for (true, true_boxes), (shown, boxes) in frames
        if len(true) and len(shown)
    ]
    overlaps = [one for one in overlaps if one[2].any()]
    pairs, shares = [np.empty(0, np.int64)], [np.empty(0)]
    for true, shown, overlap in overlaps:
        rows, columns = overlap.nonzero()
        share = overlap[rows, columns]
        rest = overlap.sum(axis=0)[columns] + overlap.sum(axis=1)[rows] - share
        shares.append(np.divide(share, rest, out=np.zeros_like(share), where=rest > _EPSILON))
        pairs.append(true[rows] * len(lengths) + shown[columns])
    known, pair = np.unique(np.concatenate(pairs), return_inverse=True)
    together = np.bincount(pair, np.concatenate(shares), len(known))
    either = true_lengths[known // len(lengths)] + lengths[known % len(lengths)]
    alignment = together / (either - together)
    matched, at, begin = [np.empty(0, np.int64)], [np.empty(0)], 0
    for _, _, overlap in overlaps:
        meet = overlap.nonzero()
        end = begin + len(meet[0])
        numbers = np.zeros(overlap.shape, np.int64)
        numbers[meet] = pair[begin:end]
        begin = end
        best = linear_sum_assignment(alignment[numbers] * overlap, maximize=True)
        matched.append(numbers[best])
        at.append(overlap[best])
    pair = np.concatenate(matched)
    enough = np.concatenate(at)[None, :] >= ALPHAS[:, None] - _EPSILON
    matches = np.stack([np.bincount(pair[row], minlength=len(known)) for row in enough])  # (19, pairs)
    hits = matches.sum(axis=1).astype(np.float64)
    detection = hits / np.maximum(1, true_lengths.sum() + lengths.sum() - hits)  # equation 14
    alike = (matches**2 / np.maximum(1, either - matches)).sum(axis=1)  # equation 13
    association = alike / np.maximum(1, hits)  # equation 15
    return float(np.sqrt(detection * association).mean()) if len(true_ids) else math.nan


def _each(ids: Sequence[npt.NDArray[np.integer[Any]]]) -> tuple[npt.NDArray[Any], npt.NDArray[np.float64]]:
    """All tracks, sorted, and the frames of each."""
    known, lengths = np.unique(np.concatenate([np.empty(0, np.int64), *ids]), return_counts=True)
    return known, lengths.astype(np.float64)


_COUNTS: Final = {
    "num_objects": "objects",
    "num_misses": "misses",
    "num_false_positives": "false_positives",
    "num_switches": "switches",
}


@dataclass(frozen=True, slots=True)
class TrackingScore:
    """Counts of one sequence."""

    objects: int
    """Labels that belong to a track, over all frames."""
    misses: int
    false_positives: int
    switches: int
    """How often a true track was found under another id than when it was last found."""
    id_true_positives: int
    id_false_positives: int
    id_false_negatives: int
    hota: float
    """See `hota`; NaN where no track was labelled."""

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


def tracking_score(frames: Iterable[Judged]) -> TrackingScore:
    """Compare the tracks shown at every frame with the labelled ones.

    Labels without ids say nothing of tracks: where none has one, every figure is NaN.
    """
    sides: list[tuple[IdBoxes, IdBoxes]] = []
    for one in frames:
        known, tracked = one.ids != NO_ID, one.view.ids != NO_ID
        true = one.ids[known], one.boxes_xyxy_px[known]
        sides.append((true, (one.view.ids[tracked], one.view.boxes_xyxy_px[tracked])))
    return compare_tracks(sides)


def compare_tracks(
    frames: Iterable[tuple[IdBoxes, IdBoxes]], *, least_iou: float = LEAST_IOU
) -> TrackingScore:
    """The same for plain ids and boxes: for each frame, in order, the true tracks and those that are shown.

    Ids are unique within a frame; boxes are x1 y1 x2 y2 in one pixel space.
    """
    sequence = list(frames)
    shown = sum(len(ids) for _, (ids, _) in sequence)
    if not any(len(ids) for (ids, _), _ in sequence):
        # motmetrics has no answer here.
        return TrackingScore(0, 0, shown, 0, 0, shown, 0, hota=math.nan)
    events = motmetrics.MOTAccumulator()
    pairs = [np.empty((0, 2), np.int64)]
    for number, ((true_ids, true_boxes), (ids, boxes)) in enumerate(sequence):
        distance = 1 - iou(true_boxes, boxes)  # motmetrics' own needs NumPy 1
        distance[distance > 1 - least_iou] = np.nan
        events.update(true_ids.tolist(), ids.tolist(), distance, frameid=number)
        rows, columns = np.isfinite(distance).nonzero()
        pairs.append(np.stack((true_ids[rows], ids[columns]), axis=1))
    summary = _judge().compute(events, metrics=list(_COUNTS), return_dataframe=False)
    counts = {name: round(float(summary[key])) for key, name in _COUNTS.items()}
    hits = _in_common(np.concatenate(pairs))
    return TrackingScore(
        **counts,
        id_true_positives=hits,
        id_false_positives=shown - hits,
        id_false_negatives=counts["objects"] - hits,
        hota=hota(sequence),
    )


def _in_common(pairs: npt.NDArray[np.integer[Any]]) -> int:
    """IDTP of (N, 2) true and shown ids, a row for each frame in which the two are at the same place.

    That is the most frames that an assignment of tracks to tracks has in common (Ristani et al., section 4). It is
    found for each group of tracks that have met, so that 10,000 tracks need no matrix of all with all.
    """
    (true, row), (shown, column) = (np.unique(ids, return_inverse=True) for ids in pairs.T)
    column += len(true)
    size = len(true) + len(shown)
    met = csr_array((np.ones(len(pairs)), (row, column)), shape=(size, size))  # which adds up
    count, group = connected_components(met, directed=False)
    order = np.argsort(group, kind="stable")
    hits = 0.0
    for members in np.split(order, np.cumsum(np.bincount(group, minlength=count))[:-1]):
        rows, columns = np.split(members, [np.searchsorted(members, len(true))])
        together = met[rows][:, columns].toarray()
        hits += together[linear_sum_assignment(together, maximize=True)].sum()
    return round(hits)


@cache
def _judge() -> Any:
    return motmetrics.metrics.create()


@dataclass(frozen=True, slots=True)
class Continuity:
    """Continuity of the labelled objects of one sequence."""

    found_share: float
    """Mean over objects of the share of their frames at which they are found, 0…1; NaN without objects."""
    gaps: int | None
    """None where no object was ever found, as ``longest_gap``: else who finds nothing would hold it best."""
    longest_gap: int | None
    """Frames; 0 where there is no gap."""


def continuity(frames: Iterable[Judged]) -> Continuity:
    """Follow every object with an id through its frames."""
    lives: dict[int, list[bool]] = {}
    for one in frames:
        pairs = matched_rows(one.boxes_xyxy_px, one.view.boxes_xyxy_px)
        found = set(pairs[:, 0].tolist())
        for row, number in enumerate(one.ids.tolist()):
            if number != NO_ID:
                lives.setdefault(number, []).append(row in found)
    found_ever = any(map(any, lives.values()))
    gaps = [gap for life in lives.values() for gap in _gaps(life)]
    shares = [sum(life) / len(life) for life in lives.values()]
    return Continuity(
        found_share=sum(shares) / len(shares) if shares else math.nan,
        gaps=len(gaps) if found_ever else None,
        longest_gap=max(gaps, default=0) if found_ever else None,
    )


def _gaps(life: list[bool]) -> list[int]:
    """Lengths of the runs of misses after the first find."""
    known = life[life.index(True) :] if True in life else []
    runs = "".join("+" if found else "-" for found in known).split("+")
    return [len(run) for run in runs if run]
