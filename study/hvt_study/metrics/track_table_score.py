"""How well the ground knows what is there: classes of its tracks against ground truth, on every frame."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.labels import decoded
from hvt_study.datasets.layouts.mot import read_truth_rows
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.frames import NO_ID, FrameLabels, FrameView, LabelledFrame

_log = logging.getLogger(__name__)
_MOST_HELD, _LEAST_GAPS = 15, 10
"""Frames; and so many distances have to be known before any counts as usual."""
SMALL_SHARE = 0.0012
"""Objects of less than this share of the frame count as small: about 33x33 pixels of 1280x720."""


@dataclass(frozen=True, slots=True)
class Labelled:
    """Boxes with class names, of one frame."""

    boxes_xyxy_px: npt.NDArray[np.float64]
    """(N, 4), base pixels."""
    classes: tuple[str, ...]
    beside_xyxy_px: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 4)))
    """(P, 4), of the truth: objects that are hidden; who lists one is neither right nor wrong."""


@dataclass(frozen=True, slots=True)
class Score:
    """Over all objects on all frames; an object without a track is neither right nor wrong but missed.

    A share of nothing is NaN.
    """

    objects: int
    recall: float
    """Share of objects that have a track (IoU at least 0.5)."""
    top1: float
    """Share of those whose class is right."""
    macro_f1: float
    """F1 of each class of the truth, averaged; missed objects count as false negatives."""
    small_top1: float
    """Top-1 of those that are small."""
    seen_right: float
    """Share of all objects, missed ones included, that are shown with their right class."""
    named_f1: float
    """2 right / (objects + boxes): found and rightly named, with what is shown and false counted against it."""
    false_per_frame: float
    """Boxes on nothing, or of another class than their object's."""


def read_tracks(path: Path, *, column: str = "class") -> dict[int, Labelled]:
    """Read a tracks table of the ground by frame, from 1 as in MOTChallenge.

    ``column`` is ``class`` or ``base_class``. Tables of earlier versions have ``frame``, from 1, in place
    of ``frame_index``.

    Where the edge codes each n-th frame, those between show the list of the one before.
    """
    rows: dict[int, list[tuple[list[float], str]]] = defaultdict(list)
    try:
        with io.StringIO(decoded(path.read_bytes()), newline="") as file:
            for line in csv.DictReader(file):
                x, y, w, h = (float(line[name]) for name in ("x", "y", "w", "h"))
                frame = int(line["frame_index"]) + 1 if "frame_index" in line else int(line["frame"])
                rows[frame].append(([x, y, x + w, y + h], line[column]))
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:
        raise UserError(
            f"{path} is not a table of tracks as hvt-ground --tracks writes it ({error})"
        ) from None
    return _held({frame: _labelled(found) for frame, found in rows.items()})


def read_truth(path: Path, *, class_names: Sequence[str]) -> dict[int, Labelled]:
    """Read MOTChallenge ground truth (``frame,id,x,y,w,h,1,class,visibility``) by frame; hidden ones stand beside.

    Raises `UserError` where a line is wrong, or no object counts.
    """
    rows = read_truth_rows(path, class_names)
    if not rows.judged.any():
        raise UserError(f"{path} has no object that counts: there is nothing to score against")
    if rows.classless:
        _log.warning("%s has ten columns, which name no class: all are %s", path, rows.class_names[0])
    found: dict[int, Labelled] = {}
    for frame in np.unique(rows.frames).tolist():
        here = rows.frames == frame
        counts = np.flatnonzero(here & rows.judged)
        found[frame] = Labelled(
            rows.boxes[counts].astype(np.float64),
            tuple(rows.class_names[row] for row in counts.tolist()),
            beside_xyxy_px=rows.boxes[here & ~rows.judged].astype(np.float64),
        )
    return found


def score(
    tracks: Mapping[int, Labelled],
    truth: Mapping[int, Labelled],
    *,
    frame_area_px: float,
) -> Score:
    """Match tracks to objects on every frame of the truth and count."""
    nothing = _labelled([])
    labelled = [_frame(truth[frame], tracks.get(frame, nothing)) for frame in sorted(truth)]
    one = class_score(labelled, limits_px2=(SMALL_SHARE * frame_area_px, math.inf))
    return Score(
        objects=one.counts.labels,
        recall=one.recall,
        top1=one.counts.top1_found,
        macro_f1=one.macro_f1_all,
        small_top1=one.by_size["small"].top1_found,
        seen_right=one.counts.top1_all,
        named_f1=one.named_f1 if one.counts.labels else math.nan,
        false_per_frame=one.false_per_frame,
    )


def _held(tracks: dict[int, Labelled]) -> dict[int, Labelled]:
    """With lists for frames between two of the table, where these are as far apart as nine in ten of them are."""
    frames = sorted(tracks)
    gaps = np.diff(frames)
    usual = min(_MOST_HELD, int(np.quantile(gaps, 0.9, method="lower"))) if len(gaps) >= _LEAST_GAPS else 1
    between = {
        frame + step: tracks[frame]
        for frame, gap in zip(frames, [*gaps, usual], strict=True)
        for step in range(1, min(int(gap), usual))
    }
    return tracks | between


def _frame(wanted: Labelled, found: Labelled) -> LabelledFrame:
    ids = np.full(len(found.classes), NO_ID, np.int64)
    labels = FrameLabels(
        wanted.boxes_xyxy_px.astype(np.float32),
        np.full(len(wanted.classes), NO_ID, np.int64),
        wanted.classes,
        beside_xyxy_px=wanted.beside_xyxy_px.astype(np.float32),
    )
    boxes, sure = found.boxes_xyxy_px.astype(np.float32), np.ones(len(ids), np.float32)
    return labels, FrameView(boxes, ids, found.classes, sure, found.classes)


def _labelled(rows: Sequence[tuple[list[float], str]]) -> Labelled:
    boxes = np.array([box for box, _ in rows], np.float64).reshape(-1, 4)
    return Labelled(boxes, tuple(name for _, name in rows))
