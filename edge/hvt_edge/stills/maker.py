"""The still stage: crop of the untouched source frame, coded to fit its allowance, and better than the base.

Two promises hold for every still that leaves here: it is never larger than its allowance, and, where the decoded
base frame is at hand, it is closer to the source than the base's picture of the same place: in colour and in luma,
over the padded crop and over each box alone (mean squared error, hence PSNR). Where both promises cannot be kept
no still is made, and the reason is returned.

A codec that builds on the base (``residual``) is used where the decoded base of the same source frame is at hand. The
fallback codec takes its place where there is none, and where the base is so far off that the fallback is smaller for
the same quality.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from hvt_common.protocol.messages import AlsoShown
from hvt_common.values import Frame, Image, View
from hvt_common.video.base_crop import coded_size
from hvt_common.video.hevc import Picture
from hvt_common.video.still_codecs import (
    CodedCrop,
    JpegCodec,
    StillCodec,
    best_fitting,
    psnr_y_db,
    smallest_reaching,
)
from hvt_edge.link.stills import Still, size_parameters
from hvt_edge.perception.candidates import PADDING
from hvt_edge.stills.policy.base import Request, union_crop

Allowance = Callable[[Still], int]
"""Returns the payload bytes that a still with this header may take now; the header's own data does not count."""

_TRIES = 3
"""Tries to fit payload and parameters into one allowance: parameters hardly change in size."""
_QUALITY_STEP_PCT = 5
_LEAST_PCT, _MOST_PCT = 1, 95
_FLOOR_PCT = 35
"""Lowest quality: a worse still tells a classifier little. A codec that builds on the base has no floor, because the
base stays."""
_CEILING_PCT = 90
"""Highest quality that may be spent on being better than the base."""
_READ_BY_ALL = JpegCodec()


@dataclass(frozen=True, slots=True)
class NoStill:
    """The reason why no still was made."""

    reason: Literal["too_large", "base_good"]
    """``too_large``: no still that is better than the base fits the allowance (a larger one may help);
    ``base_good``: the base shows it as well as the best quality would, or as well as the request demands."""


@dataclass(frozen=True, slots=True)
class Coding:
    """A crop coded at one quality."""

    coded: CodedCrop
    quality_pct: int
    size: tuple[int, int]

    @property
    def size_bytes(self) -> int:
        return len(self.coded.data)


@dataclass(eq=False)
class Codings:
    """Codings of one crop by one codec, each made once."""

    job: Still
    codec: StillCodec
    pixels: Image | None = None
    """The crop made smaller; None at its own size."""
    done: dict[int, CodedCrop] = field(default_factory=dict)
    _shown: dict[int, Image] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.job = self.job.of_codec(self.codec)
        self._pixels = self.job.crop_bgr if self.pixels is None else self.pixels
        self._size = self._pixels.shape[1], self._pixels.shape[0]
        self._base = self.job.base_crop_bgr if self.codec.needs_base else None

    def at(self, quality_pct: int) -> Coding:
        if quality_pct not in self.done:
            self.done[quality_pct] = self.codec.encode(
                self._pixels, quality_pct=quality_pct, base_bgr=self._base
            )
        return Coding(self.done[quality_pct], quality_pct, self._size)

    def shown_bgr(self, one: Coding) -> Image:
        """The picture that the ground will decode, at the crop's own size."""
        if one.quality_pct not in self._shown:
            shown = self.codec.decode(
                one.coded.data, size=one.size, parameters=one.coded.parameters, base_bgr=self._base
            )
            if self.pixels is not None:
                whole = self.job.crop_bgr.shape[1], self.job.crop_bgr.shape[0]
                shown = np.asarray(cv2.resize(shown, whole, interpolation=cv2.INTER_CUBIC), np.uint8)
            self._shown[one.quality_pct] = shown
        return self._shown[one.quality_pct]

    def gain_db(self, one: Coding) -> float:
        """The still's gain over the base in closeness to the source; infinite where the base is not known."""
        if self.job.alternative is None:
            return math.inf
        return self.job.alternative.gain_db(self.shown_bgr(one), crop=self.job.crop_bgr)

    def fitting(
        self, limit_bytes: int, *, low_pct: int, high_pct: int, enough: float = math.inf
    ) -> Coding | None:
        """The best quality that fits, or nearly the best; see `best_fitting`."""
        found = best_fitting(
            self.codec,
            self._pixels,
            limit_bytes=limit_bytes,
            low_pct=low_pct,
            high_pct=high_pct,
            base_bgr=self._base,
            tried=self.done,
            enough=enough,
        )
        return None if found is None else self.at(found[1])

    def reaching(self, psnr_db: float) -> Coding | None:
        """The least quality of that luma PSNR."""
        found = smallest_reaching(
            self.codec,
            self._pixels,
            target_db=psnr_db,
            low_pct=_LEAST_PCT,
            high_pct=_MOST_PCT,
            base_bgr=self._base,
        )
        if found is None:
            return None
        coded, quality_pct, shown_bgr, _ = found
        self.done[quality_pct], self._shown[quality_pct] = coded, shown_bgr
        return self.at(quality_pct)

    def still(self, one: Coding) -> Still:
        size = size_parameters(self.job.header.crop_source_px, one.size)
        return self.job.coded(
            one.coded.data, quality_pct=one.quality_pct, parameters={**size, **one.coded.parameters}
        )


