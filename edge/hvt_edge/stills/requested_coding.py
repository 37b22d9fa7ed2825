"""Codes a requested crop: the source's own pixels, better than the base's, in one message.

Quality goes before size. The crop is coded at the requested quality, or better until it plainly shows more
than the base. Where that is too large to arrive promptly, quality is lowered, as long as the still beats the base;
then it may take all that a window yields; then it is shrunk, if that too is closer to the source. A still that is
no closer than the base shows nothing new: it is refused, with a sentence that gives the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field

import cv2
import numpy as np

from hvt_common.units import bitrate_text
from hvt_common.values import Image
from hvt_common.video.still_codecs import CodedCrop, StillCodec, best_fitting
from hvt_edge.link.stills import Still, size_parameters

_PLAIN_GAIN_DB = 2.0
"""A still that is closer to the source than the base by this much shows plainly more."""
_LEAST_GAIN_DB = 0.3
"""A still with less gain shows nothing more."""


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


@dataclass(frozen=True, slots=True)
class _Tried:
    coded: CodedCrop
    quality_pct: int
    size: tuple[int, int]

    @property
    def size_bytes(self) -> int:
        return len(self.coded.data)


def code_requested(job: Still, *, codec: StillCodec, capacity: Capacity) -> tuple[Still, str]:
    """Code the crop of ``job`` at its quality; its ``alternative`` is the base's crop, None if that is not known.

    Returns the still with a note for its requester, empty if it comes as requested; else raises `RefusedError`.
    """
    tries = _Tries(job, codec)
    wanted = tries.at(job.header.quality_pct)
    best = None
    for limit_bytes in (capacity.prompt_bytes, capacity.most_bytes):
        best = best or _as_good(tries, wanted, limit_bytes) or _lower(tries, wanted, limit_bytes)
    best = best or _shrunk(job, codec, capacity.most_bytes, wanted=wanted)
    if best is None:
        raise RefusedError(_refusal(tries, wanted, capacity))
    size = size_parameters(job.header.crop_source_px, best.size)
    still = job.coded(
        best.coded.data, quality_pct=best.quality_pct, parameters={**size, **best.coded.parameters}
    )
    return still, _note(best, wanted, capacity)


@dataclass(eq=False)
class _Tries:
    # Codings of one crop at one size, each once.

    job: Still
    codec: StillCodec
    _: KW_ONLY
    pixels: Image | None = None
    """The crop made smaller; None at its own size."""
    done: dict[int, CodedCrop] = field(default_factory=dict)
    _gains: dict[int, float] = field(default_factory=dict)

    def at(self, quality_pct: int) -> _Tried:
        pixels = self._coded_bgr
        if quality_pct not in self.done:
            self.done[quality_pct] = self.codec.encode(pixels, quality_pct=quality_pct, base_bgr=None)
        return _Tried(self.done[quality_pct], quality_pct, (pixels.shape[1], pixels.shape[0]))

    def gain_db(self, one: _Tried) -> float:
        """The still's gain over the base in closeness to the source, at the crop's own size."""
        alternative, crop = self.job.alternative, self.job.crop_bgr
        if alternative is None:
            return math.inf
        if one.quality_pct not in self._gains:
            parameters = one.coded.parameters
            shown = self.codec.decode(one.coded.data, size=one.size, parameters=parameters, base_bgr=None)
            if shown.shape != crop.shape:
                whole = crop.shape[1], crop.shape[0]
                shown = np.asarray(cv2.resize(shown, whole, interpolation=cv2.INTER_CUBIC), np.uint8)
            self._gains[one.quality_pct] = alternative.gain_db(shown, crop=crop)
        return self._gains[one.quality_pct]

    def beats_base(self, one: _Tried | None) -> bool:
        return one is not None and self.gain_db(one) >= _LEAST_GAIN_DB

    def fitting(self, limit_bytes: int, *, most_pct: int) -> _Tried | None:
        """The best quality up to ``most_pct`` that fits, or nearly the best."""
        found = best_fitting(
            self.codec,
            self._coded_bgr,
            limit_bytes=limit_bytes,
            low_pct=_FLOOR_PCT,
            high_pct=most_pct,
            tried=self.done,
            enough=_FILLED,
        )
        return None if found is None else self.at(found[1])

    @property
    def _coded_bgr(self) -> Image:
        return self.job.crop_bgr if self.pixels is None else self.pixels


def _as_good(tries: _Tries, wanted: _Tried, limit_bytes: int) -> _Tried | None:
    # At the requested quality, or better up to a plain gain; the best that fits, if it beats the base.
    best = None
    for quality_pct in _upwards(wanted.quality_pct):
        one = tries.at(quality_pct)
        if one.size_bytes > limit_bytes:
            break
        best = one
        if tries.gain_db(one) >= _PLAIN_GAIN_DB:
            break
    return best if tries.beats_base(best) else None


def _lower(tries: _Tries, wanted: _Tried, limit_bytes: int) -> _Tried | None:
    # Below the requested quality, if that still beats the base.
    if wanted.size_bytes <= limit_bytes:
        return None
    found = tries.fitting(limit_bytes, most_pct=wanted.quality_pct)
    return found if tries.beats_base(found) else None


def _shrunk(job: Still, codec: StillCodec, limit_bytes: int, *, wanted: _Tried) -> _Tried | None:
    # The largest picture with fewer pixels that fits, if it too is closer to the source.
    height, width = job.crop_bgr.shape[:2]
    for shrink in _SHRINKS:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        pixels = np.asarray(cv2.resize(job.crop_bgr, size, interpolation=cv2.INTER_AREA), np.uint8)
        smaller = _Tries(job, codec, pixels=pixels)
        found = smaller.fitting(limit_bytes, most_pct=wanted.quality_pct)
        if smaller.beats_base(found):
            return found
    return None


def _upwards(quality_pct: int) -> Iterator[int]:
    while quality_pct < _BEST_PCT:
        yield quality_pct
        quality_pct += _STEP_PCT
    yield max(quality_pct - _STEP_PCT, _BEST_PCT)


def _note(best: _Tried, wanted: _Tried, capacity: Capacity) -> str:
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


def _refusal(tries: _Tries, wanted: _Tried, capacity: Capacity) -> str:
    smallest_first = sorted(map(tries.at, tries.done), key=lambda one: one.size_bytes)
    least = next(filter(tries.beats_base, smallest_first), None)
    if least is None and wanted.size_bytes > capacity.most_bytes and tries.beats_base(tries.at(_BEST_PCT)):
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
