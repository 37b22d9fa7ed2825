"""Which regions of a first pass are asked for again, by the rules of DDS, and the question as bytes.

Du et al., "Server-Driven Video Streaming for Deep Learning Inference", SIGCOMM 2020; the public program is
KuntaiDu/dds, whose names stand in brackets in `DdsSettings`. Boxes are x1, y1, x2, y2 in base pixels.
A question is ``>IB``: first frame of the segment and number of frames, then the masks one after the other as bits,
each but the first as its difference (exclusive or) from the one before, deflated. Regions that stay cost next to
nothing.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.sparse.csgraph import connected_components

from hvt_common.inference.nms import suppress
from hvt_common.values import Boxes, Detections, Image, iou
from hvt_study.datasets.sequence import NOMINAL_FPS


@dataclass(frozen=True, slots=True)
class DdsSettings:
    """Sizes are shares of the picture, thresholds are confidences and IoUs (0…1)."""

    share: float = 0.5
    """Share of the budget without requests that the first pass takes; the second has the rest."""
    segment_s: float = 1.0
    """So much media time is asked about at once."""
    fps: float = NOMINAL_FPS
    """Frames a second of both passes."""
    scale: float = 1.0
    """Width and height of the first pass as shares of the base size. The second has all of it."""
    low: float = 0.1
    """From here a result of the first pass is uncertain: DDS takes it from a region proposal network."""
    high: float = 0.4
    """From here it is confident (``prune_score``)."""
    overlap_iou: float = 0.3
    """A region that overlaps a confident result with more is known already (``objfilter_iou``)."""
    max_area: float = 0.04
    """A larger region is not asked for (``size_obj``)."""
    merge_iou: float = 0.3
    enlarge: float = 0.1
    """By so much of its own length a region grows on every side (``rpn_enlarge_ratio``)."""
    align_px: int = 16
    """Regions are made of whole blocks of this side."""
    confidence: float = 0.25
    """From which a final result starts a track."""
    nms_iou: float = 0.45
    """Results of both passes that overlap more are one."""
    camera_motion: Literal["off", "flow"] = "flow"
    """The tracker's camera motion, as at the ground that flies."""
    preset: str = "veryfast"
    bundle_bytes: int = 4000
    """Access units of the second pass share a message up to about so much: DDS sends a segment's as one file."""
    request_bytes: int = 700
    """Line bytes that are kept free for each request. A larger one waits until there is room."""

    @property
    def segment_frames(self) -> int:
        return max(1, round(self.segment_s * NOMINAL_FPS))

    @property
    def window_ns(self) -> int:
        """Window of the budget: a second, or long enough for two frames."""
        return round(1e9 * max(1.0, 2 / self.fps))

    @property
    def request_bps(self) -> float:
        """The part of the budget for requests."""
        return 8 * self.request_bytes * NOMINAL_FPS / self.segment_frames

    def first_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """(width, height) of the first pass, even numbers."""
        width, height = (max(2, 2 * math.floor(side * self.scale / 2 + 0.5)) for side in size)
        return width, height


Blocks = npt.NDArray[np.bool_]
"""(rows, columns): which blocks of ``align_px`` are asked for; those at the right and lower rim may be cut."""

_TWIN_IOU = 0.8
"""Above it two boxes are one object whatever their classes, as in our detectors."""


def requested_boxes(found: Detections, *, size: tuple[int, int], settings: DdsSettings) -> Boxes:
    """The regions, (K, 4), of a first pass's results at one frame of ``size`` (width, height).

    Uncertain results (``low`` ≤ confidence < ``high``) that no confident one explains and that are not too large,
    those that overlap merged, each enlarged and cut to the picture.
    """
    confident = found.confidences >= settings.high
    boxes = found.boxes_xyxy_px[~confident & (found.confidences >= settings.low)]
    sides = boxes[:, 2:] - boxes[:, :2]
    boxes = boxes[sides.prod(axis=1) <= settings.max_area * size[0] * size[1]]
    if confident.any() and len(boxes):
        known = iou(boxes, found.boxes_xyxy_px[confident]).max(axis=1) > settings.overlap_iou
        boxes = boxes[~known]
    boxes = merged(boxes, over_iou=settings.merge_iou)
    margin = (boxes[:, 2:] - boxes[:, :2]) * settings.enlarge
    limits = np.array([*size, *size], np.float32)
    grown = np.concatenate((boxes[:, :2] - margin, boxes[:, 2:] + margin), axis=1)
    return np.asarray(np.clip(grown, 0, limits), np.float32)


