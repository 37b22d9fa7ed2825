"""Regions of interest: where the encoder is to quantise finer (or coarser) than it would by itself.

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
from dataclasses import dataclass
from fractions import Fraction

import av
from av.filter import Graph

__all__ = ["BLOCK_PX", "MOST_REGIONS", "Region", "RegionTagger"]

BLOCK_PX = 16
"""libx265 keeps one offset for each block of 16x16 luma pixels; a region takes all blocks that it touches."""
MOST_REGIONS = 96
"""More are not attached: the deepest come first."""

_LEAST_SIDE_PX = 1


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle with its own quantiser."""

    box_px: tuple[int, int, int, int]
    """x1, y1, x2, y2 in base pixels, x2 and y2 exclusive; what lies outside the picture is cut off."""
    offset: float
    """-1…1, in units of 51 steps of the quantiser parameter: -0.1 is 5 steps finer, about half the error."""


class RegionTagger:
    """Attaches regions to the pictures of one stream, which have one size and one format."""

    def __init__(self) -> None:
        self._graph: Graph | None = None

    def tag(self, picture: av.VideoFrame, regions: Iterable[Region]) -> av.VideoFrame:
        """The same picture with these regions; where two overlap, the deeper one counts.

        The result is valid until the next call: its side data belongs to a filter graph that is kept so long.
        """
        graph = Graph()
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
    """Cut to the picture, deepest first, at most `MOST_REGIONS`; one of offset 0 where none is left."""
    width, height = size
    kept = []
    for region in regions:
        x1, y1, x2, y2 = region.box_px
        box = (max(0, x1), max(0, y1), min(width, x2), min(height, y2))
        if box[2] - box[0] < _LEAST_SIDE_PX or box[3] - box[1] < _LEAST_SIDE_PX:
            continue
        if not math.isfinite(region.offset):
            continue
        kept.append(Region(box, min(1.0, max(-1.0, region.offset))))
    kept.sort(key=lambda region: region.offset)
    return kept[:MOST_REGIONS] or [Region((0, 0, min(BLOCK_PX, width), min(BLOCK_PX, height)), 0.0)]
