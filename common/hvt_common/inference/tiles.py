"""Tiled detection of small objects: the whole picture and overlapping tiles of it, merged into one list.

A network of 640 pixels gets a picture of 1920 at a third of its size, and an object of 12 pixels in four. Tiles
enlarge it, at the cost of a run for each. Boxes that touch a tile's border inside the picture may be truncated:
they count only where no other box covers them (slicing aided inference, Akyon et al., ICIP 2022).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Literal, Protocol, runtime_checkable

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.inference.nms import MAX_DETECTIONS, components, suppress
from hvt_common.values import Boxes, Detections, Image, intersections

if TYPE_CHECKING:
    from hvt_common.inference.detect import Detector

Grid = tuple[int, int]
"""(columns, rows)."""
Tile = tuple[int, int, int, int]
"""x1, y1, x2, y2 in pixels of the picture."""

MOST_RUNS: Final = 7
"""Runs of the detector at one decision step that ``auto`` may take: the whole picture and at most six tiles."""
OVERLAP: Final = 0.1
"""Share of a tile that the next one shows too: objects up to that size lie whole in one of them, and the whole
picture shows the larger ones well enough. With 0.2 small objects get fewer pixels: F1 .61 instead of .64."""

SEARCH: Final = "search"
_MOST_TILES: Final = 64
_SMALL_PX: Final = 12
"""The side of an object, source pixels, for which ``auto`` chooses the grid …"""
_SEEN_PX: Final = 10
"""… and the size it should have on the network's input: below, recall falls off steeply."""
_BORDER_SHARE: Final = 0.004
"""Share of a tile: a box that ends so near its border may go on beyond it."""
_SAME_IOU: Final = 0.45
_ANY_CLASS_IOU: Final = 0.7
_INSIDE: Final = 0.8
_COVERED: Final = 0.5
_REDUCED_SIDE: Final = 256
"""The longer one of a reduced picture, in pixels …"""
_LEAST_REDUCED: Final = 0.6
_LARGE_PX: Final = 24
"""… and the least side of a large object in it. With 32 a tenth of thermal cars is missed."""
_SURE: Final = 0.5
_PART: Final = 0.02
"""Share of a vehicle's box; a person seen from above is a thirtieth of it."""
_ACROSS: Final = 0.7
"""Two partial boxes are of one object if they share this much of the longer one's extent along the cut side."""


@runtime_checkable
class _Sized(Protocol):
    def input_size(self, image_size: tuple[int, int]) -> tuple[int, int]: ...
    def detect(self, image_bgr: Image, *, share: float = 1.0) -> Detections: ...


def parse_tiles(text: str) -> Grid | Literal["auto", "off"]:
    """The value of ``--tiles``: ``off``, ``auto``, which ``search`` is too (see `searches_scale`), or columns x rows.

    UserError for anything else.
    """
    if text == "off":
        return "off"
    if text in {"auto", SEARCH}:
        return "auto"
    found = re.fullmatch(r"([1-9]\d?)[x×]([1-9]\d?)", text)  # noqa: RUF001
    if found is None or int(found[1]) * int(found[2]) > _MOST_TILES:
        raise UserError(
            f"tiles {text!r} are not accepted; off, auto, {SEARCH} or CxR such as 2x2, {_MOST_TILES} at most, are"
        )
    return int(found[1]), int(found[2])


def searches_scale(tiles: str, *, pace: str) -> bool:
    """Whether ``--tiles`` lets `scale_search` find the scale: ``auto`` in real time, for lockstep repeats a study."""
    return tiles == SEARCH or (tiles == "auto" and pace != "lockstep")


def tiled(detector: Detector, tiles: str) -> Detector:
    """The detector with the tiles of ``--tiles``.

    Raises:
        UserError: ``tiles`` makes no sense, or the detector remembers pictures and cannot be given tiles.
    """
    grid = parse_tiles(tiles)
    if grid == "off":
        return detector
    if not isinstance(detector, _Sized):
        if grid == "auto":
            return detector
        raise UserError(
            f"tiles {tiles} need an ONNX network; motion, plug-ins and ensembles take whole pictures"
        )
    return TiledDetector(detector, grid=grid)


def auto_grid(source_size: tuple[int, int], detector: Detector) -> Grid:
    """The smallest grid on which an object of 12 source pixels has 10 on the network's input.

    Where no grid of fewer than `MOST_RUNS` tiles does, the one that comes nearest; (1, 1), which is no
    tiles at all, where the whole picture does. It depends on sizes alone.
    """
    if not isinstance(detector, _Sized):
        return 1, 1
    grids = [
        (columns, rows)
        for columns in range(1, MOST_RUNS)
        for rows in range(1, MOST_RUNS)
        if columns * rows < MOST_RUNS
    ]

    def worth(grid: Grid) -> tuple[float, int]:
        x1, y1, x2, y2 = tile_boxes(source_size, grid)[0]
        width, height = detector.input_size((x2 - x1, y2 - y1))
        seen_px = min(width / (x2 - x1), height / (y2 - y1)) * _SMALL_PX
        # In half pixels: another two tiles for a tenth of a pixel are not worth their runs.
        return min(round(seen_px * 2) / 2, _SEEN_PX), -grid[0] * grid[1]

    return max(grids, key=worth)


