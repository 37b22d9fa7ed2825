"""``hvt-study track``: the tracker alone, over a file of detections, to compare it with others."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError, check_not_read
from hvt_common.tracking.bytetrack import ByteTracker, TrackerSettings
from hvt_common.values import Detections, Tracks
from hvt_study.datasets.annotation_rows import LAST_FRAME, Rows, read_rows

_MOT = "frame,id,x,y,w,h,score"


@dataclass(frozen=True, slots=True)
class MotRows:
    """The boxes of a file, in its order."""

    frames: npt.NDArray[np.int64]
    """(N,) frame numbers as in the file, usually from 1."""
    ids: npt.NDArray[np.int64]
    """(N,) track ids; -1 in files of detections."""
    boxes_xywh_px: npt.NDArray[np.float64]
    """(N, 4) left, top, width, height; sizes may be zero or negative in bad files."""
    scores: npt.NDArray[np.float64]
    """(N,) confidence, usually 0…1."""

    def __len__(self) -> int:
        return len(self.frames)


def read_mot(path: Path) -> MotRows:
    """Read a file; columns after the score are ignored and blank lines skipped.

    A `UserError` names the file that cannot be read, or the first line that is malformed.
    """
    return _meant(read_rows(path, columns=_MOT, least=7))


def read_detections(path: Path) -> MotRows:
    """The same of a file of detections, whose scores are probabilities, and of which all or none have ids."""
    rows = read_rows(path, columns=_MOT, least=7)
    score, ids = rows["score"], rows["id"]
    rows.only((score >= 0) & (score <= 1), accepted="a score from 0 to 1 in column 7")
    if len(rows):
        with_id = ids[0] >= 0
        rows.only(
            (ids >= 0) == with_id,
            accepted=f"{'an id' if with_id else '-1'} in column 2, as in the first line",
        )
    return _meant(rows)


def _meant(rows: Rows) -> MotRows:
    return MotRows(
        frames=rows["frame"].astype(np.int64),
        ids=rows["id"].astype(np.int64),
        boxes_xywh_px=rows.table[:, 2:6],
        scores=rows["score"],
    )


def detections_by_frame(rows: MotRows) -> Iterator[tuple[int, Detections]]:
    """Every frame from 1 (or 0, where the file begins there) to the last, also those without detections.

    Boxes become x1 y1 x2 y2 float32 in the order of the file; all classes are 0, which the format does not know.
    """
    if not len(rows):
        return
    order = np.argsort(rows.frames, kind="stable")
    frames = rows.frames[order]
    xywh = rows.boxes_xywh_px[order]
    boxes = np.concatenate((xywh[:, :2], xywh[:, :2] + xywh[:, 2:]), axis=1).astype(np.float32)
    scores = rows.scores[order].astype(np.float32)
    first, last = min(1, int(frames[0])), int(frames[-1])
    bounds = np.searchsorted(frames, np.arange(first, last + 2))
    for frame in range(first, last + 1):
        part = slice(bounds[frame - first], bounds[frame - first + 1])
        yield frame, Detections(boxes[part], scores[part], np.zeros(len(scores[part]), np.int32))


def rows_of_tracks(tracks: list[Tracks]) -> MotRows:
    """All boxes of a list of frames as rows, by frame and then by id."""
    boxes = np.concatenate([np.empty((0, 4)), *(each.boxes_xyxy_px.astype(np.float64) for each in tracks)])
    boxes[:, 2:] -= boxes[:, :2]
    return MotRows(
        frames=np.repeat(
            np.array([each.frame_index for each in tracks], np.int64), [len(each) for each in tracks]
        ),
        ids=np.concatenate([np.empty(0, np.int64), *(each.ids for each in tracks)]),
        boxes_xywh_px=boxes,
        scores=np.concatenate([np.empty(0), *(each.confidences.astype(np.float64) for each in tracks)]),
    )


def write_mot(path: Path, rows: MotRows) -> None:
    """Write ``frame,id,x,y,w,h,score,-1,-1,-1`` lines; a `UserError` where the file cannot be written."""
    lines = [
        f"{frame},{track_id},{x:.4f},{y:.4f},{w:.4f},{h:.4f},{score:.4f},-1,-1,-1\n"
        for frame, track_id, (x, y, w, h), score in zip(
            rows.frames.tolist(),
            rows.ids.tolist(),
            rows.boxes_xywh_px.tolist(),
            rows.scores.tolist(),
            strict=True,
        )
    ]
    try:
        path.write_text("".join(lines), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from None


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
    if not (text.isascii() and text.isdigit() and int(text) <= LAST_FRAME):
        raise argparse.ArgumentTypeError(f"is {text}, must be a whole number from 0 to {LAST_FRAME}")
    return int(text)