@dataclass(frozen=True, slots=True)
class StillMaker:
    """Makes stills with one set of settings; frozen, without state."""

    codec: StillCodec = field(default_factory=JpegCodec)
    fallback: StillCodec | None = None
    """The codec that needs no base; required if ``codec`` needs one, and otherwise not used."""
    quality_pct: int = 65
    """Requested quality; lower where the allowance is smaller, higher where the base is already better."""
    fidelity_db: float = 0.0
    """Luma PSNR to reach with the fewest bytes, in place of ``quality_pct``; 0: the quality is fixed."""
    min_gain_db: float = 0.1
    """Least gain over the base; it covers the rounding errors of other decoders."""
    least_bytes: int = 0
    """A smaller still is mostly header and changes nothing at the ground: it gets more bytes, or waits for them."""
    readable: Callable[[str], bool] = lambda _codec: True
    """Whether every ground that listens decodes this codec; ``jpeg`` takes the place of any other."""
    padding: float = PADDING

    def __post_init__(self) -> None:
        assert self.fallback is not None or not self.codec.needs_base, f"{self.codec.name} needs a fallback"
        assert not (self.codec.needs_base and self.without_base.needs_base), (
            "the fallback serves without a base"
        )

    @property
    def preferred(self) -> StillCodec:
        """The codec of stills where the base is at hand."""
        return self.codec if self.readable(self.codec.name) else self.without_base

    @property
    def without_base(self) -> StillCodec:
        """The codec of stills that look the same whatever base frames the ground has."""
        codec = self.fallback if self.codec.needs_base else self.codec
        assert codec is not None, "checked at the start"
        return codec if self.readable(codec.name) else _READ_BY_ALL

    @property
    def codec_names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((self.preferred.name, self.without_base.name)))

    def crop(
        self, frame: Frame, request: Request, *, view: View, base: Picture | None = None
    ) -> Still | NoStill:
        """Crop the request out of ``frame``, which is the frame at which the request was made.

        ``base`` is the decoded base frame of the same index; without it the second promise is not checked.
        """
        lead = request.candidate
        assert frame.index == lead.frame_index, "a still shows the frame that its box belongs to"
        crop_px = union_crop(request, padding=self.padding, source_size=view.source_size)
        size = coded_size(crop_px)
        if base is not None and size[0] < (crop_px[2] - crop_px[0]) * min(1.0, view.scale):
            return NoStill("base_good")  # shrunk below the base's own grid: the base has more pixels of it
        job = Still.cropped(
            frame.source_bgr,
            crop_px,
            size,
            codec=self.without_base if base is None else self.preferred,
            frame_index=frame.index,
            capture_ns=frame.capture_ns,
            track_id=lead.track_id,
            box_source_px=lead.box_source_px,
            class_name=lead.class_name,
            confidence=lead.confidence,
            reason=request.reason,
            quality_pct=self.quality_pct,
            also=tuple(
                AlsoShown(track_id=one.track_id, box_source_px=one.box_source_px) for one in request.also
            ),
        )
        if base is None:
            return job
        job = job.beside(base, view=view, min_gain_db=self.min_gain_db, used=True)
        good = job.alternative is not None and 0 < self.fidelity_db <= job.alternative.psnr_y_db
        return NoStill("base_good") if good else job

    def code(self, job: Still, *, sequence: int, allowance: Allowance) -> Still | NoStill:
        """Code a crop within ``allowance``, which is called with the still as it comes out."""
        job = job.with_header(sequence=sequence)
        plain = Codings(job, self.without_base)
        if job.base_crop_bgr is None or not self.preferred.needs_base:
            return self._fitted(plain, allowance)
        building = Codings(job, self.preferred)
        built = self._fitted(building, allowance)
        if not job.base_far_off:
            return built
        if isinstance(built, NoStill):
            return self._fitted(plain, allowance)
        # The fallback's still, if it has the quality of the one built on the base in fewer bytes.
        shown = building.shown_bgr(building.at(built.header.quality_pct))
        smaller = plain.reaching(psnr_y_db(shown, job.crop_bgr))
        if smaller is None or not self.least_bytes <= smaller.size_bytes < len(built.data):
            return built
        return plain.still(smaller) if plain.gain_db(smaller) > 0 else built

    def _fitted(self, codings: Codings, allowance: Allowance) -> Still | NoStill:
        limit_bytes = allowance(codings.job)
        for _ in range(_TRIES):
            best = self._best(codings, limit_bytes)
            if isinstance(best, NoStill):
                return best
            still = codings.still(best)
            excess_bytes = len(still.data) - allowance(still)  # the codec's parameters have taken their part
            if excess_bytes <= 0:
                return still
            limit_bytes = min(limit_bytes, len(still.data)) - excess_bytes
        return NoStill("too_large")

    def _best(self, codings: Codings, limit_bytes: int) -> Coding | NoStill:
        # The requested fidelity or quality, or the best below that fits; then upwards until the base is beaten.
        if limit_bytes < self.least_bytes:
            return NoStill("too_large")
        one = codings.reaching(self.fidelity_db) if self.fidelity_db else None
        one = one or codings.at(_MOST_PCT if self.fidelity_db else self.quality_pct)
        if one.size_bytes > limit_bytes:
            least_pct = _LEAST_PCT if codings.codec.needs_base else _FLOOR_PCT
            lower = codings.fitting(limit_bytes, low_pct=least_pct, high_pct=one.quality_pct - 1)
            if lower is None or lower.size_bytes < self.least_bytes or codings.gain_db(lower) <= 0:
                return NoStill("too_large")
            return lower
        ceiling_pct = _MOST_PCT if self.least_bytes else max(_CEILING_PCT, one.quality_pct)
        quality_pct = one.quality_pct
        while codings.gain_db(one) <= 0 or one.size_bytes < self.least_bytes:
            quality_pct += _QUALITY_STEP_PCT
            if quality_pct > ceiling_pct:
                return NoStill("base_good")
            one = codings.at(quality_pct)
            if one.size_bytes > limit_bytes:
                return NoStill("too_large")
        return one
