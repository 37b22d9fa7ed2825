"""One crop, one codec, so many bytes: the quality that is asked for, or the best that fits."""

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
    """``too_large``: nothing that is better than the base fits the admission (more room may help);
    ``base_good``: the base shows it as well as the best quality would, or as well as is asked for."""


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

    def best(self, cut: CropJob, *, limit_bytes: int) -> Fitted | NoStill:
        """The asked fidelity or quality, or the best below it that fits; then upwards until the base is beaten."""
        asked = self._asked(cut)
        if len(asked.data) > limit_bytes:
            fitting = self._best_fitting(cut, limit_bytes, below_pct=asked.quality_pct)
            return fitting if fitting is not None and _beats_base(fitting, cut) else NoStill("too_large")
        quality_pct, ceiling_pct = asked.quality_pct, max(self.ceiling_pct, asked.quality_pct)
        while not _beats_base(asked, cut):
            quality_pct += _QUALITY_STEP_PCT
            if quality_pct > ceiling_pct:
                return NoStill("base_good")
            asked = self._at(cut, quality_pct)
            if len(asked.data) > limit_bytes:
                return NoStill("too_large")
        return asked

    def smallest(self, cut: CropJob, *, psnr_db: float, limit_bytes: int) -> Fitted | None:
        """The fewest bytes, fewer than ``limit_bytes``, that come this near to the source and beat the base."""
        fitted = self._reaching(cut, psnr_db)
        if fitted is None or len(fitted.data) >= limit_bytes or not _beats_base(fitted, cut):
            return None
        return fitted

    def _asked(self, cut: CropJob) -> Fitted:
        if not self.fidelity_db:
            return self._at(cut, self.quality_pct)
        return self._reaching(cut, self.fidelity_db) or self._at(cut, _MOST_PCT)

    def _reaching(self, cut: CropJob, psnr_db: float) -> Fitted | None:
        """The lowest quality that comes this near; None where none does."""
        found = smallest_reaching(
            self.codec,
            cut.crop_bgr,
            target_db=psnr_db,
            low_pct=_LEAST_PCT,
            high_pct=_MOST_PCT,
            base_bgr=self._base(cut),
        )
        if found is None:
            return None
        coded, quality_pct, shown_bgr, _ = found
        return Fitted(coded.data, coded.parameters, quality_pct, shown_bgr)

    def _best_fitting(self, cut: CropJob, limit_bytes: int, *, below_pct: int) -> Fitted | None:
        """The best quality from the floor to below the asked one that fits."""
        found = best_fitting(
            self.codec,
            cut.crop_bgr,
            limit_bytes=limit_bytes,
            low_pct=self.floor_pct,
            high_pct=below_pct - 1,
            base_bgr=self._base(cut),
        )
        return None if found is None else self._decoded(cut, *found)

    def _at(self, cut: CropJob, quality_pct: int) -> Fitted:
        coded = self.codec.encode(cut.crop_bgr, quality_pct=quality_pct, base_bgr=self._base(cut))
        return self._decoded(cut, coded, quality_pct)

    def _decoded(self, cut: CropJob, coded: CodedCrop, quality_pct: int) -> Fitted:
        height, width = cut.crop_bgr.shape[:2]
        shown = self.codec.decode(
            coded.data, size=(width, height), parameters=coded.parameters, base_bgr=self._base(cut)
        )
        return Fitted(coded.data, coded.parameters, quality_pct, shown)

    def _base(self, cut: CropJob) -> Image | None:
        return cut.base_crop_bgr if self.codec.needs_base else None


def _beats_base(fitted: Fitted, cut: CropJob) -> bool:
    return cut.alternative is None or cut.alternative.loses_to(fitted.shown_bgr, crop=cut.crop_bgr)
