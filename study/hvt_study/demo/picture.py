"""One picture of several flights: the same place and instant in each, and the gain of stills."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.values import Image
from hvt_study.datasets.labels import FrameLabels
from hvt_study.metrics.judged import FrameView, matched_rows

_Colour = tuple[int, int, int]

_PANEL_PX = (640, 360)
_SHOWN_SHARE = 0.5
"""Share of width and height around the middle: a whole picture so small would be all boxes."""
_PAIR_PX = (154, 154)
_GAP_PX = 8
_HEAD_PX, _LEGEND_PX, _TEXT_PX = 34, 34, 30
_PAPER = 250
_INK: _Colour = (30, 30, 30)
# Okabe and Ito; missed objects have another shape too.
_RIGHT: _Colour = (115, 158, 0)
_WRONG: _Colour = (0, 94, 213)
_MISSED: _Colour = (66, 228, 240)
_LIGHT: _Colour = (255, 255, 255)
_LEVELS = 16
"""Levels of each colour of the pictures: the file stays small."""


@dataclass(frozen=True, slots=True)
class Panel:
    """The picture of one flight at an instant."""

    title: str
    picture: Image
    """The base picture that was newest then."""
    shown: FrameView
    truth: FrameLabels


@dataclass(frozen=True, slots=True)
class Pair:
    """A roof in the video and in a still, and the code read there."""

    video: Image
    still: Image
    video_text: str
    still_text: str


def write_picture(path: Path, panels: Sequence[Panel], pairs: Sequence[Pair]) -> None:
    """Write a PNG: the panels beside each other, a legend, and a pair below each.

    Raises `UserError` where the file cannot be written.
    """
    top = _beside([np.vstack((_head(one.title), _panel(one))) for one in panels])
    rows = [top, _legend(top.shape[1]), *([_beside([_pair(one) for one in pairs])] if pairs else [])]
    wide = max(one.shape[1] for one in rows)
    rows = [np.pad(one, ((0, 0), (0, wide - one.shape[1]), (0, 0)), constant_values=_PAPER) for one in rows]
    name: Any = os.fsencode(path)  # OpenCV dies of a text that is no UTF-8
    if not cv2.imwrite(name, np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9]):
        raise UserError(f"--picture {path} cannot be written: name another file")


def _panel(one: Panel) -> Image:
    high, wide = one.picture.shape[:2]
    x, y = round(wide * (1 - _SHOWN_SHARE) / 2), round(high * (1 - _SHOWN_SHARE) / 2)
    part = one.picture[y : high - y, x : wide - x]
    scale = _PANEL_PX[0] / part.shape[1]
    canvas = _coarse(np.asarray(cv2.resize(part, _PANEL_PX, interpolation=cv2.INTER_CUBIC), np.uint8))
    truth = (one.truth.boxes_xyxy_px - [x, y, x, y]) * scale
    shown = (one.shown.boxes_xyxy_px - [x, y, x, y]) * scale
    partner = dict(matched_rows(shown, truth).tolist())
    for row in set(range(len(truth))) - set(partner.values()):
        cv2.rectangle(canvas, *_corners(truth[row]), _MISSED, 1, cv2.LINE_8)
    for row, name in enumerate(one.shown.class_names):
        right = row in partner and one.truth.class_names[partner[row]] == name
        corners = _corners(shown[row])
        cv2.rectangle(canvas, *corners, _RIGHT if right else _WRONG, 2, cv2.LINE_8)
        _write(canvas, name, (corners[0][0], corners[0][1] - 4), _LIGHT, scale=0.42, shadow=True)
    return canvas


def _coarse(picture: Image) -> Image:
    step = 256 // _LEVELS
    return picture // step * step + step // 2


def _corners(box: npt.NDArray[np.floating[Any]]) -> tuple[tuple[int, int], tuple[int, int]]:
    x1, y1, x2, y2 = np.rint(box).astype(int).tolist()
    return (x1, y1), (x2, y2)


def _head(text: str) -> Image:
    strip = _blank(_PANEL_PX[0], _HEAD_PX)
    _write(strip, text, (4, 23), _INK, scale=0.6)
    return strip


def _legend(wide: int) -> Image:
    strip, x = _blank(wide, _LEGEND_PX), 4
    for text, colour in (
        ("found, right class", _RIGHT),
        ("wrong class, or nothing there", _WRONG),
        ("missed", _MISSED),
    ):
        cv2.rectangle(strip, (x, 10), (x + 22, 24), colour, 1 if colour == _MISSED else 2, cv2.LINE_8)
        _write(strip, text, (x + 30, 22), _INK, scale=0.5)
        x += 60 + 9 * len(text)
    return strip


def _pair(one: Pair) -> Image:
    cells = []
    for picture, text in ((one.video, one.video_text), (one.still, one.still_text)):
        cell = _blank(*_PAIR_PX)
        zoom = min(_PAIR_PX[0] / picture.shape[1], _PAIR_PX[1] / picture.shape[0])
        size = max(1, round(picture.shape[1] * zoom)), max(1, round(picture.shape[0] * zoom))
        left = (_PAIR_PX[0] - size[0]) // 2
        large = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        cell[: size[1], left : left + size[0]] = _coarse(np.asarray(large, np.uint8))
        words = _blank(_PAIR_PX[0], _TEXT_PX)
        # The reader may find signs that this font lacks.
        _write(words, text.encode("ascii", "replace").decode(), (4, 20), _INK, scale=0.5)
        cells.append(np.vstack((cell, words)))
    return _beside(cells)


def _beside(pictures: Sequence[Image]) -> Image:
    gap = _blank(_GAP_PX, pictures[0].shape[0])
    return np.hstack([part for one in pictures for part in (one, gap)][:-1])


def _blank(wide: int, high: int) -> Image:
    return np.full((high, wide, 3), _PAPER, np.uint8)


def _write(
    picture: Image, text: str, place: tuple[int, int], colour: _Colour, *, scale: float, shadow: bool = False
) -> None:
    if shadow:
        below = place[0] + 1, place[1] + 1
        cv2.putText(picture, text, below, cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
