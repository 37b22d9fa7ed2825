"""Write the ground's tracks as a table: one line a track and frame, for programs that come after."""

from __future__ import annotations

import csv
from pathlib import Path

from hvt_common.errors import UserError
from hvt_ground.events import Event, Overlay

__all__ = ["COLUMNS", "TrackTable"]

COLUMNS = ("frame", "id", "x", "y", "w", "h", "confidence", "base_class", "class", "refined", "origin")
"""``frame`` counts from 1 and ``x y w h`` are base pixels, as in MOTChallenge; ``base_class`` is what the detectors
say without stills, ``class`` the same after refinement, ``refined`` 1 once a still has refined it; ``origin``:
``base``, ``edge``, ``edge+base`` or ``still``. A source frame that the base stream left out has lines too where the
edge reported it."""


class TrackTable:
    """A CSV file that grows with the stream; other events than overlays pass it by."""

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("w", encoding="utf-8", newline="")
        except OSError as error:
            raise UserError(
                f"--tracks {path} cannot be written ({error.strerror}): name a file that can"
            ) from None
        self._writer = csv.writer(self._file)
        self._writer.writerow(COLUMNS)

    def log(self, event: Event) -> None:
        """Append the tracks of an overlay; one of the backlog would not be in the order of frames."""
        if not isinstance(event, Overlay) or event.stored:
            return
        origins = event.origins or ("base",) * len(event.track_ids)
        for row, track_id in enumerate(event.track_ids.tolist()):
            x1, y1, x2, y2 = event.boxes_base_px[row].tolist()
            self._writer.writerow(
                (
                    event.frame_index + 1,
                    track_id,
                    f"{x1:.1f}",
                    f"{y1:.1f}",
                    f"{x2 - x1:.1f}",
                    f"{y2 - y1:.1f}",
                    f"{event.confidences[row]:.3f}",
                    event.base_classes[row],
                    event.classes[row],
                    int(event.refined[row]),
                    origins[row],
                )
            )

    def close(self, *, quickly: bool = False) -> None:  # noqa: ARG002 - it is always quick
        """Write what is buffered."""
        self._file.close()
