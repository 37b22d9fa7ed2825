"""A sheet of crops to look at: the worst findings, each with what was said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hvt_common.values import Image

_CELL_PX, _TEXT_PX = 150, 18
_COLUMNS, _ROWS = 8, 5
_CONTEXT = 2.5
"""Sides of the crop, in longer sides of the box."""
_LEAST_CROP_PX = 48
_RED = (60, 60, 255)


@dataclass(frozen=True, slots=True)
class Finding:
    """One box of a picture, x1 y1 x2 y2 in its pixels; ``weight`` orders, the largest first."""

    path: Path
    box_px: Sequence[float]
    text: str
    weight: float


def write_sheet(path: Path, findings: Sequence[Finding]) -> None:
    """Write a PNG of at most 40 crops; an earlier one is removed where there is nothing to show.

    Raises `OSError` where it cannot be written.
    """
    worst = sorted(findings, key=lambda one: -one.weight)[: _COLUMNS * _ROWS]
    if not worst:
        path.unlink(missing_ok=True)
        return
    cells = [_cell(one) for one in worst]
    blank = np.zeros_like(cells[0])
    cells += [blank] * (-len(cells) % _COLUMNS)
    rows = [np.hstack(cells[start : start + _COLUMNS]) for start in range(0, len(cells), _COLUMNS)]
    path.write_bytes(cv2.imencode(".png", np.vstack(rows))[1].tobytes())


def _cell(finding: Finding) -> Image:
    image = cv2.imread(str(finding.path), cv2.IMREAD_COLOR)
    assert image is not None, "it was detected on"
    x1, y1, x2, y2 = finding.box_px
    reach = max(_LEAST_CROP_PX, _CONTEXT * max(x2 - x1, y2 - y1))
    scale = _CELL_PX / reach
    left, top = (x1 + x2 - reach) / 2, (y1 + y2 - reach) / 2
    place = np.array([[scale, 0, -left * scale], [0, scale, -top * scale]])
    cell = np.asarray(cv2.warpAffine(image, place, (_CELL_PX, _CELL_PX), flags=cv2.INTER_LINEAR), np.uint8)
    corners = [(round((x - left) * scale), round((y - top) * scale)) for x, y in ((x1, y1), (x2, y2))]
    cv2.rectangle(cell, corners[0], corners[1], _RED, 1)
    strip = np.zeros((_TEXT_PX, _CELL_PX, 3), np.uint8)
    cv2.putText(strip, finding.text, (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return np.vstack((cell, strip))
