"""``hvt-study sweep``: the pilot's selector table, for a clip or for detections from anywhere."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

from rich.progress import track

from hvt_common.errors import UserError
from hvt_common.inference.detect import open_detector
from hvt_common.units import parse_size
from hvt_edge.source.opening import open_source
from hvt_edge.source.video import VideoSource
from hvt_study.commands.arguments import check_whole, option
from hvt_study.commands.output import make_out, print_columns, writing
from hvt_study.matrix.sweep import COLUMNS, RawDetections, SweepRow, detect_clip, read_csv, sweep

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
    """Print the table; write it where ``--out`` says."""
    if arguments.source.suffix.lower() == ".csv":
        frames, area = _from_csv(arguments)
    else:
        frames, area = _from_clip(arguments)
    raw = sum(len(found.confidences) for found in frames.values())
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
    return read_csv(arguments.source), float(width * height)


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
    """What would have no effect is a misunderstanding."""
    for name in names:
        if hasattr(arguments, name):
            flag = "--" + name.replace("_", "-")
            raise UserError(f"{flag} has no say over {arguments.source}, which is {what}: leave it out")


def _own_rate(path: Path) -> float:
    """Frames a second of a clip: the pilot counts its frames, not time. A folder plays image by image at any rate."""
    with open_source(str(path), size=_ANY_SIZE, fps=30) as source:
        if source.live:
            raise UserError(f"{path} is live: give a clip or a folder of images")
        return min(240.0, source.source_fps) if isinstance(source, VideoSource) else source.fps


def _write(rows: Sequence[SweepRow], folder: Path) -> None:
    path = make_out(folder, name="sweep.csv")
    with writing(folder), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(astuple(row) for row in rows)
