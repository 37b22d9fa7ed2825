"""Writes every still as a picture file, and a table of their objects, for people and other programs.

The recording shows what it has room for; here nothing is left out, and nothing is coded again.
"""

from __future__ import annotations

import csv
import io
import threading
from pathlib import Path

import cv2

from hvt_common.errors import UserError
from hvt_ground.events import Event, Refinement
from hvt_ground.sinks.line_file import LineFile

COLUMNS = (
    *("file", "frame_index", "known_frame_index", "still", "track", "edge_track", "x", "y", "w", "h"),
    *("class_before", "class_after", "confidence", "reason"),
)
"""``frame_index`` is what the still shows and ``known_frame_index`` when it was known here, both from 0; ``x y w h``
is where the whole picture lies in the base picture of ``frame_index``, base pixels."""


class StillFiles:
    """A table, and beside it a PNG a still, named after both: ``<table>-000012.png``. Other events pass it by.

    A still of several objects has a line for each and one picture.
    """

    def __init__(self, path: Path) -> None:
        self._table = LineFile(path, COLUMNS)
        self._last = -1
        self.path = path

    def log(self, item: Event) -> None:
        """Write a still; `UserError` where there is no room for it."""
        if not isinstance(item, Refinement) or item.still_bgr is None or item.crop_base_px is None:
            return
        picture = picture_of(item, self.path)
        if item.still_sequence != self._last:
            _, data = cv2.imencode(".png", item.still_bgr)
            try:
                picture.write_bytes(data.tobytes())
            except OSError as error:
                raise UserError(f"still {picture} cannot be written: {error.strerror}") from error
            self._last = item.still_sequence
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerow(_row(item, picture.name))
        self._table.log(text.getvalue())

    def skipped(self, count: int) -> None:
        """They are missing."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Close the table."""
        self._table.close(hurry)


def picture_of(still: Refinement, table: Path) -> Path:
    """The picture of a still, beside the table; it is there where the still was decoded and has a place."""
    return table.with_name(f"{table.stem}-{still.still_sequence:06d}.png")


def _row(item: Refinement, name: str) -> tuple[object, ...]:
    assert item.crop_base_px is not None, "only stills with a place have a row"
    x1, y1, x2, y2 = item.crop_base_px
    return (
        name,
        item.shown_index,
        item.frame_index,
        item.still_sequence,
        "" if item.track_id is None else item.track_id,
        item.edge_track_id,
        *(f"{value:.3f}" for value in (x1, y1, x2 - x1, y2 - y1)),
        item.class_before,
        item.class_after,
        f"{item.confidence:.3f}",
        item.reason,
    )
