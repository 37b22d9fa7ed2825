"""The still stage: crop of the untouched source frame, coded to fit its admission, and better than the base.

Two promises hold for every still that leaves here: it is never larger than ``limit_bytes``, and, where the decoded
base frame is at hand, it is closer to the source than what the base shows of the same place: in colour and in luma,
over the padded crop and over the box alone (mean squared error, hence PSNR). Where both promises cannot be kept
there is no still, and the reason is said.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from hvt_common.values import Frame, Image, Still, View
from hvt_common.vision.base_crop import MAX_SIDE_PX, base_crop, coded_size
from hvt_common.vision.still_codecs import JpegCodec, StillCodec
from hvt_edge.crop import PADDING, crop_box
from hvt_edge.methods.base import Request

__all__ = ["NoStill", "StillMaker", "crop_box"]

_QUALITY_STEP_PCT = 5
_BT601 = np.array([[0.114, 0.587, 0.299]], np.float32)


@dataclass(frozen=True, slots=True)
class NoStill:
    """Why no still was made."""

    reason: Literal["too_large", "base_good"]
    """``too_large``: nothing that is better than the base fits the admission (more room may help);
    ``base_good``: the base shows it as well as the best quality would."""


@dataclass(frozen=True, slots=True)
class StillMaker:
    """Makes stills with one set of settings; frozen, without state."""

    codec: StillCodec = field(default_factory=JpegCodec)
    quality_pct: int = 65
    """Asked for; less where the admission is smaller, more where the base is already better."""
    floor_pct: int = 35
    """Never below it: what is worse than that tells a classifier little."""
    ceiling_pct: int = 90
    """The most that is spent on being better than the base."""
    min_gain_db: float = 0.1
    """By how much the still must be closer than the base; covers how others round when they count."""
    padding: float = PADDING
    max_side_px: int = MAX_SIDE_PX

    def make(
        self,
        frame: Frame,
        request: Request,
        *,
        sequence: int,
        view: View,
        limit_bytes: int,
        base_bgr: Image | None = None,
    ) -> Still | NoStill:
        """Code the request's crop of ``frame``, which is the frame the request was made at.

        ``base_bgr`` is the decoded base frame of the same index; without it the second promise is not checked.
        ``limit_bytes`` bounds the payload.
        """
        candidate = request.candidate
        assert frame.index == candidate.frame_index, "a still shows the frame that its box belongs to"
        crop_px = crop_box(candidate.box_source_px, padding=self.padding, source_size=view.source_size)
        size = coded_size(crop_px, max_side_px=self.max_side_px)
        if base_bgr is not None and size[0] < (crop_px[2] - crop_px[0]) * min(1.0, view.scale):
            return NoStill("base_good")  # shrunk below the base's own grid: the base has more pixels of it
        crop = _cropped(frame.source_bgr, crop_px, size)
        rival = None
        if base_bgr is not None:
            seen = base_crop(base_bgr, view=view, crop_source_px=crop_px, size=size)
            rival = _Rival.of(
                seen,
                crop=crop,
                box=_inner_box(candidate.box_source_px, crop_px, size),
                share=10 ** (-self.min_gain_db / 10),
            )
        made = self._coded(crop, rival=rival, limit_bytes=limit_bytes)
        if isinstance(made, NoStill):
            return made
        data, quality_pct = made
        return Still(
            sequence=sequence,
            frame_index=frame.index,
            capture_ns=frame.capture_ns,
            track_id=candidate.track_id,
            box_source_px=candidate.box_source_px,
            crop_source_px=crop_px,
            class_name=candidate.class_name,
            confidence=candidate.confidence,
            reason=request.reason,
            codec=self.codec.name,
            quality_pct=quality_pct,
            data=data,
            media_type=self.codec.media_type,
            parameters={}
            if size == (crop_px[2] - crop_px[0], crop_px[3] - crop_px[1])
            else {"w": size[0], "h": size[1]},
        )

    def _coded(self, crop: Image, *, rival: _Rival | None, limit_bytes: int) -> tuple[bytes, int] | NoStill:
        """The asked quality, or the best below it that fits; then upwards until the base crop is beaten."""
        quality_pct = self.quality_pct
        data = self.codec.encode(crop, quality_pct=quality_pct).data
        if len(data) > limit_bytes:
            fitting = self._best_fitting(crop, limit_bytes)
            if fitting is None or rival is None:
                return fitting or NoStill("too_large")
            beaten = rival.loses_to(self._decoded(fitting[0], crop), crop=crop)
            return fitting if beaten else NoStill("too_large")
        ceiling_pct = max(self.ceiling_pct, self.quality_pct)
        while rival is not None and not rival.loses_to(self._decoded(data, crop), crop=crop):
            quality_pct += _QUALITY_STEP_PCT
            if quality_pct > ceiling_pct:
                return NoStill("base_good")
            data = self.codec.encode(crop, quality_pct=quality_pct).data
            if len(data) > limit_bytes:
                return NoStill("too_large")
        return data, quality_pct

    def _best_fitting(self, crop: Image, limit_bytes: int) -> tuple[bytes, int] | None:
        """Highest quality from ``floor_pct`` below the asked one that fits, by bisection: at most 5 encodings."""
        low, high = self.floor_pct, self.quality_pct - 1
        best = None
        while low <= high:
            middle = (low + high + 1) // 2
            data = self.codec.encode(crop, quality_pct=middle).data
            if len(data) <= limit_bytes:
                best, low = (data, middle), middle + 1
            else:
                high = middle - 1
        return best

    def _decoded(self, data: bytes, crop: Image) -> Image:
        return self.codec.decode(data, size=(crop.shape[1], crop.shape[0]))


@dataclass(frozen=True, slots=True)
class _Rival:
    """How far the base crop is from the source, and so how far a still may be."""

    box: tuple[slice, slice]
    limits: tuple[float, ...]

    @classmethod
    def of(cls, base: Image, *, crop: Image, box: tuple[slice, slice], share: float) -> _Rival:
        return cls(box=box, limits=tuple(share * error for error in _errors(base, crop, box)))

    def loses_to(self, still: Image, *, crop: Image) -> bool:
        return all(
            mine < limit for mine, limit in zip(_errors(still, crop, self.box), self.limits, strict=True)
        )


def _errors(image: Image, crop: Image, box: tuple[slice, slice]) -> tuple[float, ...]:
    """Sums of squared differences: colour and luma, over the crop and over the box in it."""
    # Luma of the difference, not difference of the lumas: rounded to bytes these would be off by up to 5 %.
    colour = cv2.subtract(image, crop, dtype=cv2.CV_32F)
    luma = cv2.transform(colour, _BT601)
    return tuple(cv2.norm(one, cv2.NORM_L2SQR) for one in (colour, luma, colour[box], luma[box]))


def _inner_box(
    box_source_px: tuple[float, float, float, float],
    crop_px: tuple[int, int, int, int],
    size: tuple[int, int],
) -> tuple[slice, slice]:
    """The box without its padding as (rows, columns) of the coded crop; never empty."""
    ranges = []
    for axis in (1, 0):
        scale = size[axis] / (crop_px[axis + 2] - crop_px[axis])
        start = min(max(0, round((box_source_px[axis] - crop_px[axis]) * scale)), size[axis] - 1)
        end = round((box_source_px[axis + 2] - crop_px[axis]) * scale)
        ranges.append(slice(start, min(max(end, start + 1), size[axis])))
    return ranges[0], ranges[1]


def _cropped(source_bgr: Image, crop_px: tuple[int, int, int, int], size: tuple[int, int]) -> Image:
    x1, y1, x2, y2 = crop_px
    crop = source_bgr[y1:y2, x1:x2]
    if size != (x2 - x1, y2 - y1):
        return np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(crop)
