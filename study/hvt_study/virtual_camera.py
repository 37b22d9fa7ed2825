"""A clip from one aerial picture: a virtual camera pans and zooms over it, and the boxes follow exactly.

The picture with its mirror image on either side is the land; the camera flies along it from the right to the left,
sways, and climbs and sinks a little. It never sees finer than the picture's own pixels, so that nothing is invented.
Every frame has sensor noise of its own, without which a still picture would be cheaper to code than anything a camera
delivers. Objects do not move by themselves. The same file gives the same pixels, always.

Annotations are those of VisDrone-DET, in a text file of the same name beside the picture:
``x,y,w,h,score,category,truncation,occlusion``; category 0 is an ignored region and 11 is "others", of both of which
nothing is asked. Without such a file the clip has no exact labels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.values import Boxes, Image
from hvt_common.vision.class_names import VISDRONE_NAMES

__all__ = ["SCHEME", "Annotations", "VirtualCamera", "read_annotations"]

SCHEME = "still:"
"""``still:FILE`` is a virtual camera over that picture."""

_DURATION_S = 14.0
_WINDOW_SHARE = 0.94
"""Height of the window over the picture's at its widest: what is left is room to sway in."""
_CLIMB = 0.08
"""By how much the window grows and shrinks again."""
_REACH = 0.3
"""The way goes from so many widths of the picture on one side of it to as many on the other: at its fastest,
half-way, six pixels a frame of 1280 at 15 fps, a drone at 12 m/s that sees 160 m."""
_SWAY_S, _CLIMB_S = 5.0, 8.0
_NOISE_LEVELS = 2.0
"""Standard deviation of the noise of a small camera's sensor by day, of 256 levels."""
_LEAST_VISIBLE = 0.6
"""An object of which the window shows less is not asked for."""
_LEAST_SIDE_PX = 64


@dataclass(frozen=True, slots=True)
class Annotations:
    """What is in a picture, as parallel arrays in the order of the file."""

    boxes_px: Boxes
    """(N, 4) x1 y1 x2 y2 in pixels of the picture."""
    classes: tuple[str, ...]
    ignored_px: Boxes
    """(K, 4): regions of which nothing is known."""


def read_annotations(path: Path) -> Annotations:
    """Read a VisDrone-DET annotation file; `UserError` names the first line that is not one."""
    boxes: list[list[float]] = []
    ignored: list[list[float]] = []
    classes: list[str] = []
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"annotations {path} cannot be read ({error})") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            x, y, w, h, score, category = (int(word) for word in line.split(",")[:6])
        except ValueError:
            raise UserError(
                f"annotations {path} line {number} is not x,y,w,h,score,category,…: {line!r}"
            ) from None
        box = [x, y, x + w, y + h]
        if 1 <= category <= len(VISDRONE_NAMES) and score:
            boxes.append([float(value) for value in box])
            classes.append(VISDRONE_NAMES[category - 1])
        else:
            ignored.append([float(value) for value in box])
    return Annotations(_boxes(boxes), tuple(classes), _boxes(ignored))


