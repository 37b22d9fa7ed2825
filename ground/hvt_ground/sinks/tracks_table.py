"""Write the ground's tracks as a table: one line a track and frame, for programs that come after."""

from __future__ import annotations

import csv
import io
import threading
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hvt_common.units import SECOND_NS
from hvt_ground.events import Event, Overlay, Places
from hvt_ground.sinks.line_file import LineFile

COLUMNS = (
    *("frame_index", "capture_utc", "id", "x", "y", "w", "h", "confidence"),
    *("base_class", "class", "refined", "origin", "late", "doubted"),
    *("latitude", "longitude", "error_m"),
)
"""``frame_index`` counts from 0, as on the wire, and ``x y w h`` are base pixels; ``capture_utc`` is the time at the
camera by the edge's clock; ``base_class`` is what the detectors say without stills, ``class`` the same after
refinement, ``refined`` 1 once a still has refined it; ``origin``: ``base``, ``edge``, ``edge+base`` or ``still``;
``late``: 1 where it is of stored video that came after an outage, behind later frames; ``doubted``: 1 where stills
say that it is nothing of mine, or the view is unlike what the detector knows; ``latitude longitude`` are where it
stands (WGS 84, degrees) and ``error_m`` half the longer axis of the ellipse that holds it with 95 %, empty where no
pose tells. A source frame that the base stream left out has lines too where the edge reported it."""


class TrackTable:
    """A CSV file that grows with the stream; other events than overlays pass it by."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path, COLUMNS)
        self.path = path

    def log(self, item: Event) -> None:
        """Append the tracks of an overlay."""
        if not isinstance(item, Overlay) or not len(item.track_ids):
            return
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(track_rows(item))
        self._file.log(text.getvalue())

    def skipped(self, count: int) -> None:
        """Their lines are missing."""

    def close(self, hurry: threading.Event | None = None) -> None:
        """Close the file."""
        self._file.close(hurry)


def track_rows(overlay: Overlay) -> Iterator[tuple[object, ...]]:
    """One row of `COLUMNS` a track."""
    origins = overlay.origins or ("base",) * len(overlay.track_ids)
    for row, track_id in enumerate(overlay.track_ids.tolist()):
        x1, y1, x2, y2 = overlay.boxes_base_px[row].tolist()
        yield (
            overlay.frame_index,
            utc_text(overlay.capture_ns),
            track_id,
            *(f"{value:.1f}" for value in (x1, y1, x2 - x1, y2 - y1)),
            f"{overlay.confidences[row]:.3f}",
            overlay.base_classes[row],
            overlay.classes[row],
            int(overlay.refined[row]),
            origins[row],
            int(overlay.stored),
            0 if overlay.doubted is None else int(overlay.doubted[row]),
            *_place_texts(overlay.places, row),
        )


def _place_texts(places: Places | None, row: int) -> tuple[str, str, str]:
    if places is None or not np.isfinite(places.places_deg[row]).all():
        return "", "", ""
    latitude, longitude = places.places_deg[row]
    return f"{latitude:.7f}", f"{longitude:.7f}", f"{places.ellipses[row, 0]:.1f}"


def utc_text(unix_ns: int, *, milliseconds: bool = True) -> str:
    """``2026-11-22T13:01:02.345Z``; empty where no calendar has the time, which may come from the wire."""
    try:
        time = datetime.fromtimestamp(unix_ns // SECOND_NS, UTC)
    except (ValueError, OverflowError, OSError):
        return ""
    rest = f".{unix_ns // 1_000_000 % 1000:03d}" if milliseconds else ""
    return time.strftime("%Y-%m-%dT%H:%M:%S") + rest + "Z"
