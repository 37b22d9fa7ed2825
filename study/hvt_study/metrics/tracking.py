"""Tracks: MOTA and IDF1 by the kept library ``motmetrics``, HOTA by `hota`.

CLEAR MOT: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance", 2008. IDF1: Ristani et al.,
"Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking", 2016. A box is on a label from an IoU
of 0.5 on, whatever the classes. All figures of several sequences are pooled by adding up their counts, as the
benchmarks do.

Continuity says how steadily labelled objects are held. A gap is a run of an object's frames in which it is missed
after it was found once; the time before is no gap: recall has it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import motmetrics
import numpy as np

from hvt_common.values import iou
from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.frames import LabelledFrames
from hvt_study.metrics.hota import Hota, IdBoxes, hota
from hvt_study.metrics.judged import LEAST_IOU, judged, matched_rows

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
    labelled: LabelledFrames,
    *,
    word: Callable[[str], str] = str,
    classes: Collection[str] | None = None,
    least_iou: float = LEAST_IOU,
) -> TrackingScore:
    """Compare what is shown at every frame with the labelled tracks; ``word`` and ``classes`` as in `judged.judged`.

    Labels without ids say nothing of tracks: where none has one, every figure is NaN.
    """
    frames: list[tuple[IdBoxes, IdBoxes]] = []
    for one in judged(labelled, word=word, classes=classes):
        known, tracked = one.ids != NO_ID, one.view.ids != NO_ID
        true = one.ids[known], one.boxes_xyxy_px[known]
        frames.append((true, (one.view.ids[tracked], one.view.boxes_xyxy_px[tracked])))
    return compare_tracks(frames, least_iou=least_iou)


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
    return TrackingScore(**_counts(events), higher_order=hota(sequence))


def _counts(events: Any) -> dict[str, int]:
    summary = _judge().compute(events, metrics=list(_COUNTS), return_dataframe=False)
    return {name: round(float(summary[key])) for key, name in _COUNTS.items()}


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
    """Frames."""


def continuity(
    labelled: LabelledFrames,
    *,
    word: Callable[[str], str] = str,
    classes: Collection[str] | None = None,
    least_iou: float = LEAST_IOU,
) -> Continuity:
    """Follow every object with an id through its frames; ``word`` and ``classes`` as in `judged.judged`."""
    lives: dict[int, list[bool]] = {}
    for one in judged(labelled, word=word, classes=classes):
        pairs = matched_rows(one.boxes_xyxy_px, one.view.boxes_xyxy_px, least_iou=least_iou)
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
