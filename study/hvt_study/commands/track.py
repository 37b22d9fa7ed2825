"""``hvt-study track``: the tracker alone, over a file of detections, to compare it with others."""

import argparse
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError, check_not_read
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections, Tracks
from hvt_study.datasets.annotation_rows import LAST_FRAME, Rows, read_rows
from hvt_study.datasets.labels import check_pixels

_log = logging.getLogger(__name__)

_MOT = "frame,id,x,y,w,h,score"
_FEW = 10
"""Boxes of which some lie right of the picture's middle."""
_REMEMBERED = 3
"""Frames without detections after which the tracker, where it tracks nothing, is as after any more of them."""


def read_detections(path: Path) -> Rows:
    """Read a file, whose scores are probabilities, and of which all or none have ids.

    Columns after the score are ignored and blank lines skipped. A `UserError` names the file that cannot be read, or
    the first line that is malformed.
    """
    rows = read_rows(path, columns=_MOT, least=7)
    score, ids = rows["score"], rows["id"]
    rows.only((score >= 0) & (score <= 1), accepted="a score from 0 to 1 in column 7")
    check_pixels(path, [rows[side] for side in "xywh"])
    sides, lengths = rows.table[:, 4:6], rows.table[:, 4:6] - rows.table[:, 2:4]
    # Of sizes w - x is no more alike than w: those of one close object are larger than its place too.
    if len(rows) >= _FEW and (lengths > 0).all() and lengths.var(axis=0).sum() < sides.var(axis=0).sum():
        _log.warning(
            "%s: each w is larger than its x, and each h than its y: are they corners, x1,y1,x2,y2? Accepted is %s",
            *(path, _MOT),
        )
    if len(rows):
        with_id = ids[0] >= 0
        rows.only(
            (ids >= 0) == with_id,
            accepted=f"{'an id' if with_id else '-1'} in column 2, as in the first line",
        )
    return rows


def tracked(tracker: ByteTracker, rows: Rows) -> Iterator[Tracks]:
    """The tracks of frames from 1 (or 0, where the file begins there) to the last, also of those without detections.

    While nothing is tracked only the last `_REMEMBERED` frames before the next detection are gone through. Boxes
    become x1 y1 x2 y2 float32 in the order of the file; all classes are 0, which the format does not know.
    """
    if not len(rows):
        return
    table = rows.table[np.argsort(rows["frame"], kind="stable")]
    frames, xywh = table[:, 0], table[:, 2:6]
    boxes = np.concatenate((xywh[:, :2], xywh[:, :2] + xywh[:, 2:]), axis=1).astype(np.float32)
    scores = table[:, 6].astype(np.float32)
    here, starts = np.unique(frames, return_index=True)
    frame = int(min(1, frames[0]))
    for found, start, end in zip(here.tolist(), starts, [*starts[1:], len(frames)], strict=True):
        while frame < found:
            if tracker.is_empty:
                frame = max(frame, int(found) - _REMEMBERED)
            yield tracker.update(Detections.none(), frame_index=frame)
            frame += 1
        seen = Detections(boxes[start:end], scores[start:end], np.zeros(end - start, np.int32))
        yield tracker.update(seen, frame_index=frame)
        frame += 1


def rows_of_tracks(tracks: Iterable[Tracks]) -> npt.NDArray[np.float64]:
    """(N, 7) ``frame,id,x,y,w,h,score`` of all boxes of frames, by frame and then by id."""
    rows = [np.empty((0, 7))]
    for each in filter(len, tracks):
        boxes = each.boxes_xyxy_px.astype(np.float64)
        boxes[:, 2:] -= boxes[:, :2]
        frame = np.full(len(each), each.frame_index)
        rows.append(np.column_stack((frame, each.ids, boxes, each.confidences.astype(np.float64))))
    return np.concatenate(rows)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Files, frame rate, and the options of the authors' program by their names there."""
    share = _number(0, 1)
    parser.add_argument("detections", type=Path, metavar="DETECTIONS", help="lines of frame,id,x,y,w,h,score")
    add, hidden = parser.add_argument, argparse.SUPPRESS
    written = "the file of tracks to write"
    add("--out", type=Path, required=True, default=hidden, metavar="TRACKS", help=written)
    add("--fps", type=_number(0, 1000, open_below=True), default=30.0, help="frames a second")
    add("--track-thresh", type=share, default=0.5, help="score above which tracks are matched first")
    add("--low-thresh", type=share, default=0.1, help="score below which detections are ignored")
    least = "least score of a new track (default: track-thresh + 0.1)"
    add("--new-thresh", type=share, default=hidden, help=least)
    add("--track-buffer", type=_whole, default=30, help="memory for lost tracks, frames at 30 fps")
    add("--match-thresh", type=share, default=0.8, help="greatest cost 1 - IoU * score of a match")
    add("--no-fuse-scores", action="store_true", help="match by IoU alone (mot20)")
    small = "boxes up to this are not written, square px"
    add("--min-box-area", type=_number(0, math.inf), default=10.0, help=small)


def run(arguments: argparse.Namespace) -> int:
    """Track all frames, write the tracks, print one line."""
    settings = _settings(arguments)
    source, out = arguments.detections, arguments.out
    check_not_read(out, [source], name="--out")
    rows = read_detections(source)
    found = rows_of_tracks(tracked(ByteTracker(settings, fps=arguments.fps), rows))
    try:
        with out.open("w", encoding="utf-8") as file:
            np.savetxt(file, found, fmt="%d,%d" + 5 * ",%.4f" + 3 * ",-1")
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from None
    frames = rows["frame"]
    count = round(frames.max() - min(1, frames.min())) + 1 if len(rows) else 0
    empty = np.count_nonzero((rows.table[:, 4:6] <= 0).any(axis=1))
    print(
        f"{out}: {count} frames, {len(np.unique(found[:, 1]))} tracks, {len(found)} boxes"
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
    if not (text.isascii() and text.isdigit() and int(text) <= LAST_FRAME):
        raise argparse.ArgumentTypeError(f"is {text}, must be a whole number from 0 to {LAST_FRAME}")
    return int(text)
