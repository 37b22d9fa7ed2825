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

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from hvt_common.protocol.messages import AlsoShown
from hvt_common.values import Frame, Image, View
from hvt_common.video.base_crop import MAX_SIDE_PX, coded_size
from hvt_common.video.hevc import Picture
from hvt_common.video.still_codecs import (
    CodedCrop,
    JpegCodec,
    Parameters,
    StillCodec,
    best_fitting,
    psnr_y_db,
    smallest_reaching,
)
from hvt_edge.link.stills import Still
from hvt_edge.perception.candidates import PADDING
from hvt_edge.stills.policy.base import Request, union_crop

Allowance = Callable[[Still], int]
"""Returns the payload bytes that a still with this header may take now; the header's own data does not count."""

_TRIES = 3
"""Tries to fit payload and parameters into one allowance: parameters hardly change in size."""
_QUALITY_STEP_PCT = 5
_LEAST_PCT, _MOST_PCT = 1, 95
_READ_BY_ALL = JpegCodec()


@dataclass(frozen=True, slots=True)
class NoStill:
    """The reason why no still was made."""

    reason: Literal["too_large", "base_good"]
    """``too_large``: no still that is better than the base fits the allowance (a larger one may help);
    ``base_good``: the base shows it as well as the best quality would, or as well as the request demands."""


@dataclass(frozen=True, slots=True)
class _Fitted:
    data: bytes
    parameters: Parameters
    quality_pct: int
    shown_bgr: Image
    """The picture that the ground will decode."""


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
    floor_pct: int = 35
    """Lowest quality: a worse still tells a classifier little. A codec that builds on the base has no
    floor, because the base stays."""
    ceiling_pct: int = 90
    """Highest quality that may be spent on being better than the base."""
    min_gain_db: float = 0.1
    """Least gain over the base; it covers the rounding errors of other decoders."""
    least_bytes: int = 0
    """A smaller still is mostly header and changes nothing at the ground: it gets more bytes, or waits for them."""
    readable: Callable[[str], bool] = lambda _codec: True
    """Whether every ground that listens decodes this codec; ``jpeg`` takes the place of any other."""
    padding: float = PADDING
    max_side_px: int = MAX_SIDE_PX

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
        size = coded_size(crop_px, max_side_px=self.max_side_px)
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
        job, codec = job.with_header(sequence=sequence), self.preferred
        builds = job.base_crop_bgr is not None and codec.needs_base
        made = self._fitted(codec if builds else self.without_base, job, allowance)
        if builds and job.base_far_off:
            if not isinstance(made, NoStill):
                return self._cheaper(*made, job) or made[0]
            made = self._fitted(self.without_base, job, allowance)
        return made if isinstance(made, NoStill) else made[0]

    def _fitted(self, codec: StillCodec, job: Still, allowance: Allowance) -> tuple[Still, _Fitted] | NoStill:
        job = job.of_codec(codec)
        limit_bytes = allowance(job)
        for _ in range(_TRIES):
            fitted = self._best(codec, job, limit_bytes)
            if isinstance(fitted, NoStill):
                return fitted
            still = _filled(job, fitted)
            excess_bytes = len(still.data) - allowance(still)  # the codec's parameters have taken their part
            if excess_bytes <= 0:
                return still, fitted
            limit_bytes = min(limit_bytes, len(still.data)) - excess_bytes
        return NoStill("too_large")

    def _cheaper(self, built: Still, fitted: _Fitted, job: Still) -> Still | None:
        # The fallback's still, if it has the quality of the still built on the base in fewer bytes.
        codec = self.without_base
        smaller = _reaching(codec, job, psnr_y_db(fitted.shown_bgr, job.crop_bgr))
        if smaller is None or len(smaller.data) >= len(built.data) or not _beats_base(smaller, job):
            return None
        if len(smaller.data) < self.least_bytes:
            return None
        return _filled(job.of_codec(codec), smaller)

    def _best(self, codec: StillCodec, job: Still, limit_bytes: int) -> _Fitted | NoStill:
        # The requested fidelity or quality, or the best below that fits; then upwards until the base is beaten.
        if limit_bytes < self.least_bytes:
            return NoStill("too_large")
        fitted = _reaching(codec, job, self.fidelity_db) if self.fidelity_db else None
        if fitted is None:
            fitted = _at(codec, job, _MOST_PCT if self.fidelity_db else self.quality_pct)
        if len(fitted.data) > limit_bytes:
            lower = self._best_fitting(codec, job, limit_bytes, below_pct=fitted.quality_pct)
            helps = lower is not None and len(lower.data) >= self.least_bytes and _beats_base(lower, job)
            return lower if lower is not None and helps else NoStill("too_large")
        quality_pct, ceiling_pct = fitted.quality_pct, max(self.ceiling_pct, fitted.quality_pct)
        if self.least_bytes:
            ceiling_pct = _MOST_PCT
        while not _beats_base(fitted, job) or len(fitted.data) < self.least_bytes:
            quality_pct += _QUALITY_STEP_PCT
            if quality_pct > ceiling_pct:
                return NoStill("base_good")
            fitted = _at(codec, job, quality_pct)
            if len(fitted.data) > limit_bytes:
                return NoStill("too_large")
        return fitted

    def _best_fitting(
        self, codec: StillCodec, job: Still, limit_bytes: int, *, below_pct: int
    ) -> _Fitted | None:
        found = best_fitting(
            codec,
            job.crop_bgr,
            limit_bytes=limit_bytes,
            low_pct=_LEAST_PCT if codec.needs_base else self.floor_pct,
            high_pct=below_pct - 1,
            base_bgr=_base(codec, job),
        )
        return None if found is None else _decoded(codec, job, *found)


def _reaching(codec: StillCodec, job: Still, psnr_db: float) -> _Fitted | None:
    found = smallest_reaching(
        codec,
        job.crop_bgr,
        target_db=psnr_db,
        low_pct=_LEAST_PCT,
        high_pct=_MOST_PCT,
        base_bgr=_base(codec, job),
    )
    if found is None:
        return None
    coded, quality_pct, shown_bgr, _ = found
    return _Fitted(coded.data, coded.parameters, quality_pct, shown_bgr)


def _at(codec: StillCodec, job: Still, quality_pct: int) -> _Fitted:
    coded = codec.encode(job.crop_bgr, quality_pct=quality_pct, base_bgr=_base(codec, job))
    return _decoded(codec, job, coded, quality_pct)


def _decoded(codec: StillCodec, job: Still, coded: CodedCrop, quality_pct: int) -> _Fitted:
    height, width = job.crop_bgr.shape[:2]
    shown = codec.decode(
        coded.data, size=(width, height), parameters=coded.parameters, base_bgr=_base(codec, job)
    )
    return _Fitted(coded.data, coded.parameters, quality_pct, shown)


def _base(codec: StillCodec, job: Still) -> Image | None:
    return job.base_crop_bgr if codec.needs_base else None


def _beats_base(fitted: _Fitted, job: Still) -> bool:
    return job.alternative is None or job.alternative.loses_to(fitted.shown_bgr, crop=job.crop_bgr)


def _filled(job: Still, fitted: _Fitted) -> Still:
    return job.coded(fitted.data, quality_pct=fitted.quality_pct, parameters=fitted.parameters)
