"""Pictures with their objects: base pictures as a COCO data set, and the stills as files with a table."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_archive.exports.tables import plain_cells
from hvt_archive.exports.video import pictures
from hvt_common.errors import UserError
from hvt_common.units import utc_text
from hvt_ground.events import Overlay
from hvt_ground.recordings.row import Recorded

STILL_COLUMNS = ("file", "base_file", "frame_index", "capture_utc", "caption")
"""``base_file`` shows the base stream at that place, empty where the recording has none; ``frame_index`` is
the one, from 0, that the still shows; ``caption`` what it did, as under the pair on the screen."""
_JPEG_QUALITY_PCT = 95


def write_coco(recorded: Recorded, folder: Path) -> None:
    """``annotations.json`` (COCO, instances) and the base pictures that it names, in ``images``.

    An annotation has the ``track_id`` and ``score`` beside COCO's own fields; tracks that stills doubt are left out.
    """
    images: list[dict[str, Any]] = []
    boxes: list[dict[str, Any]] = []
    numbers: dict[str, int] = {}
    (folder / "images").mkdir()
    for sample, picture, overlay in pictures(recorded):
        name = f"images/{sample.frame_index:06d}.jpg"
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY_PCT])
        (folder / name).write_bytes(data.tobytes())
        image = {
            "id": sample.frame_index,
            "file_name": name,
            "width": picture.shape[1],
            "height": picture.shape[0],
            "date_captured": utc_text(sample.capture_ns),
        }
        images.append(image)
        boxes += _annotations(overlay, image, numbers, first=len(boxes) + 1)
    content = {
        "info": {"description": f"hvt: edge {recorded.edge}, session {recorded.session}"},
        "images": images,
        "annotations": boxes,
        "categories": [{"id": number, "name": name} for name, number in numbers.items()],
    }
    (folder / "annotations.json").write_text(json.dumps(content), encoding="utf-8")


def _annotations(
    overlay: Overlay, image: dict[str, Any], numbers: dict[str, int], *, first: int
) -> list[dict[str, Any]]:
    # Cut at the picture's edges: trainers leave out a picture with a box that is half a pixel outside.
    boxes = np.clip(overlay.boxes_base_px, 0, (image["width"], image["height"]) * 2)
    found: list[dict[str, Any]] = []
    for row, track_id in enumerate(overlay.track_ids.tolist()):
        x1, y1, x2, y2 = boxes[row].tolist()
        if overlay.doubted[row] or not (x1 < x2 and y1 < y2):
            continue
        found.append(
            {
                "id": first + len(found),
                "image_id": image["id"],
                "category_id": numbers.setdefault(overlay.words[row], len(numbers) + 1),
                "bbox": [x1, y1, x2 - x1, y2 - y1],
                "area": (x2 - x1) * (y2 - y1),
                "iscrowd": 0,
                "track_id": track_id,
                "score": round(float(overlay.confidences[row]), 3),
            }
        )
    return found


def write_stills(recorded: Recorded, folder: Path) -> None:
    """Each still as the recording shows it, the base at that place, and ``stills.csv`` (`STILL_COLUMNS`).

    Raises `UserError` where the recording has none.
    """
    if not recorded.stills:
        raise UserError(f"the recording of {recorded.edge} has no stills")
    with (folder / "stills.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(STILL_COLUMNS)
        for number, still in enumerate(recorded.stills, 1):
            names = [f"{number:06d}-still.jpg", f"{number:06d}-base.jpg" if still.base_jpeg else ""]
            for name, data in zip(names, (still.jpeg, still.base_jpeg), strict=True):
                if name:
                    (folder / name).write_bytes(data)
            frame_index, capture_ns = still.shown_at
            row = (*names, frame_index, utc_text(capture_ns), still.caption)
            writer.writerow(plain_cells(row))