@dataclass(slots=True)
class VirtualCamera:
    """Opens the picture; frames are drawn when asked for.

    Raises:
        UserError: no such picture, one that cannot be decoded or is too small, or damaged annotations.
    """

    picture_path: Path
    fps: float = 15.0
    annotations: Annotations | None = field(init=False)
    """Of the whole land."""
    size: tuple[int, int] = field(init=False)
    """(width, height) of its frames in pixels: those of the window at its narrowest, and even."""
    _land: Image = field(init=False, repr=False)
    _noise: npt.NDArray[np.int8] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.picture_path.is_file():
            raise UserError(f"picture {self.picture_path} of {SCHEME} does not exist: give a picture file")
        picture = cv2.imread(str(self.picture_path), cv2.IMREAD_COLOR)
        if picture is None or min(picture.shape[:2]) < _LEAST_SIDE_PX:
            raise UserError(
                f"picture {self.picture_path} is not one of at least {_LEAST_SIDE_PX}x{_LEAST_SIDE_PX} pixels: "
                "give a JPEG or PNG file"
            )
        self._land = np.concatenate([picture[:, ::-1], picture, picture[:, ::-1]], axis=1).astype(np.uint8)
        high, wide = picture.shape[:2]
        # One aspect ratio for all pictures, that of the usual base stream.
        across = min(wide, high * 16 / 9) * _WINDOW_SHARE / (1 + _CLIMB)
        self.size = (int(across) // 2 * 2, int(across * 9 / 16) // 2 * 2)
        beside = self.picture_path.with_suffix(".txt")
        self.annotations = _mirrored(read_annotations(beside), width=wide) if beside.is_file() else None
        rng = np.random.default_rng(0)
        shape = (self.size[1] + 64, self.size[0] + 64, 3)
        self._noise = np.clip(rng.normal(0, _NOISE_LEVELS, shape).round(), -127, 127).astype(np.int8)

    @property
    def frame_count(self) -> int:
        """Of the whole clip."""
        return math.ceil(_DURATION_S * Fraction(self.fps).limit_denominator(1001))

    def images(self) -> Iterator[Image]:
        """Every frame, (height, width, 3) uint8 BGR of `size`."""
        rng = np.random.default_rng(1)
        for index in range(self.frame_count):
            seen = cv2.warpAffine(
                self._land,
                self._to_frame(index),
                self.size,
                flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            )
            top, left = rng.integers(0, 64, 2).tolist()
            noise = self._noise[top : top + self.size[1], left : left + self.size[0]]
            yield np.asarray(cv2.add(seen, noise, dtype=cv2.CV_8U), np.uint8)

    def truth(self, index: int) -> tuple[Boxes, tuple[str, ...], Boxes] | None:
        """Boxes, class names and ignored regions of a frame in its pixels, clipped to it; None without annotations.

        Objects of which less than 0.6 is inside the frame are ignored regions.
        """
        if self.annotations is None:
            return None
        boxes, visible = self._seen(self.annotations.boxes_px, index)
        ignored, there = self._seen(self.annotations.ignored_px, index)
        asked = visible >= _LEAST_VISIBLE
        partly = boxes[~asked & (visible > 0)]
        names = tuple(name for name, yes in zip(self.annotations.classes, asked, strict=True) if yes)
        return boxes[asked], names, np.concatenate([ignored[there > 0], partly])

    def _to_frame(self, index: int) -> npt.NDArray[np.float64]:
        """(2, 3): from pixels of the land to those of the frame, pixel centres at whole numbers."""
        t_s = index / self.fps
        high, wide = self._land.shape[0], self._land.shape[1] // 3
        zoom = 1 / (1 + _CLIMB * (0.5 - 0.5 * math.cos(2 * math.pi * t_s / _CLIMB_S)))
        middle = 1.5 * wide - 0.5 * self.size[0] / zoom
        x = middle + _REACH * wide * math.cos(math.pi * t_s / _DURATION_S)
        y = (high - self.size[1] / zoom) * (0.5 + 0.5 * math.sin(2 * math.pi * t_s / _SWAY_S))
        shift = 0.5 * zoom - 0.5
        return np.array([[zoom, 0, shift - x * zoom], [0, zoom, shift - y * zoom]])

    def _seen(self, boxes_px: Boxes, index: int) -> tuple[Boxes, npt.NDArray[np.float64]]:
        """Boxes in frame pixels, clipped, and the share of each that is inside."""
        matrix = self._to_frame(index)
        zoom = matrix[0, 0]
        # Edges of boxes lie between pixels: half a pixel before the centre that the matrix speaks of.
        moved = (boxes_px.astype(np.float64) - 0.5) * zoom + np.tile(matrix[:, 2], 2) + 0.5
        clipped = np.clip(moved, 0, [*self.size, *self.size])
        area = (moved[:, 2:] - moved[:, :2]).prod(axis=1)
        inside = (clipped[:, 2:] - clipped[:, :2]).prod(axis=1)
        return clipped.astype(np.float32), inside / np.maximum(area, 1e-9)


def _mirrored(found: Annotations, *, width: int) -> Annotations:
    """Those of a picture of this width between two mirror images of it."""
    flip = np.array([-1, 1, -1, 1], np.float32)
    right = np.array([width, 0, width, 0], np.float32)
    both = []
    for boxes in (found.boxes_px, found.ignored_px):
        mirrored = (boxes * flip + right)[:, [2, 1, 0, 3]]
        both.append(np.concatenate([mirrored, boxes + right, mirrored + 2 * right]))
    return Annotations(both[0], found.classes * 3, both[1])


def _boxes(rows: list[list[float]]) -> Boxes:
    return np.array(rows, np.float32).reshape(-1, 4)
