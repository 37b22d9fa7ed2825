"""Regions of interest: where x265 quantises finer (or coarser); `TrackRegions` (R0) makes them of tracks.

libx265 takes them as side data of the picture. PyAV has no setter for it, but libavfilter's ``addroi`` attaches it
while a picture passes through: 0.2 ms for one region, 0.4 for 15, 1.2 for 64.

Two things are easily got wrong. x265 decides at its first picture whether there are offsets: a stream that starts
without and gets them later ends the process with a segmentation fault, so a `RegionTagger` marks every picture, with
an offset of 0 where nothing is wanted (the bytes are then those of a stream without any). And it ignores them with
``aq-mode=0``, which the presets ultrafast and superfast set.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from fractions import Fraction

import av
import numpy as np
from av.filter import Graph

from hvt_common.values import Boxes, Tracks

BLOCK_PX = 16
"""libx265 keeps one offset for each block of 16x16 luma pixels; a region takes all blocks that it touches."""
MOST_REGIONS = 96
"""More are not attached: the deepest come first."""

_LEAST_SIDE_PX = 1


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle with its own quantiser."""

    box_px: tuple[int, int, int, int]
    """x1, y1, x2, y2 in base pixels, x2 and y2 exclusive; clipped to the picture."""
    offset: float
    """-1…1, in units of 51 steps of the quantiser parameter: -0.1 is 5 steps finer, about half the error."""


class RegionTagger:
    """Attaches regions to the pictures of one stream, which have one size and one format."""

    def __init__(self) -> None:
        self._graph: Graph | None = None

    def tag(self, picture: av.VideoFrame, regions: Iterable[Region]) -> av.VideoFrame:
        """The same picture with these regions; where two overlap, the deeper one counts.

        The result is valid until the next call: its side data belongs to the filter graph of this call.
        """
        graph = Graph()
        graph.threads = 1  # else a pool of as many as there are cores, made for each picture
        last = graph.add_buffer(
            width=picture.width,
            height=picture.height,
            format=picture.format,
            time_base=picture.time_base or Fraction(1, 1000),
        )
        for region in usable(regions, size=(picture.width, picture.height)):
            x1, y1, x2, y2 = region.box_px
            node = graph.add("addroi", f"{x1}:{y1}:{x2 - x1}:{y2 - y1}:{region.offset:.4f}")
            last.link_to(node)
            last = node
        last.link_to(graph.add("buffersink"))
        graph.configure()
        graph.push(picture)
        tagged = graph.pull()
        assert isinstance(tagged, av.VideoFrame)
        self._graph = graph
        return tagged


def usable(regions: Iterable[Region], *, size: tuple[int, int]) -> Sequence[Region]:
    """Clip to the picture, deepest first, at most `MOST_REGIONS`; one of offset 0 where none is left."""
    width, height = size
    inside = []
    for region in regions:
        x1, y1, x2, y2 = region.box_px
        box = (max(0, x1), max(0, y1), min(width, x2), min(height, y2))
        if box[2] - box[0] < _LEAST_SIDE_PX or box[3] - box[1] < _LEAST_SIDE_PX:
            continue
        if not math.isfinite(region.offset):
            continue
        inside.append(Region(box, min(1.0, max(-1.0, region.offset))))
    inside.sort(key=lambda region: region.offset)
    return inside[:MOST_REGIONS] or [Region((0, 0, min(BLOCK_PX, width), min(BLOCK_PX, height)), 0.0)]


@dataclass(eq=False)
class TrackRegions:
    """R0: the boxes of the tracks at ``-depth``, less where they cover much of the picture.

    Up to ``free_share`` of the area the depth is as set; beyond, it shrinks in proportion, so that the bits taken
    from the rest of the picture stay about the same.
    """

    size: tuple[int, int]
    _: KW_ONLY
    depth: float
    padding: float = 0.1
    free_share: float = 0.25

    def regions(self, tracks: Tracks | None) -> list[Region]:
        """Return the regions of the next frame, keyframe or not; ``tracks`` (base pixels) may be some frames old."""
        if tracks is None or not len(tracks):
            return []
        best = np.argsort(-tracks.confidences, kind="stable")[:MOST_REGIONS]
        blocks = self._blocks(tracks.boxes_xyxy_px[np.sort(best)])
        share = self._covered(blocks)
        if share <= 0:
            return []
        offset = -self.depth * min(1.0, self.free_share / share)
        return [Region((x1, y1, x2, y2), offset) for x1, y1, x2, y2 in blocks]

    def _blocks(self, boxes: Boxes) -> list[tuple[int, int, int, int]]:
        # The padded boxes on the grid of blocks, inside the picture; those outside it are left out.
        pad = (boxes[:, 2:] - boxes[:, :2]) * self.padding
        grown = np.concatenate([boxes[:, :2] - pad, boxes[:, 2:] + pad], axis=1)
        limits = np.array([*self.size, *self.size], np.float64)
        grown = np.clip(np.nan_to_num(grown.astype(np.float64)), 0, limits)
        low = np.floor(grown[:, :2] / BLOCK_PX) * BLOCK_PX
        high = np.minimum(np.ceil(grown[:, 2:] / BLOCK_PX) * BLOCK_PX, limits[:2])
        whole = np.concatenate([low, high], axis=1).astype(int).tolist()
        return [(x1, y1, x2, y2) for x1, y1, x2, y2 in whole if x2 > x1 and y2 > y1]

    def _covered(self, blocks: Sequence[tuple[int, int, int, int]]) -> float:
        width, height = self.size
        mask = np.zeros((math.ceil(height / BLOCK_PX), math.ceil(width / BLOCK_PX)), np.bool_)
        for x1, y1, x2, y2 in blocks:
            mask[y1 // BLOCK_PX : -(-y2 // BLOCK_PX), x1 // BLOCK_PX : -(-x2 // BLOCK_PX)] = True
        return float(mask.mean())
