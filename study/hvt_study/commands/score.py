"""``hvt-study score``: tables of tracks against ground truth, side by side."""

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.units import parse_size
from hvt_scene import Scene
from hvt_study.commands.arguments import option
from hvt_study.commands.output import ONE_TARGET, print_columns, print_lines
from hvt_study.datasets.labels import FrameLabels, check_inside, check_pixels
from hvt_study.metrics.classes import ClassScore
from hvt_study.metrics.judged import FrameView
from hvt_study.metrics.track_table_score import read_tracks, read_truth, score

_ROWS: tuple[tuple[str, Callable[[ClassScore], float]], ...] = (
    ("found (recall at IoU 0.5)", lambda one: one.recall),
    ("class right, of those found (top-1)", lambda one: one.counts.top1_found),
    ("the same of small objects", lambda one: one.by_size["small"].top1_found),
    ("found with the right class", lambda one: one.counts.top1_all),
)
_OF_ALL_ROWS: tuple[tuple[str, Callable[[ClassScore], float]], ...] = (
    ("macro-F1", lambda one: one.macro_f1_all),
    ("named F1", lambda one: one.named_f1),
    ("false objects a frame", lambda one: one.false_per_frame),
)
"""Where all objects are labelled."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "tracks", nargs="+", metavar="[NAME=]TRACKS.csv", help="tables of tracks; NAME heads the column"
    )
    truth = "MOTChallenge ground truth: frame,id,x,y,w,h,1,class,visibility"
    option(parser, "--truth", type=Path, required=True, metavar="GT.txt", help=truth)
    option(parser, "--classes", default=",".join(Scene.class_names), help="names of the truth's classes")
    option(parser, "--size")


def run(arguments: argparse.Namespace) -> int:
    width, height = size = parse_size(arguments.size, name="--size")
    names = [name.strip() for name in arguments.classes.split(",")]
    if not all(names):
        raise UserError(
            f"--classes {arguments.classes!r} has an empty name: give names between commas, from class 1 on"
        )
    truth, one_target = read_truth(arguments.truth, class_names=names)
    _check(arguments.truth, truth, size)
    columns: list[tuple[str, ClassScore]] = []
    for spec in arguments.tracks:
        name, separator, path = spec.rpartition("=")
        file = Path(path)
        label = name if separator else file.stem
        tracks = read_tracks(file)
        _check(file, tracks, size)
        columns.append((label, score(tracks, truth, frame_area_px=width * height)))
    _print(columns, one_target=one_target)
    return 0


def _check(path: Path, frames: Mapping[int, FrameLabels | FrameView], size: tuple[int, int]) -> None:
    # Of truth in the source's pixels no track of the base stream would meet an object.
    boxes = np.concatenate([np.empty((0, 4), np.float32), *(one.boxes_xyxy_px for one in frames.values())])
    check_pixels(path, boxes)
    remedy = "both files are in pixels of the base stream, and --size WxH says its size"
    check_inside(path, boxes, size, remedy=remedy)


def _print(columns: Sequence[tuple[str, ClassScore]], *, one_target: bool) -> None:
    rows = [("objects on all frames", *(f"{one.counts.labels}" for _, one in columns))]
    for label, figure in _ROWS if one_target else (*_ROWS, *_OF_ALL_ROWS):
        figures = [figure(one) for _, one in columns]
        rows.append((label, *("-" if math.isnan(one) else f"{one:.3f}" for one in figures)))
    heads = ("", *(name for name, _ in columns))
    print_columns("What the ground knows, on every frame", heads, rows, words=("",))
    if one_target:
        print_lines(ONE_TARGET)
