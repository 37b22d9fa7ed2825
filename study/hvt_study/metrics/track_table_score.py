"""The classes of the ground's tracks against ground truth, on every frame."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.files import MOST_TABLE_BYTES, read_text
from hvt_study.datasets.annotation_rows import LARGEST
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.mot import read_truth_rows
from hvt_study.metrics.classes import ClassScore, class_score
from hvt_study.metrics.judged import FrameView, judged

_log = logging.getLogger(__name__)
_MOST_HELD, _LEAST_GAPS = 15, 10
"""Frames; and so many distances have to be known before any counts as usual."""
SMALL_SHARE = 0.0012
"""Objects of less than this share of the frame count as small: about 33x33 pixels of 1280x720."""


def read_tracks(path: Path) -> dict[int, FrameView]:
    """Read a tracks table of the ground by frame, from 1 as in MOTChallenge.

    Tables of earlier versions have ``frame``, from 1, in place of ``frame_index``.

    Where the edge codes each n-th frame, those between show the list of the one before. Lines of stored video that
    came after an outage are left out, which is said: at their frames nobody knew of them.
    """
    late = 0
    rows: dict[int, tuple[list[list[float]], list[str]]] = defaultdict(lambda: ([], []))
    try:
        with io.StringIO(read_text(path, most=MOST_TABLE_BYTES), newline="") as file:
            for frame, box, name, is_late in _lines(csv.DictReader(file)):
                late += is_late
                if not is_late:
                    rows[frame][0].append(box)
                    rows[frame][1].append(name)
    except OSError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror}): give a table of hvt-ground --tracks"
        ) from None
    except (ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is not a table of tracks as hvt-ground --tracks writes it ({error})"
        ) from None
    if late:
        _log.warning("%s: %d lines came late, after an outage, and are left out", path, late)
    return _held({frame: FrameView.plain(*found) for frame, found in rows.items()})


def _lines(table: csv.DictReader[str]) -> Iterator[tuple[int, list[float], str, bool]]:
    # Frame, box, class and whether it came late, of each line; ValueError where there are none.
    missing = [name for name in (*"xywh", "class") if name not in (table.fieldnames or ())]
    if missing:
        raise ValueError(f"it has no column {', '.join(missing)}")
    for line in table:
        try:
            x, y, w, h = (float(line[name]) for name in "xywh")
            frame = int(line["frame_index"]) + 1 if "frame_index" in line else int(line["frame"])
        except (KeyError, ValueError, TypeError):
            x = y = w = h = math.nan
        if line["class"] is None or not all(abs(side) < LARGEST for side in (x, y, w, h)):  # nor for NaN
            raise ValueError(f"line {table.line_num} has no frame, box or class")
        yield frame, [x, y, x + w, y + h], line["class"], line.get("late") == "1"


def read_truth(path: Path, *, class_names: Sequence[str]) -> tuple[dict[int, FrameLabels], bool]:
    """Read MOTChallenge ground truth (``frame,id,x,y,w,h,1,class,visibility``) by frame; hidden ones stand beside.

    And whether one target is labelled, so that nobody knows which other boxes are wrong. Raises `UserError` where a
    line is wrong, or no object counts.
    """
    rows = read_truth_rows(path, class_names)
    if not rows.judged.any():
        raise UserError(f"{path} has no object that counts: there is nothing to score against")
    if rows.classless:
        _log.warning("%s has ten columns, which name no class: all are %s", path, rows.class_names[0])
    found: dict[int, FrameLabels] = {}
    for frame in np.unique(rows.frames).tolist():
        here = rows.frames == frame
        counts = np.flatnonzero(here & rows.judged)
        names = [rows.class_names[row] for row in counts.tolist()]
        found[frame] = FrameLabels.plain(rows.boxes[counts], names, beside=rows.boxes[here & ~rows.judged])
    return found, rows.one_target


def score(
    tracks: Mapping[int, FrameView], truth: Mapping[int, FrameLabels], *, frame_area_px: float
) -> ClassScore:
    """Match tracks to objects on every frame of the truth and count; small is less than `SMALL_SHARE` of a frame."""
    labelled = [(truth[frame], tracks.get(frame, FrameView())) for frame in sorted(truth)]
    return class_score(judged(labelled), limits_px2=(SMALL_SHARE * frame_area_px, math.inf))


def _held(tracks: dict[int, FrameView]) -> dict[int, FrameView]:
    """With lists for frames between two of the table, where these are as far apart as nine in ten of them are."""
    frames = sorted(tracks)
    gaps = np.diff(frames)
    usual = min(_MOST_HELD, int(np.quantile(gaps, 0.9, method="lower"))) if len(gaps) >= _LEAST_GAPS else 1
    between = {
        frame + step: tracks[frame]
        for frame, gap in zip(frames, [*gaps, usual], strict=False)  # of no frame there is no gap
        for step in range(1, min(int(gap), usual))
    }
    return tracks | between
