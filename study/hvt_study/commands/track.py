"""``hvt-study track``: the tracker alone, over a file of detections, to compare it with others."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError, check_not_read
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_study.datasets.annotation_rows import LAST_FRAME
from hvt_study.datasets.mot_files import detections_by_frame, read_detections, rows_of_tracks, write_mot


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, frame rate, and the options of the authors' program by their names there."""
    share = _number(0, 1)
    parser.add_argument("detections", type=Path, metavar="DETECTIONS", help="lines of frame,id,x,y,w,h,score")
    parser.add_argument(
        "--out",
        type=Path,
        required=True,
        default=argparse.SUPPRESS,
        metavar="TRACKS",
        help="the file of tracks to write",
    )
    parser.add_argument("--fps", type=_number(0, 1000, open_below=True), default=30.0, help="frames a second")
    parser.add_argument(
        "--track-thresh", type=share, default=0.5, help="score above which tracks are matched first"
    )
    parser.add_argument(
        "--low-thresh", type=share, default=0.1, help="score below which detections are ignored"
    )
    parser.add_argument(
        "--new-thresh",
        type=share,
        default=argparse.SUPPRESS,
        help="least score of a new track (default: track-thresh + 0.1)",
    )
    parser.add_argument(
        "--track-buffer", type=_whole, default=30, help="memory for lost tracks, frames at 30 fps"
    )
    parser.add_argument(
        "--match-thresh", type=share, default=0.8, help="greatest cost 1 - IoU * score of a match"
    )
    parser.add_argument("--no-fuse-scores", action="store_true", help="match by IoU alone (mot20)")
    parser.add_argument(
        "--min-box-area",
        type=_number(0, math.inf),
        default=10.0,
        help="boxes up to this are not written, square px",
    )


def run(arguments: argparse.Namespace) -> int:
    """Track all frames, write the tracks, print one line."""
    settings = _settings(arguments)
    source, out = arguments.detections, arguments.out
    check_not_read(out, [source], name="--out")
    rows = read_detections(source)
    tracker = ByteTracker(settings, fps=arguments.fps)
    tracks = [tracker.update(seen, frame_index=frame) for frame, seen in detections_by_frame(rows)]
    found = rows_of_tracks(tracks)
    write_mot(out, found)
    empty = np.count_nonzero((rows.boxes_xywh_px[:, 2:] <= 0).any(axis=1))
    print(
        f"{out}: {len(tracks)} frames, {len(np.unique(found.ids))} tracks, {len(found)} boxes"
        + (f"; {empty} detections without area left out" if empty else "")
    )
    return 0


def _settings(arguments: argparse.Namespace) -> TrackerSettings:
    if arguments.low_thresh > arguments.track_thresh:
        raise UserError(
            f"--low-thresh is {arguments.low_thresh}, must not exceed --track-thresh, {arguments.track_thresh}"
        )
    return TrackerSettings(
        track_confidence=arguments.track_thresh,
        low_confidence=arguments.low_thresh,
        new_confidence=getattr(arguments, "new_thresh", None),
        match_iou=1 - arguments.match_thresh,
        track_buffer=arguments.track_buffer,
        fuse_scores=not arguments.no_fuse_scores,
        min_box_area_px2=arguments.min_box_area,
    )


def _number(low: float, high: float, *, open_below: bool = False) -> Callable[[str], float]:
    """An argparse type: a number within bounds, ``low`` itself excluded where ``open_below``."""
    span = f"{'above' if open_below else 'from'} {low}" + ("" if math.isinf(high) else f" to {high}")

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        within = math.isfinite(value) and low <= value <= high and not (open_below and value == low)
        if not within:
            raise argparse.ArgumentTypeError(f"is {text}, must be a number {span}")
        return value

    return parse


def _whole(text: str) -> int:
    """An argparse type: a whole number from 0 to the last frame there can be."""
    if not (text.isascii() and text.isdigit() and int(text) <= LAST_FRAME):
        raise argparse.ArgumentTypeError(f"is {text}, must be a whole number from 0 to {LAST_FRAME}")
    return int(text)
