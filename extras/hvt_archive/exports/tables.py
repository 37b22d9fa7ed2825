"""Tables that grow with a session: the ground's tracks, its stills with a picture each, and the times of messages.

The recording shows stills that it has room for; here nothing is left out, and nothing is coded again.
"""

from __future__ import annotations

import csv
import io
import os
import re
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, replace
from pathlib import Path

import cv2
import numpy as np

from hvt_common.errors import UserError, telling
from hvt_common.files import check_there, created, has_nothing
from hvt_common.units import utc_text
from hvt_ground.events import Event, MessageTiming, Overlay, Places, Refinement, StillsRead
from hvt_ground.sinks import Sink, SinkWriter

TRACK_COLUMNS = (
    *("frame_index", "capture_utc", "id", "x", "y", "w", "h", "confidence"),
    *("base_class", "class", "refined", "origin", "late", "doubted"),
    *("latitude", "longitude", "error_m"),
)
"""``frame_index`` counts from 0, as on the wire, and ``x y w h`` are base pixels; ``capture_utc`` is the time at the
camera by the edge's clock; ``base_class`` is the detectors' class without stills, ``class`` the same after
refinement, ``refined`` 1 once a still has refined it; ``origin``: ``base``, ``edge``, ``edge+base`` or ``still``;
``late``: 1 where it is of stored video that came after an outage, behind later frames; ``doubted``: 1 where stills
say that it is nothing of mine, or the detector does not know the view; ``latitude longitude`` are where it
stands (WGS 84, degrees) and ``error_m`` half the longer axis of the ellipse that holds it with 95 %, empty where no
pose tells. A source frame that the base stream left out has lines too where the edge reported it."""

STILL_COLUMNS = (
    *("file", "frame_index", "known_frame_index", "still", "track", "edge_track", "x", "y", "w", "h"),
    *("class_before", "class_after", "confidence", "reason"),
)
"""``frame_index`` is the still's frame, ``known_frame_index`` the one at which it was known, both from 0; ``x y w h``
is where the whole picture lies in the base picture of ``frame_index``, base pixels."""

_FORMULA = re.compile(r"\s*([=@\uff1d\uff20]|[+\uff0b\uff0d-](?!\d+(\.\d+)?$))")
"""The beginning of a text that a spreadsheet computes; Asian ones take wide signs as well (OWASP, CSV injection)."""


def plain_cells(row: Iterable[object]) -> tuple[object, ...]:
    """A row for CSV; before a name such as ``=1+1``, which may come from the wire, stands an apostrophe."""
    return tuple(f"'{one}" if isinstance(one, str) and _FORMULA.match(one) else one for one in row)


class LineFile(SinkWriter[str]):
    """A new file with a first line of ``columns``; comma-separated. Takes the place of one of that name.

    Raises `UserError` where it cannot be created, or (from `log`) written any further.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path: Path = path
        self._size_bytes, fresh = 0, has_nothing(path)
        with telling(f"table {path} cannot be created: "):
            self._file = created(path, os.O_APPEND)
        try:
            self.log(",".join(columns) + "\n")
        except UserError:
            self.close()
            if fresh:
                path.unlink(missing_ok=True)
            raise

    def log(self, item: str) -> None:
        data = item.encode()
        try:
            check_there(self._file, self.path)
            while data:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            with suppress(OSError):  # half a line
                os.ftruncate(self._file, self._size_bytes)
            raise UserError(f"table {self.path} cannot be written any further: {error.strerror}") from error
        self._size_bytes += len(item.encode())

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class _EventTable(SinkWriter[Event]):
    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._file = LineFile(path, columns)
        self.path: Path = path

    def _append(self, *rows: tuple[object, ...]) -> None:
        text = io.StringIO(newline="")
        csv.writer(text, lineterminator="\n").writerows(map(plain_cells, rows))
        self._file.log(text.getvalue())

    def close(self, hurry: threading.Event | None = None) -> None:
        self._file.close(hurry)


class TrackTable(_EventTable):
    """A CSV file of one line a track and frame; other events than overlays pass it by."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, TRACK_COLUMNS)

    def log(self, item: Event) -> None:
        if isinstance(item, Overlay) and len(item.track_ids):
            self._append(*track_rows(item))