def tile_boxes(source_size: tuple[int, int], grid: Grid, *, overlap: float = OVERLAP) -> list[Tile]:
    """x1, y1, x2, y2 of every tile, source pixels, row by row; all of one size, the last ones at the far borders."""
    starts, sides = [], []
    for length, count in zip(source_size, grid, strict=True):
        side = min(length, -int(-length // (count - (count - 1) * overlap)))
        sides.append(side)
        starts.append([round(index * (length - side) / max(1, count - 1)) for index in range(count)])
    return [(x, y, x + sides[0], y + sides[1]) for y in starts[1] for x in starts[0]]


def detect_whole(detector: Detector, image_bgr: Image, *, share: float = 1.0) -> Detections:
    """Detect in the whole picture, without the tiles that `tiled` may have given it.

    A network whose input may have any size gets one with a ``share`` of its sides.
    """
    one = detector.whole if isinstance(detector, TiledDetector) else detector
    sized = share < 1 and isinstance(one, _Sized)
    return one.detect(image_bgr, share=share) if sized else one.detect(image_bgr)  # type: ignore[call-arg]


class TiledDetector:
    """Another detector on the whole picture and on ``grid`` overlapping tiles; itself a `Detector`.

    ``auto`` chooses the grid for each size of picture, see `auto_grid`. A grid of one's own is not bounded by
    `MOST_RUNS`. Boxes of two classes on one object (a car that is a truck too) become one, the more confident.
    """

    def __init__(self, detector: Detector, *, grid: Grid | Literal["auto"]) -> None:
        self.whole = detector
        self._grid: Grid | Literal["auto"] = grid
        self._auto: dict[tuple[int, int], Grid] = {}

    @property
    def class_names(self) -> tuple[str, ...]:
        return self.whole.class_names

    def grid(self, source_size: tuple[int, int]) -> Grid:
        """(columns, rows) for a picture of this (width, height); (1, 1) is the whole picture alone."""
        if self._grid != "auto":
            return self._grid
        if source_size not in self._auto:
            self._auto = {source_size: auto_grid(source_size, self.whole)}
        return self._auto[source_size]

    def detect(self, image_bgr: Image) -> Detections:
        """Detections in the pixels of this image, best first; at most `MAX_DETECTIONS`."""
        grid = self.grid((image_bgr.shape[1], image_bgr.shape[0]))
        tiles = tile_boxes((image_bgr.shape[1], image_bgr.shape[0]), grid)
        whole = self.whole.detect(image_bgr)
        return with_tiles(whole, image_bgr, tiles if grid != (1, 1) else (), self.whole.detect)


def with_tiles(
    whole: Detections, image_bgr: Image, tiles: Iterable[Tile], detect: Callable[[Image], Detections]
) -> Detections:
    """Objects found in the whole picture and those of ``detect`` in each of its tiles, as one list, best first."""
    size = (image_bgr.shape[1], image_bgr.shape[0])
    parts, truncated = [whole], [np.zeros(len(whole), bool)]
    for tile in tiles:
        x1, y1, x2, y2 = tile
        found = detect(np.ascontiguousarray(image_bgr[y1:y2, x1:x2]))
        boxes = found.boxes_xyxy_px + np.array([x1, y1, x1, y1], np.float32)
        parts.append(Detections(boxes, found.confidences, found.class_ids))
        truncated.append(_truncated(boxes, tile, size))
    return _merged(parts, np.concatenate(truncated))


def with_large(whole: Detections, image_bgr: Image, detect: Callable[[Image], Detections]) -> Detections:
    """The objects found in the whole picture and the large ones of ``detect`` in it reduced, as one list.

    Where a vehicle fills much of the picture, a network that learnt vehicles at twenty pixels takes its mirror for a
    pedestrian. In the reduced picture it sees the vehicle; parts of that are left out.
    """
    scale = _REDUCED_SIDE / max(image_bgr.shape[:2])
    if scale > _LEAST_REDUCED:
        return whole
    small = cv2.resize(image_bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    found = detect(np.asarray(small, np.uint8))
    found = replace(found, boxes_xyxy_px=found.boxes_xyxy_px / np.float32(scale))
    large = found.take(np.flatnonzero(are_large(found.boxes_xyxy_px, image_bgr)))
    sure = large.boxes_xyxy_px[large.confidences >= _SURE]
    tiny = areas(whole.boxes_xyxy_px)[:, None] < _PART * areas(sure)[None]
    part = np.any(tiny & (shared_of_smaller(whole.boxes_xyxy_px, sure) > _INSIDE), axis=1)
    parts = [whole.take(np.flatnonzero(~part)), large]
    return _merged(parts, np.zeros(sum(map(len, parts)), bool))


def are_large(boxes: Boxes, image_bgr: Image) -> npt.NDArray[np.bool_]:
    """(N,) whether each box is as large in the picture as those that `with_large` looks for."""
    sides = boxes[:, 2:] - boxes[:, :2]
    return np.asarray(sides.max(axis=1) >= _LARGE_PX / _REDUCED_SIDE * max(image_bgr.shape[:2]))


def _truncated(boxes: Boxes, tile: Tile, size: tuple[int, int]) -> npt.NDArray[np.bool_]:
    # (N,) True for boxes that touch a border of the tile that is not one of the picture.
    low, high = np.array(tile, np.float32).reshape(2, 2)
    margin = np.maximum(1.0, _BORDER_SHARE * (high - low))
    before = (boxes[:, :2] < low + margin) & (low > 0)
    behind = (boxes[:, 2:] > high - margin) & (high < size)
    return np.asarray((before | behind).any(axis=1))


def _merged(parts: list[Detections], truncated: npt.NDArray[np.bool_]) -> Detections:
    # One list of several over the same pixels, best first.
    boxes = np.concatenate([part.boxes_xyxy_px for part in parts])
    scores = np.concatenate([part.confidences for part in parts])
    class_ids = np.concatenate([part.class_ids for part in parts])
    whole = np.flatnonzero(~truncated)
    chosen = whole[
        suppress(boxes[whole], scores[whole], class_ids[whole], iou=_SAME_IOU, any_class_iou=_ANY_CLASS_IOU)
    ]
    # Of these, best first, those that do not lie in a better one of their class, nor hold one.
    inside = shared_of_smaller(boxes[chosen], boxes[chosen]) > _INSIDE
    inside &= class_ids[chosen, None] == class_ids[None, chosen]
    chosen = chosen[_first_come(inside)]
    partial = np.flatnonzero(truncated)
    partial = partial[np.argsort(-scores[partial], kind="stable")][:MAX_DETECTIONS]
    # Of truncated ones, best first, those that neither the others nor a better one cover by half.
    partial = partial[~(shared_of_smaller(boxes[partial], boxes[chosen]) > _COVERED).any(axis=1)]
    partial = partial[_first_come(shared_of_smaller(boxes[partial], boxes[partial]) > _COVERED)]
    joined, best = _joined(boxes[partial], class_ids[partial])
    chosen, boxes = np.concatenate((chosen, partial[best])), np.concatenate((boxes[chosen], joined))
    order = np.argsort(-scores[chosen], kind="stable")[:MAX_DETECTIONS]
    return Detections(boxes[order], scores[chosen][order], class_ids[chosen][order])


def _joined(partial: Boxes, class_ids: npt.NDArray[np.int32]) -> tuple[Boxes, npt.NDArray[np.intp]]:
    # (M, 4) boxes and (M,) their best part. Parts of one object overlap where tiles do, and agree along the border.
    if not len(partial):
        return partial, np.empty(0, np.intp)
    a, b = partial[:, None, :], partial[None, :, :]
    shared = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    longer = np.maximum(a[..., 2:] - a[..., :2], b[..., 2:] - b[..., :2])
    one = (shared > 0).all(axis=-1) & (shared > _ACROSS * longer).any(axis=-1)
    one &= class_ids[:, None] == class_ids[None, :]
    best, group = np.unique(components(one), return_inverse=True)
    low = np.full((len(best), 2), np.inf, np.float32)
    high = np.full((len(best), 2), -np.inf, np.float32)
    np.minimum.at(low, group, partial[:, :2])
    np.maximum.at(high, group, partial[:, 2:])
    return np.concatenate((low, high), axis=1), best


def _first_come(same: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    # Indices that are the same object as no index chosen before them; ``same`` is (N, N).
    left = np.ones(len(same), bool)
    for index in range(len(same)):
        if left[index]:
            left[index + 1 :] &= ~same[index, index + 1 :]
    return np.flatnonzero(left)


def shared_of_smaller(a_xyxy: Boxes, b_xyxy: Boxes) -> npt.NDArray[np.float32]:
    """(N, M) intersection over the smaller of two boxes."""
    smaller = np.minimum.outer(areas(a_xyxy), areas(b_xyxy))
    return np.asarray(intersections(a_xyxy, b_xyxy) / np.maximum(smaller, 1e-6), np.float32)


def areas(boxes: Boxes) -> npt.NDArray[np.float32]:
    """(…) of boxes (…, 4)."""
    return np.asarray((boxes[..., 2:] - boxes[..., :2]).prod(-1))
