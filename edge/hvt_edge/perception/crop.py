"""The crop of a still: the padded box in the source frame."""

from __future__ import annotations

import math

PADDING = 0.15
"""Share of the box's width and height that is added on each side (the pilot's setting)."""
MIN_SIDE_PX = 8
"""No crop is narrower or lower than one JPEG block."""


def crop_box(
    box_source_px: tuple[float, float, float, float], *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The padded box in whole source pixels, grown to `MIN_SIDE_PX` and kept inside the frame.

    Rounded outwards, so that no pixel of the box is lost. A source smaller than `MIN_SIDE_PX` gives its whole side.
    """
    x1, x2 = _span(box_source_px[0], box_source_px[2], padding=padding, limit=source_size[0])
    y1, y2 = _span(box_source_px[1], box_source_px[3], padding=padding, limit=source_size[1])
    return x1, y1, x2, y2


def _span(low: float, high: float, *, padding: float, limit: int) -> tuple[int, int]:
    margin = max(0.0, high - low) * padding
    start = min(max(0, math.floor(low - margin)), limit)
    end = max(min(limit, math.ceil(high + margin)), 0)
    short = min(MIN_SIDE_PX, limit) - (end - start)
    if short > 0:
        start = min(max(0, start - (short + 1) // 2), limit - min(MIN_SIDE_PX, limit))
        end = max(end, start + min(MIN_SIDE_PX, limit))
    return start, end
