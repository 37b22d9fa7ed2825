"""Codes a requested crop: the source's own pixels, better than the base's, in one message.

Quality goes before size. The crop is coded at the quality that is requested, or better until it plainly shows more
than the base. Where that is larger than what comes promptly, quality is lowered, as long as the still beats the base;
then it may take all that a window yields; then it is shrunk, if that too is closer to the source. A still that is
no closer than the base is no closer look: there is none, and the reason is a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field, replace

import cv2
import numpy as np

from hvt_common.units import bitrate_text
from hvt_common.values import Image, Still
from hvt_common.video.still_codecs import CodedCrop, StillCodec
from hvt_edge.stills.crop_job import CropJob, size_parameters

_PLAIN_GAIN_DB = 2.0
"""A still that is closer to the source than the base by so much shows plainly more."""
_LEAST_GAIN_DB = 0.3
"""With less it shows nothing more."""
_BEST_PCT = 95
_STEP_PCT = 10
_FLOOR_PCT = 20
"""Below it a smaller picture of better quality shows more."""
_SHRINKS = (0.7, 0.5, 0.35, 0.25)
_LEAST_SIDE = 8
_TRIES = 4
_FILLED = 0.85
"""Share of the allowance from which no further try is made."""
_FALLS_PER_PCT = 0.03
"""Fall of the logarithm of a still's bytes for each percent of quality less: the start of a search."""


@dataclass(frozen=True, slots=True)
class Capacity:
    """The payload limits of one message."""

    prompt_bytes: int
    """The bytes that go out within a second."""
    most_bytes: int
    """All that the video yields."""
    total_bps: int

    def wait_s(self, size_bytes: int) -> float:
        """About how long so many bytes take: to get free in the second that is past, and on a link of that rate."""
        return 1 + 8 * size_bytes / self.total_bps


@dataclass(frozen=True, slots=True)
class CodedRequest:
    """A coded still, and the note for its requester; empty if it comes as requested."""

    still: Still
    note: str


@dataclass(frozen=True, slots=True)
class NothingCloser:
    """Why there is none, in a sentence."""

    reason: str


@dataclass(frozen=True, slots=True)
class _Tried:
    coded: CodedCrop
    quality_pct: int
    size: tuple[int, int]

    @property
    def size_bytes(self) -> int:
        return len(self.coded.data)


def code_requested(
    job: CropJob, *, codec: StillCodec, quality_pct: int, capacity: Capacity
) -> CodedRequest | NothingCloser:
    """Code the crop of ``job``; its ``alternative`` is the base's crop, None if that is not known."""
    tries = _Tries(job, codec)
    wanted = tries.at(quality_pct)
    best = None
    for limit_bytes in (capacity.prompt_bytes, capacity.most_bytes):
        best = best or _as_good(tries, wanted, limit_bytes) or _lower(tries, wanted, limit_bytes)
    best = best or _shrunk(job, codec, capacity.most_bytes, wanted=wanted)
    if best is None:
        return NothingCloser(_refusal(tries, wanted, capacity))
    header = job.header
    still = replace(
        header,
        quality_pct=best.quality_pct,
        data=best.coded.data,
        parameters={
            **header.parameters,
            **size_parameters(header.crop_source_px, best.size),
            **best.coded.parameters,
        },
    )
    return CodedRequest(still, _note(best, wanted, capacity))


@dataclass(eq=False)
class _Tries:
    # Codings of one crop at one size, each once.

    job: CropJob
    codec: StillCodec
    _: KW_ONLY
    pixels: Image | None = None
    """The crop made smaller; None at its own size."""
    done: dict[int, _Tried] = field(default_factory=dict)
    _gains: dict[int, float] = field(default_factory=dict)

    def at(self, quality_pct: int) -> _Tried:
        """Coded at this quality."""
        if quality_pct not in self.done:
            pixels = self.job.crop_bgr if self.pixels is None else self.pixels
            coded = self.codec.encode(pixels, quality_pct=quality_pct, base_bgr=None)
            self.done[quality_pct] = _Tried(coded, quality_pct, (pixels.shape[1], pixels.shape[0]))
        return self.done[quality_pct]

    def gain_db(self, one: _Tried) -> float:
        """The gain in closeness to the source over the base, at the crop's own size."""
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
        """Whether it shows more."""
        return one is not None and self.gain_db(one) >= _LEAST_GAIN_DB

    def fitting(self, limit_bytes: int, *, most_pct: int) -> _Tried | None:
        """The best quality up to ``most_pct`` that fits, or nearly that; found by the sizes of a few tries."""
        low, high, best = _FLOOR_PCT, most_pct, None
        for _ in range(_TRIES):
            if low > high:
                break
            one = self.at(self._guess(limit_bytes, low, high))
            if one.size_bytes <= limit_bytes:
                best, low = one, one.quality_pct + 1
                if one.size_bytes >= _FILLED * limit_bytes:
                    break
            else:
                high = one.quality_pct - 1
        return best

    def _guess(self, limit_bytes: int, low: int, high: int) -> int:
        # The quality at which a line through the tries so far crosses the limit, aimed a little below it.
        wanted = math.log(max(1, 0.95 * limit_bytes))
        known = sorted((abs(math.log(one.size_bytes) - wanted), pct) for pct, one in self.done.items())
        if not known:
            return (low + high) // 2
        nearest = self.done[known[0][1]]
        falls = _FALLS_PER_PCT
        if len(known) > 1:
            other = self.done[known[1][1]]
            steep = math.log(nearest.size_bytes / other.size_bytes)
            falls = max(0.005, steep / (nearest.quality_pct - other.quality_pct))
        guess = nearest.quality_pct + (wanted - math.log(nearest.size_bytes)) / falls
        return min(high, max(low, math.floor(guess)))


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
    found = tries.fitting(limit_bytes, most_pct=wanted.quality_pct - 1)
    return found if tries.beats_base(found) else None


def _shrunk(job: CropJob, codec: StillCodec, limit_bytes: int, *, wanted: _Tried) -> _Tried | None:
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
    better = list(filter(tries.beats_base, tries.done.values()))
    if not better and wanted.size_bytes > capacity.most_bytes:
        better = list(filter(tries.beats_base, [tries.at(_BEST_PCT)]))
    if not better:
        return "the video already shows it as well as the source does"
    least = min(better, key=lambda one: one.size_bytes)
    (width, height), shrink = wanted.size, 0.9 * math.sqrt(capacity.most_bytes / least.size_bytes)
    smaller = int(width * shrink), int(height * shrink)
    advice = f"ask for a smaller region, {smaller[0]}x{smaller[1]} or so"
    if min(smaller) < _LEAST_SIDE:  # a camera's own video is never left out, and may take all
        advice = "raise the budget"
    return (
        f"{width}x{height} pixels take {_kb(least.size_bytes)} to show more than the video does, and "
        f"{bitrate_text(capacity.total_bps)} carry {_kb(capacity.most_bytes)} at once beside it: {advice}"
    )


def _kb(size_bytes: int) -> str:
    return f"{size_bytes / 1000:.1f} kB"
