"""``hvt-study sweep``: the pilot's selector table, for a clip or for detections from anywhere."""

import argparse
import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.progress import track

from hvt_common.errors import UserError
from hvt_common.files import MOST_TABLE_BYTES, read_text
from hvt_common.inference.detect import Detector, open_detector
from hvt_common.units import parse_size
from hvt_edge.source.opening import Source, open_source
from hvt_edge.source.video import VideoSource
from hvt_edge.stills.policy.paper import SELECTORS
from hvt_study.commands.arguments import check_whole, option
from hvt_study.commands.output import check_out, print_columns, writing
from hvt_study.datasets.annotation_rows import LARGEST
from hvt_study.datasets.labels import check_inside, check_pixels

COLUMNS = ("policy", "selected", "ratio", "frame_coverage")
_INPUT_COLUMNS = ("frame", "x1", "y1", "x2", "y2", "conf", "class")


@dataclass(frozen=True, slots=True)
class RawDetections:
    """A detector's boxes of one frame, in its order."""

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
    """A row a selector; there is a raw detection at least."""
    raw = sum(len(found.confidences) for found in frames.values())
    with_raw = sum(1 for found in frames.values() if found.confidences)
    rows = []
    for selector in SELECTORS:
        counts = [
            len(selector.select(found.boxes_xyxy_px, found.confidences, found.class_names, frame_area_px))
            for found in frames.values()
        ]
        selected, covered = sum(counts), sum(1 for count in counts if count)
        rows.append(SweepRow(selector.name, selected, selected / raw, covered / with_raw))
    return rows


def read_csv(path: Path, size: tuple[int, int]) -> dict[int, RawDetections]:
    """Read raw detections, columns ``frame,x1,y1,x2,y2,conf,class`` with a header, by frame in the file's order.

    ``size`` is (width, height) of the frames in pixels. Raises `UserError` for a line, or boxes, that are not so.
    """
    grouped: dict[int, list[tuple[list[float], float, str]]] = {}
    try:
        with io.StringIO(read_text(path, most=MOST_TABLE_BYTES), newline="") as file:
            for number, line in enumerate(_rows(file, path), start=2):
                frame, box, confidence, name = _parsed(line, path=path, number=number)
                grouped.setdefault(frame, []).append((box, confidence, name))
    except (OSError, csv.Error) as error:
        raise UserError(f"{path} cannot be read ({error}): give a CSV file of detections") from None
    boxes = np.array([box for found in grouped.values() for box, _, _ in found], np.float64).reshape(-1, 4)
    check_pixels(path, boxes)
    check_inside(path, boxes, size, remedy="say their size with --size")
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
    if not all(abs(value) < LARGEST for value in numbers) or not re.search(r"[^\W\d_]", name):  # nor for NaN
        raise UserError(
            f"{path} line {number} has a number that is not below {LARGEST:g}, or no name of a class: {line}"
        )
    x1, y1, x2, y2, confidence = numbers
    if not (x1 <= x2 and y1 <= y2 and 0 <= confidence <= 1):
        raise UserError(
            f"{path} line {number} has corners that are exchanged, or a conf that is not from 0 to 1: {line}"
        )
    return frame, numbers[:4], numbers[4], name


_ANY_SIZE = (64, 64)  # of base frames, which the sweep does not look at

_USUAL = {"detect_every": 5, "confidence": 0.25, "nms_iou": 0.45}
_OF_A_CLIP = ("detector", *_USUAL)
_OF_A_TABLE = ("size",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """A clip and its detector, or a file of detections and its frame size."""
    parser.add_argument(
        "source",
        type=Path,
        metavar="CLIP|DETECTIONS.csv",
        help="a video, or columns frame,x1,y1,x2,y2,conf,class",
    )
    option(parser, "--detector", metavar="DETECTOR", help="for a clip: FILE.onnx or a model's name")
    option(parser, "--size", default=argparse.SUPPRESS, help="for a CSV file: size of the frames")
    every = f"for a clip: one frame in so many (default: {_USUAL['detect_every']})"
    option(parser, "--detect-every", default=argparse.SUPPRESS, help=every)
    least = f"for a clip: least confidence of a raw detection (default: {_USUAL['confidence']:g})"
    option(parser, "--confidence", type=float, help=least)
    overlap = f"for a clip: overlap above which two boxes are one (default: {_USUAL['nms_iou']:g})"
    option(parser, "--nms-iou", type=float, help=overlap)
    option(parser, "--out", required=False, help="also write sweep.csv")


def run(arguments: argparse.Namespace) -> int:
    if arguments.source.suffix.lower() == ".csv":
        frames, area = _from_csv(arguments)
    else:
        frames, area = _from_clip(arguments)
    raw = sum(len(found.confidences) for found in frames.values())
    if not raw:
        raise UserError(f"{arguments.source} has no raw detections: a share of them is selected")
    rows = sweep(frames, frame_area_px=area)
    cells = ((row.policy, str(row.selected), f"{row.ratio:.4f}", f"{row.frame_coverage:.4f}") for row in rows)
    print_columns(f"{raw} raw detections on {len(frames)} frames", COLUMNS, cells, words=("policy",))
    if hasattr(arguments, "out"):
        _write(rows, arguments.out)
    return 0


def _from_csv(arguments: argparse.Namespace) -> tuple[dict[int, RawDetections], float]:
    _refuse(arguments, _OF_A_CLIP, "a table of detections")
    if not hasattr(arguments, "size"):
        raise UserError(
            f"--size is missing: {arguments.source} does not say how large its frames are, for example 1280x720"
        )
    width, height = parse_size(arguments.size, name="--size")
    return read_csv(arguments.source, (width, height)), float(width * height)


def _from_clip(arguments: argparse.Namespace) -> tuple[dict[int, RawDetections], float]:
    _refuse(arguments, _OF_A_TABLE, "a clip and says its size")
    if not hasattr(arguments, "detector"):
        raise UserError(f"--detector is missing: {arguments.source} is a clip, give FILE.onnx")
    said = {**_USUAL, **vars(arguments)}
    every = said["detect_every"]
    check_whole("--detect-every", every, 1)
    detector = open_detector(said["detector"], confidence=said["confidence"], nms_iou=said["nms_iou"])
    with open_source(str(arguments.source), size=_ANY_SIZE, fps=_own_rate(arguments.source)) as source:
        found = track(
            detect_clip(source, detector, every=every),
            description="detecting",
            total=None if source.frame_count is None else -(-source.frame_count // every),
            transient=True,
        )
        return dict(found), float(source.view.source_size[0] * source.view.source_size[1])


def _refuse(arguments: argparse.Namespace, names: Sequence[str], what: str) -> None:
    """An option without effect is a misunderstanding."""
    for name in names:
        if hasattr(arguments, name):
            flag = "--" + name.replace("_", "-")
            raise UserError(f"{flag} has no effect on {arguments.source}, which is {what}: leave it out")


def _own_rate(path: Path) -> float:
    """Frames a second of a clip: the pilot counts its frames, not time. A folder plays image by image at any rate."""
    with open_source(str(path), size=_ANY_SIZE, fps=30) as source:
        if source.live:
            raise UserError(f"{path} is live: give a clip or a folder of images")
        return min(240.0, source.source_fps) if isinstance(source, VideoSource) else source.fps


def _write(rows: Sequence[SweepRow], folder: Path) -> None:
    path = check_out(folder, name="sweep.csv")
    with writing(folder), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(astuple(row) for row in rows)
