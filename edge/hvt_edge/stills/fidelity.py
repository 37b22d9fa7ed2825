"""One crop, one codec, so many bytes: the quality that is requested for, or the best that fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from hvt_common.values import Image
from hvt_common.video.still_codecs import (
    CodedCrop,
    Parameters,
    StillCodec,
    best_fitting,
    smallest_reaching,
)
from hvt_edge.stills.crop_job import CropJob

__all__ = ["Fitted", "Fitter", "NoStill"]

_QUALITY_STEP_PCT = 5
_LEAST_PCT, _MOST_PCT = 1, 95


@dataclass(frozen=True, slots=True)
class NoStill:
    """Why no still was made."""

    reason: Literal["too_large", "base_good"]
    """``too_large``: nothing that is better than the base fits the admission (a larger one may help);
    ``base_good``: the base shows it as well as the best quality would, or as well as is requested for."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A coded crop."""

    data: bytes
    parameters: Parameters
    quality_pct: int
    shown_bgr: Image
    """What the ground will see."""


@dataclass(frozen=True, slots=True)
class Fitter:
    """Searches a codec's ladder of qualities; the settings are those of `StillMaker`."""

    codec: StillCodec
    quality_pct: int
    fidelity_db: float
    floor_pct: int
    ceiling_pct: int

    def best(self, job: CropJob, *, limit_bytes: int) -> Fitted | NoStill:
        """The requested fidelity or quality, or the best below that fits; then upwards until the base is beaten."""
        requested = self._requested(job)
        if len(requested.data) > limit_bytes:
            fitting = self._best_fitting(job, limit_bytes, below_pct=requested.quality_pct)
            return fitting if fitting is not None and _beats_base(fitting, job) else NoStill("too_large")
        quality_pct, ceiling_pct = requested.quality_pct, max(self.ceiling_pct, requested.quality_pct)
        while not _beats_base(requested, job):
            quality_pct += _QUALITY_STEP_PCT
            if quality_pct > ceiling_pct:
                return NoStill("base_good")
            requested = self._at(job, quality_pct)
            if len(requested.data) > limit_bytes:
                return NoStill("too_large")
        return requested

    def smallest(self, job: CropJob, *, psnr_db: float, limit_bytes: int) -> Fitted | None:
        """The fewest bytes, fewer than ``limit_bytes``, that come this near to the source and beat the base."""
        fitted = self._reaching(job, psnr_db)
        if fitted is None or len(fitted.data) >= limit_bytes or not _beats_base(fitted, job):
            return None
        return fitted

    def _requested(self, job: CropJob) -> Fitted:
        if not self.fidelity_db:
            return self._at(job, self.quality_pct)
        return self._reaching(job, self.fidelity_db) or self._at(job, _MOST_PCT)

    def _reaching(self, job: CropJob, psnr_db: float) -> Fitted | None:
        """The lowest quality that comes this near; None where none does."""
        found = smallest_reaching(
            self.codec,
            job.crop_bgr,
            target_db=psnr_db,
            low_pct=_LEAST_PCT,
            high_pct=_MOST_PCT,
            base_bgr=self._base(job),
        )
        if found is None:
            return None
        coded, quality_pct, shown_bgr, _ = found
        return Fitted(coded.data, coded.parameters, quality_pct, shown_bgr)

    def _best_fitting(self, job: CropJob, limit_bytes: int, *, below_pct: int) -> Fitted | None:
        """The best quality from the floor to below the requested one that fits."""
        found = best_fitting(
            self.codec,
            job.crop_bgr,
            limit_bytes=limit_bytes,
            low_pct=self.floor_pct,
            high_pct=below_pct - 1,
            base_bgr=self._base(job),
        )
        return None if found is None else self._decoded(job, *found)

    def _at(self, job: CropJob, quality_pct: int) -> Fitted:
        coded = self.codec.encode(job.crop_bgr, quality_pct=quality_pct, base_bgr=self._base(job))
        return self._decoded(job, coded, quality_pct)

    def _decoded(self, job: CropJob, coded: CodedCrop, quality_pct: int) -> Fitted:
        height, width = job.crop_bgr.shape[:2]
        shown = self.codec.decode(
            coded.data, size=(width, height), parameters=coded.parameters, base_bgr=self._base(job)
        )
        return Fitted(coded.data, coded.parameters, quality_pct, shown)

    def _base(self, job: CropJob) -> Image | None:
        return job.base_crop_bgr if self.codec.needs_base else None


def _beats_base(fitted: Fitted, job: CropJob) -> bool:
    return job.alternative is None or job.alternative.loses_to(fitted.shown_bgr, crop=job.crop_bgr)
