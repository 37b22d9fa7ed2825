"""A clip from one aerial picture: a virtual camera pans and zooms over it, and the boxes follow exactly.

The picture, mirrored at each of its edges, is the land; the camera flies along it, sways, and climbs and sinks: from
the right to the left as seed 0, on a way of its own as any other. It never sees finer than the picture's own pixels,
so that nothing is invented. Every frame has sensor noise of its own, without which a still picture would be cheaper
to code than anything a camera delivers. Objects do not move by themselves; they enter and leave as the camera goes.
The same file and seed give the same pixels, always.

Annotations are those of VisDrone-DET, in a text file of the same name beside the picture, or in ``annotations``
where the picture lies in ``images``: ``x,y,w,h,score,category,truncation,occlusion``; category 0 is an ignored region
and 11 is "others", of both of which nothing is asked. Or they are YOLO's, in ``labels`` beside ``images``
(`hvt_study.datasets.label_files`). Without such a file the clip has no exact labels.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_common.values import Boxes, Image
from hvt_study.datasets.label_files import (
    Folders,
    class_file,
    keypoint_columns,
    read_image,
    read_yolo,
    yolo_names,
)
from hvt_study.datasets.label_table import image_labels
from hvt_study.datasets.labels import IGNORED, FrameLabels, LabelDoubts

SCHEME = "still:"
"""``still:FILE`` is a virtual camera over that picture, ``still:FILE@1.5`` one that sees 1.5 times its height."""

_log = logging.getLogger(__name__)

_DURATION_S = 14.0
USUAL_VIEW = 0.87
"""Height that the camera sees at its lowest, in heights of the picture."""
_LEAST_VIEW, _MOST_VIEW = 0.1, 3.0
_REACH = 0.35
"""The way goes from so many widths of the window on one side of the picture's middle to as many on the other: at its
fastest, half-way, seven pixels a frame of 1280 at 15 fps, a drone at 13 m/s that sees 160 m."""
_NOISE_LEVELS = 2.0
"""Standard deviation of the noise of a small camera's sensor by day, of 256 levels."""
_LEAST_VISIBLE = 0.6
"""An object of which the window shows less is not asked for."""
_LEAST_SIDE_PX = 64
_YOLO = "labels"
_ACROSS, _DOWN = range(-3, 4), range(-2, 3)
"""Mirror images on each axis: enough for the widest view on its whole way."""


@dataclass(frozen=True, slots=True)
class _Way:
    heading: tuple[float, float] = (-1.0, 0.0)
    """Direction of length 1, to the picture's right and towards its bottom."""
    climb: float = 0.08
    """By how much the window grows and shrinks again."""
    climb_s: float = 8.0
    climb_phase: float = 0.0
    """Radians; at 0 it begins at its lowest."""
    sway: float = 0.034
    """To each side, in heights of the window: without a slant the usual one stays within the picture."""
    sway_s: float = 5.0
    sway_phase: float = 0.0

    @classmethod
    def of(cls, seed: int) -> _Way:
        """Seed 0 is the plain way; any other draws one: either direction, a slant, deeper zooms, another rhythm."""
        if seed == 0:
            return cls()
        rng = np.random.Generator(np.random.PCG64(seed))
        turn, slant, climb, climb_s, climb_phase, sway, sway_s, sway_phase = rng.random(8).tolist()
        angle = (math.pi if turn < 0.5 else 0.0) + math.radians(20 * slant - 10)
        return cls(
            heading=(math.cos(angle), math.sin(angle)),
            climb=0.05 + 0.25 * climb,
            climb_s=6 + 6 * climb_s,
            climb_phase=2 * math.pi * climb_phase,
            sway=0.02 + 0.03 * sway,
            sway_s=4 + 4 * sway_s,
            sway_phase=2 * math.pi * sway_phase,
        )


