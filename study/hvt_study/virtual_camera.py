"""A clip from one aerial picture: a virtual camera pans and zooms over it, and the boxes follow exactly.

The picture, mirrored at each of its edges, is the land; the camera flies along it from the right to the left, sways,
and climbs and sinks a little. It never sees finer than the picture's own pixels, so that nothing is invented.
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

__all__ = ["SCHEME", "Annotations", "VirtualCamera", "open_camera", "read_annotations"]

SCHEME = "still:"
"""``still:FILE`` is a virtual camera over that picture, ``still:FILE@1.5`` one that sees 1.5 times its height."""

_DURATION_S = 14.0
_USUAL_VIEW = 0.87
_LEAST_VIEW, _MOST_VIEW = 0.1, 3.0
_CLIMB = 0.08
"""By how much the window grows and shrinks again."""
_REACH, _SWAY = 0.35, 0.034
"""The way goes from so many widths of the window on one side of the picture's middle to as many on the other: at its
fastest, half-way, seven pixels a frame of 1280 at 15 fps, a drone at 13 m/s that sees 160 m. It sways by so many
heights of the window, so that the usual one stays within the picture."""
_SWAY_S, _CLIMB_S = 5.0, 8.0
_NOISE_LEVELS = 2.0
"""Standard deviation of the noise of a small camera's sensor by day, of 256 levels."""
_LEAST_VISIBLE = 0.6
"""An object of which the window shows less is not asked for."""
_LEAST_SIDE_PX = 64
_TILES = (-2, -1, 0, 1, 2)
"""Mirror images on each axis: enough for the widest view on its whole way."""


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
    view_heights: float = _USUAL_VIEW
    """Height of what it sees at its lowest, in heights of the picture; beyond about 0.9 mirrored land is in view."""
    fps: float = 15.0
    annotations: Annotations | None = field(init=False)
    """Of the picture and of all its mirror images that may come into view."""
    size: tuple[int, int] = field(init=False)
    """(width, height) of its frames in pixels: those of the window at its narrowest, and even."""
    _picture: Image = field(init=False, repr=False)
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
        self._picture = np.asarray(picture, np.uint8)
        high, wide = picture.shape[:2]
        # One aspect ratio for all pictures, that of the usual base stream.
        across = min(wide, high * 16 / 9) * self.view_heights
        self.size = (int(across) // 2 * 2, int(across * 9 / 16) // 2 * 2)
        beside = self.picture_path.with_suffix(".txt")
        self.annotations = (
            _mirrored(read_annotations(beside), size=(wide, high)) if beside.is_file() else None
        )
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
                self._picture,
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
        """(2, 3): from pixels of the picture to those of the frame, pixel centres at whole numbers."""
        t_s = index / self.fps
        zoom = 1 / (1 + _CLIMB * (0.5 - 0.5 * math.cos(2 * math.pi * t_s / _CLIMB_S)))
        high, wide = self._picture.shape[:2]
        along, across = math.cos(math.pi * t_s / _DURATION_S), math.sin(2 * math.pi * t_s / _SWAY_S)
        x = wide / 2 + (_REACH * along - 0.5 / zoom) * self.size[0]
        y = high / 2 + (_SWAY * across - 0.5 / zoom) * self.size[1]
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


def open_camera(spec: str, *, fps: float) -> VirtualCamera:
    """The camera of ``still:PICTURE`` or ``still:PICTURE@HEIGHT``."""
    text = spec.removeprefix(SCHEME)
    name, separator, height = text.rpartition("@")
    if not separator or Path(text).is_file():
        return VirtualCamera(Path(text), fps=fps)
    try:
        heights = float(height)
    except ValueError:
        heights = math.nan
    if not _LEAST_VIEW <= heights <= _MOST_VIEW:
        raise UserError(
            f"{spec!r} asks for a view of {height!r} heights of the picture: "
            f"give a number from {_LEAST_VIEW:g} to {_MOST_VIEW:g}"
        )
    return VirtualCamera(Path(name), heights, fps)


def _mirrored(found: Annotations, *, size: tuple[int, int]) -> Annotations:
    """Those of a picture of this (width, height), mirrored at each of its edges again and again."""
    tiles = [(across, down) for down in _TILES for across in _TILES]
    boxes = [_in_tile(found.boxes_px, tile, size=size) for tile in tiles]
    ignored = [_in_tile(found.ignored_px, tile, size=size) for tile in tiles]
    return Annotations(np.concatenate(boxes), found.classes * len(tiles), np.concatenate(ignored))


def _in_tile(boxes: Boxes, tile: tuple[int, int], *, size: tuple[int, int]) -> Boxes:
    """Where the boxes of the picture lie in one of its images, (0, 0) being itself."""
    moved = boxes.copy()
    for axis, (number, side) in enumerate(zip(tile, size, strict=True)):
        ends = boxes[:, [axis, axis + 2]]
        if number % 2:
            ends = side - ends[:, ::-1]
        moved[:, [axis, axis + 2]] = ends + number * side
    return moved


def _boxes(rows: list[list[float]]) -> Boxes:
    return np.array(rows, np.float32).reshape(-1, 4)
