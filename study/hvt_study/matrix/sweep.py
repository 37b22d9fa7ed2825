"""The pilot's selector sweep: what each selector keeps of raw detections."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.files import MOST_TABLE_BYTES, read_text
from hvt_common.inference.detect import Detector
from hvt_edge.source.opening import Source
from hvt_edge.stills.policy.selectors import SELECTORS, select

COLUMNS = ("policy", "selected", "ratio", "frame_coverage")
_INPUT_COLUMNS = ("frame", "x1", "y1", "x2", "y2", "conf", "class")


@dataclass(frozen=True, slots=True)
class RawDetections:
    """What a detector said of one frame, in its order."""

    boxes_xyxy_px: npt.NDArray[Any]
    """(N, 4) float32 of a detector, float64 of a table: the limits of sides and areas are met to the last ROI."""
    confidences: tuple[float, ...]
    class_names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SweepRow:
    """One selector's share."""

    policy: str
    selected: int
    ratio: float
    frame_coverage: float
    """Share of the frames with raw detections that keep at least one ROI."""


def sweep(frames: Mapping[int, RawDetections], *, frame_area_px: float) -> list[SweepRow]:
    """Apply every selector to every frame."""
    raw = sum(len(found.confidences) for found in frames.values())
    with_raw = sum(1 for found in frames.values() if found.confidences)
    rows = []
    for selector in SELECTORS:
        counts = [
            len(select(selector, found.boxes_xyxy_px, found.confidences, found.class_names, frame_area_px))
            for found in frames.values()
        ]
        selected, covered = sum(counts), sum(1 for count in counts if count)
        rows.append(SweepRow(selector.name, selected, selected / max(1, raw), covered / max(1, with_raw)))
    return rows


def read_csv(path: Path) -> dict[int, RawDetections]:
    """Read raw detections, columns ``frame,x1,y1,x2,y2,conf,class`` with a header, by frame in the file's order."""
    grouped: dict[int, list[tuple[list[float], float, str]]] = {}
    try:
        with io.StringIO(read_text(path, most=MOST_TABLE_BYTES), newline="") as file:
            for number, line in enumerate(_rows(file, path), start=2):
                frame, box, confidence, name = _parsed(line, path=path, number=number)
                grouped.setdefault(frame, []).append((box, confidence, name))
    except (OSError, csv.Error) as error:
        raise UserError(f"{path} cannot be read ({error}): give a CSV file of detections") from None
    return {
        frame: RawDetections(
            np.array([box for box, _, _ in found], np.float64).reshape(-1, 4),
            tuple(confidence for _, confidence, _ in found),
            tuple(name for _, _, name in found),
        )
        for frame, found in grouped.items()
    }


def detect_clip(source: Source, detector: Detector, *, every: int) -> Iterator[tuple[int, RawDetections]]:
    """Detect on every n-th frame of a clip, on the untouched pixels; yields (frame, detections)."""
    for frame in source.frames(start_ns=0):
        if frame.index % every:
            continue
        found = detector.detect(frame.source_bgr)
        names = tuple(detector.class_names[index] for index in found.class_ids.tolist())
        yield frame.index, RawDetections(found.boxes_xyxy_px, tuple(found.confidences.tolist()), names)


def _rows(file: Iterator[str], path: Path) -> Iterator[dict[str, str]]:
    reader = csv.DictReader(file)
    missing = [name for name in _INPUT_COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"{path} has no column {', '.join(missing)}: {','.join(_INPUT_COLUMNS)} are needed")
    return iter(reader)


def _parsed(line: dict[str, str], *, path: Path, number: int) -> tuple[int, list[float], float, str]:
    try:
        frame = int(line["frame"])
        numbers = [float(line[name]) for name in _INPUT_COLUMNS[1:6]]
        name = line["class"].strip()
    except (ValueError, TypeError, AttributeError):
        raise UserError(f"{path} line {number} is not {','.join(_INPUT_COLUMNS)}: {line}") from None
    if not all(math.isfinite(value) for value in numbers) or not name:
        raise UserError(f"{path} line {number} has a number that is not finite, or no class: {line}")
    return frame, numbers[:4], numbers[4], name