def annotation_file(picture: Path, folders: Folders) -> Path:
    """Where the annotations of a picture are, or would be; ``folders`` are listed once for all pictures of a set."""
    beside = picture.with_suffix(".txt")
    places = [beside]
    if picture.parent.name.lower() == "images":
        places += [picture.parent.parent / name / beside.name for name in (_YOLO, "annotations")]
    found = (folders.find(place) for place in places)
    return next((file for file in found if file is not None and file.is_file()), places[-1])


def read_annotations(
    path: Path, size: tuple[int, int], *, classes: Sequence[str] = ()
) -> tuple[FrameLabels, tuple[str, ...]]:
    """The labels of `annotation_file`, in a picture of this (width, height), and all classes that it may use, sorted.

    ``classes`` are names of YOLO's; none: those of ``classes.txt`` beside its folder. Wrong rows are left out;
    `UserError` where all are.
    """
    doubts = LabelDoubts()
    names: Sequence[str] = VISDRONE_NAMES
    if path.parent.name.lower() != _YOLO:
        found = image_labels(path, size, doubts)
    else:
        root = path.parent.parent
        names = yolo_names(root, tuple(classes) or None)
        found = read_yolo(path, names, size, doubts, keypoints=keypoint_columns(class_file(root, [])))
    for sentence in doubts.sentences():
        _log.warning("%s", sentence)
    return found, tuple(sorted({name for name in names if name.casefold() not in IGNORED}))


