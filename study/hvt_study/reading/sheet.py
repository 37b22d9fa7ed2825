"""One picture of what was read: a row a code, a column a method, each crop with the reader's word below it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_study.reading.compared import ReadResult, ReadRow
from hvt_study.reading.observer import Channel
from hvt_study.reading.score import Evidence

_ROWS = 10
_CELL_PX = (196, 60)
_TEXT_PX = 20
_HEAD_PX = 24
_INK, _GREEN, _RED, _GREY = (30, 30, 30), (40, 130, 30), (40, 40, 200), (150, 150, 150)
_PAPER = 246


def write_sheet(path: Path, result: ReadResult) -> None:
    """Write a PNG of up to ten codes of the first scene at the lowest rate; nothing where nothing was flown.

    First come codes that some methods showed and others did not. Raises `OSError` where it cannot be written.
    """
    flown = [row for row in result.rows if row.method != "source"]
    if not flown:
        path.unlink(missing_ok=True)
        return
    lowest = min(row.rate_kbps for row in flown)
    rows = [row for row in result.rows if row.rate_kbps in (0, lowest)]
    both: tuple[Channel, ...] = "base", "stills"
    columns = [(row, channel) for row in rows for channel in (both if row.mean("roi_bps") else both[:1])]
    picture = np.vstack(
        [_line([f"at {lowest:g} kbps", *(_title(*one) for one in columns)], high_px=_HEAD_PX)]
        + [_row(object_id, columns) for object_id in _chosen(columns)]
    )
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def _title(row: ReadRow, channel: Channel) -> str:
    if row.method == "source":
        return "source"
    if channel == "stills":
        return f"{row.method}, still"
    flight = row.scenes[0].flight
    return f"{row.method} {flight.size[0]}x{flight.size[1]} {flight.fps:.1f} fps"


def _chosen(columns: Sequence[tuple[ReadRow, Channel]]) -> list[int]:
    """Objects of the first scene, those first on which the methods differ most, the small before the large."""
    scene = columns[0][0].scenes[0]
    links = [one for one in columns if one[0].method != "source"]

    def order(object_id: int) -> tuple[bool, float]:
        right = {one.right for one in (_evidence(object_id, *column) for column in links)}
        return len(right) < 2, scene.codes[object_id].height_px

    return sorted(scene.codes, key=order)[:_ROWS]


def _evidence(object_id: int, row: ReadRow, channel: Channel) -> Evidence:
    return row.scenes[0].flight.evidence[channel].get(object_id, Evidence())


def _row(object_id: int, columns: Sequence[tuple[ReadRow, Channel]]) -> Image:
    code = columns[0][0].scenes[0].codes[object_id]
    head = _cell(None, code.text, f"{code.height_px:.0f} px high", _INK)
    return np.hstack([head, *(_shown(_evidence(object_id, *column)) for column in columns)])


def _shown(one: Evidence) -> Image:
    if one.best is None:
        return _cell(None, "", "not shown", _GREY)
    if one.right:
        return _cell(one.best.picture_bgr, "", f"{one.best.text} at {one.read_s:.1f} s", _GREEN)
    return _cell(one.best.picture_bgr, "", one.best.text or "?", _RED)


def _cell(crop: Image | None, title: str, text: str, colour: tuple[int, int, int]) -> Image:
    wide, high = _CELL_PX
    cell = np.full((high + _TEXT_PX, wide, 3), _PAPER, np.uint8)
    if crop is not None:
        zoom = min((wide - 8) / crop.shape[1], (high - 8) / crop.shape[0])
        size = max(1, round(crop.shape[1] * zoom)), max(1, round(crop.shape[0] * zoom))
        small = cv2.resize(crop, size, interpolation=cv2.INTER_AREA)
        left, top = (wide - size[0]) // 2, (high - size[1]) // 2
        cell[top : top + size[1], left : left + size[0]] = small
    _write(cell, title, (8, high - 22), colour, scale=0.8)
    # The reader may say what this font has no signs for.
    _write(cell, text.encode("ascii", "replace").decode(), (8, high + 12), colour, scale=0.42)
    return cell


def _line(texts: Sequence[str], *, high_px: int) -> Image:
    cells = [np.full((high_px, _CELL_PX[0], 3), _PAPER - 16, np.uint8) for _ in texts]
    for cell, text in zip(cells, texts, strict=True):
        _write(cell, text, (6, 16), _INK, scale=0.4)
    return np.hstack(cells)


def _write(
    cell: Image, text: str, place: tuple[int, int], colour: tuple[int, int, int], *, scale: float
) -> None:
    cv2.putText(cell, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
