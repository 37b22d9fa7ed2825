"""MOTChallenge text files: ``frame,id,x,y,w,h,score,…``, one box a line, frames from 1 (https://motchallenge.net)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.values import Detections, Tracks
from hvt_study.datasets.annotation_rows import Rows, read_rows

_COLUMNS = "frame,id,x,y,w,h,score"


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
    return _meant(read_rows(path, columns=_COLUMNS, least=7))


def read_detections(path: Path) -> MotRows:
    """The same of a file of detections, whose scores are probabilities, and of which all or none have ids."""
    rows = read_rows(path, columns=_COLUMNS, least=7)
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