@dataclass(slots=True)
class VirtualCamera:
    """Opens the picture; frames are drawn when asked for.

    Raises `UserError` for no such picture, one that cannot be decoded or is too small, or damaged annotations.
    """

    picture_path: Path
    view_heights: float = USUAL_VIEW
    """Height of its view at its lowest, in heights of the picture; beyond about 0.9 mirrored land is in view."""
    fps: float = 15.0
    seed: int = 0
    annotation_path: Path | None = None
    """None: annotations are not looked at."""
    classes: tuple[str, ...] = ()
    """Classes of YOLO's labels; none: those of ``classes.txt``."""
    annotations: FrameLabels | None = field(init=False)
    """Labels of the picture and of all its mirror images that may come into view, in pixels of the picture."""
    class_set: tuple[str, ...] = field(init=False, default=())
    """All classes that the annotations may use, sorted."""
    size: tuple[int, int] = field(init=False)
    """(width, height) of its frames in pixels: those of the window at its narrowest, and even."""
    _picture: Image = field(init=False, repr=False)
    _way: _Way = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not self.picture_path.is_file():
            raise UserError(f"picture {self.picture_path} of {SCHEME} does not exist: give a picture file")
        picture = read_image(self.picture_path)
        if picture is None or min(picture.shape[:2]) < _LEAST_SIDE_PX:
            raise UserError(
                f"picture {self.picture_path} is not one of at least {_LEAST_SIDE_PX}x{_LEAST_SIDE_PX} pixels: "
                "give a JPEG or PNG file"
            )
        self._picture = picture
        high, wide = picture.shape[:2]
        # One aspect ratio for all pictures, that of the usual base stream.
        across = min(wide, high * 16 / 9) * self.view_heights
        self.size = (int(across) // 2 * 2, int(across * 9 / 16) // 2 * 2)
        file = self.annotation_path
        self.annotations = None
        if file is not None and file.is_file():
            found, self.class_set = read_annotations(file, (wide, high), classes=self.classes)
            self.annotations = _mirrored(found, size=(wide, high))
        self._way = _Way.of(self.seed)

    @property
    def frame_count(self) -> int:
        return math.ceil(_DURATION_S * Fraction(self.fps).limit_denominator(1001))

    def images(self) -> Iterator[Image]:
        """Every frame, (height, width, 3) uint8 BGR of `size`."""
        sheet = self._noise()
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
            noise = sheet[top : top + self.size[1], left : left + self.size[0]]
            yield np.asarray(cv2.add(seen, noise, dtype=cv2.CV_8U), np.uint8)

    def _noise(self) -> npt.NDArray[np.int8]:
        """A sheet of it, larger than a frame: each frame takes another part."""
        shape = (self.size[1] + 64, self.size[0] + 64, 3)
        noise = np.random.default_rng(0).normal(0, _NOISE_LEVELS, shape)
        return np.clip(noise.round(), -127, 127).astype(np.int8)

    def labels(self, index: int) -> FrameLabels | None:
        """The labels of a frame, in its pixels, clipped to it; None without annotations.

        Each mirror image of an object is one of its own, and keeps its id. Objects of which less than 0.6 is inside
        the frame are not judged.
        """
        if self.annotations is None:
            return None
        boxes, visible = self._seen(self.annotations.boxes_xyxy_px, index)
        ignored, there = self._seen(self.annotations.ignored_xyxy_px, index)
        beside, near = self._seen(self.annotations.beside_xyxy_px, index)
        rows = np.flatnonzero(visible >= _LEAST_VISIBLE)
        partly = boxes[(visible < _LEAST_VISIBLE) & (visible > 0)]
        return FrameLabels(
            boxes_xyxy_px=boxes[rows],
            ids=rows.astype(np.int64) + 1,
            class_names=tuple(self.annotations.class_names[row] for row in rows.tolist()),
            ignored_xyxy_px=ignored[there > 0],
            beside_xyxy_px=np.concatenate([beside[near > 0], partly]),
        )

    def _to_frame(self, index: int) -> npt.NDArray[np.float64]:
        """(2, 3): from pixels of the picture to those of the frame, pixel centres at whole numbers."""
        t_s, way = index / self.fps, self._way
        zoom = 1 / (1 + way.climb * (0.5 - 0.5 * math.cos(2 * math.pi * t_s / way.climb_s + way.climb_phase)))
        high, wide = self._picture.shape[:2]
        along = -_REACH * math.cos(math.pi * t_s / _DURATION_S)  # in widths of the window
        across = -way.sway * math.sin(2 * math.pi * t_s / way.sway_s + way.sway_phase)  # in heights
        ahead, aside = way.heading
        aspect = self.size[0] / self.size[1]
        x = wide / 2 + (along * ahead - across * aside / aspect - 0.5 / zoom) * self.size[0]
        y = high / 2 + (along * aside * aspect + across * ahead - 0.5 / zoom) * self.size[1]
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


def open_camera(spec: str, *, fps: float, seed: int = 0) -> VirtualCamera:
    """The camera of ``still:PICTURE`` or ``still:PICTURE@HEIGHT``, on the way of a seed, without annotations."""
    text = spec.removeprefix(SCHEME)
    name, separator, height = text.rpartition("@")
    if not separator or Path(text).is_file():
        return VirtualCamera(Path(text), fps=fps, seed=seed)
    try:
        heights = float(height)
    except ValueError:
        heights = math.nan
    if not _LEAST_VIEW <= heights <= _MOST_VIEW:
        raise UserError(
            f"{spec!r} asks for a view of {height!r} heights of the picture: "
            f"give a number from {_LEAST_VIEW:g} to {_MOST_VIEW:g}"
        )
    return VirtualCamera(Path(name), heights, fps, seed)


def _mirrored(found: FrameLabels, *, size: tuple[int, int]) -> FrameLabels:
    """Those of a picture of this (width, height), mirrored at each of its edges again and again."""
    tiles = [(across, down) for down in _DOWN for across in _ACROSS]
    boxes, ignored, beside = (
        np.concatenate([_in_tile(each, tile, size=size) for tile in tiles])
        for each in (found.boxes_xyxy_px, found.ignored_xyxy_px, found.beside_xyxy_px)
    )
    return FrameLabels.plain(boxes, found.class_names * len(tiles), ignored=ignored, beside=beside)


def _in_tile(boxes: Boxes, tile: tuple[int, int], *, size: tuple[int, int]) -> Boxes:
    """Where the boxes of the picture lie in one of its images, (0, 0) being itself."""
    moved = boxes.copy()
    for axis, (number, side) in enumerate(zip(tile, size, strict=True)):
        ends = boxes[:, [axis, axis + 2]]
        if number % 2:
            ends = side - ends[:, ::-1]
        moved[:, [axis, axis + 2]] = ends + number * side
    return moved
