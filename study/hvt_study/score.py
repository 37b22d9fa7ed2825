"""How well the ground knows what is there: classes of its tracks against ground truth, on every frame."""

from __future__ import annotations

import csv
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from hvt_common.errors import UserError
from hvt_common.vision.boxes import iou

__all__ = ["Labelled", "Score", "read_tracks", "read_truth", "score"]

SMALL_SHARE = 0.0012
"""Objects of less than this share of the frame count as small: about 33x33 pixels of 1280x720."""
_IOU = 0.5
_LEAST_VISIBLE = 0.5


@dataclass(frozen=True, slots=True)
class Labelled:
    """Boxes with class names, of one frame."""

    boxes_xyxy_px: npt.NDArray[np.float64]
    """(N, 4), base pixels."""
    classes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Score:
    """Over all objects on all frames; an object without a track is neither right nor wrong but missed."""

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


def read_tracks(path: Path, *, column: str = "class") -> dict[int, Labelled]:
    """Read a table of `hvt_ground.export_tracks` by frame (from 1); ``column`` is ``class`` or ``base_class``."""
    rows: dict[int, list[tuple[list[float], str]]] = defaultdict(list)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for line in csv.DictReader(file):
                x, y, w, h = (float(line[name]) for name in ("x", "y", "w", "h"))
                rows[int(line["frame"])].append(([x, y, x + w, y + h], line[column]))
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise UserError(
            f"{path} is not a table of tracks as hvt-ground --tracks writes it ({error})"
        ) from None
    return {frame: _labelled(found) for frame, found in rows.items()}


def read_truth(path: Path, *, class_names: Sequence[str]) -> dict[int, Labelled]:
    """Read MOTChallenge ground truth (``frame,id,x,y,w,h,1,class,visibility``) by frame; hidden objects left out."""
    rows: dict[int, list[tuple[list[float], str]]] = defaultdict(list)
    try:
        with path.open(encoding="utf-8") as file:
            for fields in csv.reader(file):
                x, y, w, h = (float(value) for value in fields[2:6])
                if float(fields[8]) >= _LEAST_VISIBLE:
                    rows[int(fields[0])].append(([x, y, x + w, y + h], class_names[int(fields[7]) - 1]))
    except (OSError, IndexError, ValueError) as error:
        raise UserError(
            f"{path} is not MOTChallenge ground truth of {len(class_names)} classes ({error})"
        ) from None
    return {frame: _labelled(found) for frame, found in rows.items()}


def score(
    tracks: Mapping[int, Labelled],
    truth: Mapping[int, Labelled],
    *,
    frame_area_px: float,
    frames: Sequence[int] = (),
) -> Score:
    """Match tracks to objects frame by frame and count; ``frames`` limits it to some (default: all of the truth)."""
    pairs: Counter[tuple[str, str]] = Counter()
    small: Counter[bool] = Counter()
    missed: Counter[str] = Counter()
    unmatched: Counter[str] = Counter()
    for frame in frames or sorted(truth):
        wanted = truth.get(frame, _labelled([]))
        found = tracks.get(frame, _labelled([]))
        matches = _match(wanted, found)
        areas = np.prod(wanted.boxes_xyxy_px[:, 2:] - wanted.boxes_xyxy_px[:, :2], axis=1)
        for row, name in enumerate(wanted.classes):
            if row not in matches:
                missed[name] += 1
                continue
            said = found.classes[matches[row]]
            pairs[name, said] += 1
            if areas[row] < SMALL_SHARE * frame_area_px:
                small[said == name] += 1
        unmatched.update(said for row, said in enumerate(found.classes) if row not in matches.values())
    return _counted(pairs, small=small, missed=missed, unmatched=unmatched)


def _counted(
    pairs: Counter[tuple[str, str]], *, small: Counter[bool], missed: Counter[str], unmatched: Counter[str]
) -> Score:
    matched = pairs.total()
    objects = matched + missed.total()
    right = sum(count for (name, said), count in pairs.items() if name == said)
    f1 = []
    for name in {name for name, _ in pairs} | set(missed):
        hits = pairs[name, name]
        actual = missed[name] + sum(count for (true, _), count in pairs.items() if true == name)
        claimed = unmatched[name] + sum(count for (_, said), count in pairs.items() if said == name)
        f1.append(2 * hits / max(1, actual + claimed))
    return Score(
        objects=objects,
        recall=matched / max(1, objects),
        top1=right / max(1, matched),
        macro_f1=float(np.mean(f1)) if f1 else 0.0,
        small_top1=small[True] / max(1, small.total()),
        seen_right=right / max(1, objects),
    )


def _match(wanted: Labelled, found: Labelled) -> dict[int, int]:
    """Rows of the truth → rows of the tracks, one to one, most overlap in all, whatever the classes."""
    if not wanted.classes or not found.classes:
        return {}
    overlap = iou(wanted.boxes_xyxy_px, found.boxes_xyxy_px)
    rows, columns = linear_sum_assignment(np.where(overlap >= _IOU, -overlap, 0.0))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {row: column for row, column in pairs if overlap[row, column] >= _IOU}


def _labelled(rows: Sequence[tuple[list[float], str]]) -> Labelled:
    boxes = np.array([box for box, _ in rows], np.float64).reshape(-1, 4)
    return Labelled(boxes, tuple(name for _, name in rows))
