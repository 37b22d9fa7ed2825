"""One scale of quality for all codecs: at the same percentage a still is about as good as JPEG at that quality.

So a setting (``--jpeg-quality 65``), a floor and a ceiling keep their meaning when the codec changes. Measured as the
mean Y-PSNR of 26 crops of drone_carpark; between the rows the line is straight.
"""

from __future__ import annotations

from bisect import bisect_right

__all__ = ["MAX_QP", "on_ladder", "qp_of"]

MAX_QP = 51

_QP = (
    (1, 50),
    (5, 46.5),
    (20, 37),
    (35, 33.4),
    (50, 31.2),
    (65, 29),
    (80, 25.4),
    (90, 21.2),
    (97, 14),
    (100, 10),
)
"""(quality in percent, QP of H.264 and HEVC)."""


def qp_of(quality_pct: int) -> int:
    """The QP at which x264 and x265 code as well as JPEG does at that quality."""
    return round(on_ladder(_QP, quality_pct))


def on_ladder(rows: tuple[tuple[int, float], ...], quality_pct: int) -> float:
    """The second column at ``quality_pct``, between rows whose first column runs from 1 to 100."""
    at = min(bisect_right([row[0] for row in rows], quality_pct), len(rows) - 1)
    (low, start), (high, end) = rows[at - 1], rows[at]
    return start + (end - start) * (quality_pct - low) / (high - low)