class StillFiles(_EventTable):
    """A CSV file, and beside it a PNG a still, named after both: ``<table>-000012.png``. Other events pass it by.

    A still of several objects has a line for each and one picture.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, STILL_COLUMNS)
        self._last = -1

    def log(self, item: Event) -> None:
        """Write a still; `UserError` where there is no room for it."""
        if not isinstance(item, Refinement) or item.still_bgr is None or item.crop_base_px is None:
            return
        picture = _picture_of(item, self.path)
        if item.still_sequence != self._last:
            _, data = cv2.imencode(".png", item.still_bgr)
            with telling(f"still {picture} cannot be written: "):
                _write_whole(picture, data.tobytes())
            self._last = item.still_sequence
        self._append(_still_row(item, picture.name))


def track_rows(overlay: Overlay) -> Iterator[tuple[object, ...]]:
    """One row of `TRACK_COLUMNS` a track."""
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
            overlay.origins[row],
            int(overlay.stored),
            int(overlay.doubted[row]),
            *_place_texts(overlay.places, row),
        )


def _place_texts(places: Places | None, row: int) -> tuple[str, str, str]:
    if places is None or not np.isfinite(places.places_deg[row]).all():
        return "", "", ""
    latitude, longitude = places.places_deg[row]
    return f"{latitude:.7f}", f"{longitude:.7f}", f"{places.ellipses[row, 0]:.1f}"


def _write_whole(picture: Path, data: bytes) -> None:
    # Half a picture would be in no table, and open in no program.
    try:
        picture.write_bytes(data)
    except OSError:
        if picture.is_file():  # no device
            with suppress(OSError):
                picture.unlink()
        raise


def address_of(still: Refinement, table: Path) -> str:
    """Where the picture of a still is, beside the table; empty where it was not decoded, or has no place."""
    if still.still_bgr is None or still.crop_base_px is None:
        return ""
    return str(_picture_of(still, table.resolve()))


def _picture_of(still: Refinement, table: Path) -> Path:
    return table.with_name(f"{table.stem}-{still.still_sequence:06d}.png")


def _still_row(item: Refinement, name: str) -> tuple[object, ...]:
    assert item.crop_base_px is not None, "only stills with a place have a row"
    x1, y1, x2, y2 = item.crop_base_px
    return (
        name,
        item.shown_at[0],
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


TIMING_COLUMNS = (
    *("kind", "sequence", "frame_index", "capture_ns", "send_ns", "received_ns", "shown_ns"),
    *("line_bytes", "clock_offset_ns", "edge", "session"),
)
"""One line a message. Times are Unix nanoseconds, 0 where there is none; -1 is the ``frame_index`` of one that is
about no frame. ``kind``: base, roi, tracks, status; backlog-still, backlog-base, backlog-info for a chunk of the
backlog. ``capture_ns`` and ``send_ns`` are by the edge's clock, ``received_ns`` and ``shown_ns`` by this one;
``shown_ns``: when it was decoded and recorded (base), read by the classifier (roi), or taken in; 0: never, or a chunk
of the past that did not complete an object, or one of no use. ``line_bytes``: its bytes on the line, headers of
Zenoh, TCP and IP included. ``clock_offset_ns``: the edge's clock less this one, as known then: the delay of a message
is ``received_ns - (capture_ns - clock_offset_ns)``."""
_MOST_UNREAD = 512
"""Stills whose line waits until they are read; more than the session's own queue holds."""


def timing_table(path: Path) -> LineFile:
    """The file, for all sessions of a ground."""
    return LineFile(path, TIMING_COLUMNS)


class SessionTiming:
    """Makes the lines of one session, of its `MessageTiming` and `StillsRead` events, for any thread.

    ``table`` takes them; it is not closed with this.
    """

    def __init__(self, table: Sink[str], *, edge: str, session_id: int) -> None:
        self._table = table
        self._whose = (edge, f"{session_id:08x}")
        self._lock = threading.Lock()
        self._unread: dict[int, MessageTiming] = {}

    def log(self, item: Event) -> None:
        """Write a message that has been dealt with; a still's line is written when it has been read."""
        if not isinstance(item, MessageTiming | StillsRead):
            return
        with self._lock:
            if isinstance(item, StillsRead):
                for sequence in item.sequences:
                    if (still := self._unread.pop(sequence, None)) is not None:
                        self._write(still, handled_ns=item.at_ns)
            elif item.handled_ns is not None:
                self._write(item, handled_ns=item.handled_ns)
            else:
                self._unread[item.sequence] = item
                if len(self._unread) > _MOST_UNREAD:
                    self._write(self._unread.pop(next(iter(self._unread))), handled_ns=0)

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        with self._lock:
            for still in self._unread.values():
                self._write(still, handled_ns=0)
            self._unread.clear()

    def _write(self, message: MessageTiming, *, handled_ns: int) -> None:
        values = (*astuple(replace(message, handled_ns=handled_ns)), *self._whose)
        self._table.log(",".join(map(str, values)) + "\n")