def merged(boxes_px: Boxes, *, over_iou: float) -> Boxes:
    """One hull for each group of boxes that hang together by overlaps of more than ``over_iou``; in stable order."""
    if len(boxes_px) < 2:
        return boxes_px
    count, group = connected_components(iou(boxes_px, boxes_px) > over_iou, directed=False)
    hulls = np.empty((count, 4), np.float32)
    for number in range(count):
        members = boxes_px[group == number]
        hulls[number] = (*members[:, :2].min(axis=0), *members[:, 2:].max(axis=0))
    return hulls


def block_grid(size: tuple[int, int], *, align_px: int) -> tuple[int, int]:
    """(rows, columns) of blocks that cover a picture of ``size`` (width, height)."""
    return -(-size[1] // align_px), -(-size[0] // align_px)


def requested_blocks(boxes_px: Boxes, *, size: tuple[int, int], align_px: int) -> Blocks:
    """Every block that a region touches."""
    rows, columns = block_grid(size, align_px=align_px)
    blocks = np.zeros((rows, columns), np.bool_)
    first = np.floor(boxes_px[:, :2] / align_px).astype(int)
    last = np.ceil(boxes_px[:, 2:] / align_px).astype(int)
    for (left, top), (right, bottom) in zip(first.tolist(), last.tolist(), strict=True):
        blocks[max(top, 0) : bottom, max(left, 0) : right] = True
    return blocks


def pixel_mask(blocks: Blocks, *, size: tuple[int, int], align_px: int) -> npt.NDArray[np.bool_]:
    """(height, width): the pixels of these blocks."""
    return blocks.repeat(align_px, axis=0).repeat(align_px, axis=1)[: size[1], : size[0]]


def pasted(
    under_bgr: Image | None, over_bgr: Image, blocks: Blocks, *, align_px: int
) -> npt.NDArray[np.uint8]:
    """A picture with these blocks of ``over_bgr`` and the rest of ``under_bgr``, or black where that is None."""
    high, wide = over_bgr.shape[:2]
    picture = np.zeros_like(over_bgr) if under_bgr is None else under_bgr.copy()
    mask = pixel_mask(blocks, size=(wide, high), align_px=align_px)
    np.copyto(picture, over_bgr, where=mask[..., None])
    return picture


def combined(first: Detections, second: Detections, *, settings: DdsSettings) -> Detections:
    """The final results of a frame: the confident ones of the first pass and all of the second, without doubles."""
    sure = first.confidences >= settings.high
    boxes = np.concatenate((second.boxes_xyxy_px, first.boxes_xyxy_px[sure]))
    scores = np.concatenate((second.confidences, first.confidences[sure]))
    kinds = np.concatenate((second.class_ids, first.class_ids[sure]))
    rows = suppress(boxes, scores, kinds, iou=settings.nms_iou, any_class_iou=_TWIN_IOU)
    return Detections(boxes[rows], scores[rows], kinds[rows])


_HEAD = struct.Struct(">IB")
_LEVEL = 9


@dataclass(frozen=True, slots=True)
class RegionRequest:
    """One question of the ground."""

    first_frame: int
    frames: tuple[Blocks, ...]
    """Masks of every coded frame of the segment in order, 1 to 255; empty where nothing is asked."""

    def pack(self) -> bytes:
        stack = np.stack(self.frames)
        stack[1:] ^= np.stack(self.frames)[:-1]
        return _HEAD.pack(self.first_frame, len(stack)) + zlib.compress(np.packbits(stack).tobytes(), _LEVEL)

    @classmethod
    def parse(cls, payload: bytes, *, grid: tuple[int, int]) -> RegionRequest:
        """Read it; ``grid`` is (rows, columns) of this session. `ValueError` where it is not one of this session."""
        if len(payload) < _HEAD.size:
            raise ValueError(f"a request of {len(payload)} bytes is cut off")
        first_frame, count = _HEAD.unpack_from(payload)
        cells = count * grid[0] * grid[1]
        expected = -(-cells // 8)
        try:
            bits = zlib.decompressobj().decompress(payload[_HEAD.size :], expected + 1)
        except zlib.error as error:
            raise ValueError(f"a request cannot be inflated: {error}") from None
        if len(bits) != expected or not count:
            raise ValueError(f"a request for {count} frames holds {len(bits)} bytes of masks, not {expected}")
        changes = np.unpackbits(np.frombuffer(bits, np.uint8), count=cells).reshape(count, *grid)
        return cls(first_frame, tuple(np.bitwise_xor.accumulate(changes, axis=0).astype(np.bool_)))
