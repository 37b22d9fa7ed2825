"""Codes a requested crop: the source's own pixels, better than the base's, in one message.

Quality goes before size. The crop is coded at the requested quality, or better until it plainly shows more
than the base. Where that is too large to arrive promptly, quality is lowered, as long as the still beats the base;
then it may take all that a window yields; then it is shrunk, if that too is closer to the source. A still that is
no closer than the base shows nothing new: it is refused, with a sentence that gives the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from hvt_common.units import bitrate_text
from hvt_common.video.still_codecs import StillCodec
from hvt_edge.link.stills import Still
from hvt_edge.stills.maker import Coding, Codings

_PLAIN_GAIN_DB = 2.0
"""A still that is closer to the source than the base by this much shows plainly more."""
_LEAST_GAIN_DB = 0.3


class RefusedError(Exception):
    """A request cannot be served; the text is one plain sentence for its requester."""


_BEST_PCT = 95
_STEP_PCT = 10
_FLOOR_PCT = 20
"""Quality below which a smaller picture of better quality shows more."""
_FILLED = 0.85
"""The search ends with a still that fills this share of its limit: a large picture is coded in half the time."""
_SHRINKS = (0.7, 0.5, 0.35, 0.25)
_LEAST_SIDE = 8


@dataclass(frozen=True, slots=True)
class Capacity:
    """The payload limits of one message."""

    prompt_bytes: int
    """The bytes that leave within a second."""
    most_bytes: int
    """All bytes that the video yields."""
    total_bps: int

    def wait_s(self, size_bytes: int) -> float:
        """About how long ``size_bytes`` take: to get free in the past second, and on a link of that rate."""
        return 1 + 8 * size_bytes / self.total_bps


def code_requested(job: Still, *, codec: StillCodec, capacity: Capacity) -> tuple[Still, str]:
    """Code the crop of ``job`` at its quality; its ``alternative`` is the base's crop, None if that is not known.

    Returns the still with a note for its requester, empty if it comes as requested; else raises `RefusedError`.
    """
    tries = Codings(job, codec)
    wanted = tries.at(job.header.quality_pct)
    best = None
    for limit_bytes in (capacity.prompt_bytes, capacity.most_bytes):
        best = best or _as_good(tries, wanted, limit_bytes)
        if best is None and wanted.size_bytes > limit_bytes:
            # Below the requested quality, if that still beats the base.
            best = _fitting(tries, wanted, limit_bytes)
    best = best or _shrunk(job, codec, capacity.most_bytes, wanted=wanted)
    if best is None:
        raise RefusedError(_refusal(tries, wanted, capacity))
    return tries.still(best), _note(best, wanted, capacity)


def _beats_base(tries: Codings, one: Coding | None) -> bool:
    return one is not None and tries.gain_db(one) >= _LEAST_GAIN_DB


def _as_good(tries: Codings, wanted: Coding, limit_bytes: int) -> Coding | None:
    # At the requested quality, or better up to a plain gain; the best that fits, if it beats the base.
    best = None
    for quality_pct in _upwards(wanted.quality_pct):
        one = tries.at(quality_pct)
        if one.size_bytes > limit_bytes:
            break
        best = one
        if tries.gain_db(one) >= _PLAIN_GAIN_DB:
            break
    return best if _beats_base(tries, best) else None


def _fitting(tries: Codings, wanted: Coding, limit_bytes: int) -> Coding | None:
    found = tries.fitting(limit_bytes, low_pct=_FLOOR_PCT, high_pct=wanted.quality_pct, enough=_FILLED)
    return found if _beats_base(tries, found) else None


def _shrunk(job: Still, codec: StillCodec, limit_bytes: int, *, wanted: Coding) -> Coding | None:
    # The largest picture with fewer pixels that fits, if it too is closer to the source.
    height, width = job.crop_bgr.shape[:2]
    for shrink in _SHRINKS:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        pixels = np.asarray(cv2.resize(job.crop_bgr, size, interpolation=cv2.INTER_AREA), np.uint8)
        if found := _fitting(Codings(job, codec, pixels=pixels), wanted, limit_bytes):
            return found
    return None


def _upwards(quality_pct: int) -> Iterator[int]:
    while quality_pct < _BEST_PCT:
        yield quality_pct
        quality_pct += _STEP_PCT
    yield max(quality_pct - _STEP_PCT, _BEST_PCT)


def _note(best: Coding, wanted: Coding, capacity: Capacity) -> str:
    if (
        best.size == wanted.size
        and best.quality_pct >= wanted.quality_pct
        and capacity.prompt_bytes >= best.size_bytes
    ):
        return ""
    (width, height), wait_s = best.size, capacity.wait_s(best.size_bytes)
    note = f"{width}x{height} pixels at quality {best.quality_pct} come within about {wait_s:.1f} s"
    if wanted.size_bytes <= best.size_bytes:
        return note
    return (
        f"{note}: at quality {wanted.quality_pct} the region takes {_kb(wanted.size_bytes)}, and "
        f"{bitrate_text(capacity.total_bps)} carry {_kb(capacity.most_bytes)} at once"
    )


def _refusal(tries: Codings, wanted: Coding, capacity: Capacity) -> str:
    smallest_first = sorted(map(tries.at, tries.done), key=lambda one: one.size_bytes)
    least = next((one for one in smallest_first if _beats_base(tries, one)), None)
    if least is None and wanted.size_bytes > capacity.most_bytes and _beats_base(tries, tries.at(_BEST_PCT)):
        least = tries.at(_BEST_PCT)
    if least is None:
        return "the video already shows it as well as the source does"
    (width, height), shrink = wanted.size, 0.9 * math.sqrt(capacity.most_bytes / least.size_bytes)
    smaller = int(width * shrink), int(height * shrink)
    advice = f"ask for a smaller region, {smaller[0]}x{smaller[1]} or so"
    if min(smaller) < _LEAST_SIDE:  # a camera's own video is never left out, and may take the whole budget
        advice = "raise the budget"
    return (
        f"{width}x{height} pixels take {_kb(least.size_bytes)} to show more than the video does, and "
        f"{bitrate_text(capacity.total_bps)} carry {_kb(capacity.most_bytes)} at once beside it: {advice}"
    )


def _kb(size_bytes: int) -> str:
    return f"{size_bytes / 1000:.1f} kB"
