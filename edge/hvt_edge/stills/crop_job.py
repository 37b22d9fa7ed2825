"""A crop taken out of its frame, with all that coding it takes: a pending still holds no whole frames.

A 4K frame takes 25 MB, its crops a few kilobytes each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from hvt_common.values import Image, Still, View
from hvt_common.video.base_crop import base_crop, coded_size
from hvt_common.video.hevc import YuvPicture
from hvt_common.video.still_codecs import StillCodec, psnr_y_db
from hvt_edge.perception.candidates import crop_box
from hvt_edge.stills.policy.base import CostEstimate, Request

Box = tuple[float, float, float, float]
Crop = tuple[int, int, int, int]
Place = tuple[slice, slice]
"""(rows, columns)."""

_BT601 = np.array([[0.114, 0.587, 0.299]], np.float32)
_FAR_OFF_SHARE = 0.5
"""With half of the crop's own variance in the difference to the base, there is little in the base to build on."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """The distance of the base from the source at a crop, which bounds that of a still."""

    places: tuple[Place, ...]
    """The boxes in the crop, without their padding."""
    limits: tuple[float, ...]
    """Sums of squared differences that a still must stay below."""
    psnr_y_db: float
    """Quality of the base crop, luma, over the whole crop."""
    error_share: float
    """Its squared luma error over the variance of the crop's luma: 1 is no better than one flat grey."""

    @classmethod
    def of(
        cls, base_crop: Image, *, crop: Image, places: tuple[Place, ...], min_gain_db: float
    ) -> Alternative:
        """``min_gain_db`` is by how much a still must be closer than the base."""
        share = 10 ** (-min_gain_db / 10)
        limits = tuple(share * error for error in _errors(base_crop, crop, places))
        _, spread = cv2.meanStdDev(cv2.transform(crop.astype(np.float32), _BT601))
        error = limits[1] / share / (crop.shape[0] * crop.shape[1])
        return cls(
            places=places,
            limits=limits,
            psnr_y_db=psnr_y_db(base_crop, crop),
            error_share=error / max(1.0, float(spread[0, 0]) ** 2),
        )

    def gain_db(self, still: Image, *, crop: Image) -> float:
        """The still's gain over the base: the least of colour and luma, over the crop and over each box."""
        errors = _errors(still, crop, self.places)
        return min(
            10 * math.log10(limit / mine) if mine and limit else math.inf if limit else -math.inf
            for mine, limit in zip(errors, self.limits, strict=True)
        )

    def loses_to(self, still: Image, *, crop: Image) -> bool:
        """Whether the still is closer to the source: colour and luma, over the crop and over each box."""
        errors = _errors(still, crop, self.places)
        return all(mine < limit for mine, limit in zip(errors, self.limits, strict=True))


@dataclass(frozen=True, slots=True)
class CropJob:
    """One crop, ready to be coded."""

    header: Still
    """The still as it will be, but for sequence, quality and data."""
    crop_bgr: Image
    """The crop of the source, at the size at which it is coded."""
    base_crop_bgr: Image | None = None
    """The same place in the decoded base frame of the same source frame, at that size; None without one."""
    alternative: Alternative | None = None
    """None where the base was not at hand."""

    @classmethod
    def of(
        cls, source_bgr: Image, crop_px: Crop, size: tuple[int, int], *, codec: StillCodec, **facts: Any
    ) -> CropJob:
        """Crop it to ``size`` (width, height), never larger than the crop; ``facts`` are those of the still."""
        x1, y1, x2, y2 = crop_px
        crop = source_bgr[y1:y2, x1:x2]
        shrinks = size != (x2 - x1, y2 - y1)
        pixels = cv2.resize(crop, size, interpolation=cv2.INTER_AREA) if shrinks else crop.copy()
        header = Still(
            sequence=0,
            crop_source_px=crop_px,
            codec=codec.name,
            media_type=codec.media_type,
            data=b"",
            parameters=size_parameters(crop_px, size),
            **facts,
        )
        return cls(header, np.asarray(pixels, np.uint8))

    def beside(
        self, base: Image | YuvPicture, *, view: View, min_gain_db: float, used: bool = False
    ) -> CropJob:
        """The same with what the base of its frame shows there; ``used``: the still builds on that."""
        height, width = self.crop_bgr.shape[:2]
        size, header = (width, height), self.header
        shown = base_crop(base, view=view, crop_source_px=header.crop_source_px, size=size)
        boxes = (header.box_source_px, *(box for _, box in header.also))
        places = tuple(inner_box(box, header.crop_source_px, size) for box in boxes)
        alternative = Alternative.of(shown, crop=self.crop_bgr, places=places, min_gain_db=min_gain_db)
        return replace(self, base_crop_bgr=shown if used else None, alternative=alternative)

    @property
    def size_bytes(self) -> int:
        return self.crop_bgr.nbytes + (0 if self.base_crop_bgr is None else self.base_crop_bgr.nbytes)

    @property
    def base_far_off(self) -> bool:
        """Whether the base shows something else here, so that a codec may do better without it."""
        return self.alternative is not None and self.alternative.error_share > _FAR_OFF_SHARE

    def recoded(self, codec: StillCodec, *, reason: str) -> CropJob:
        """The same crop for another codec, without the base; the still must be closer than the base all the same."""
        header = replace(self.header, reason=reason, codec=codec.name, media_type=codec.media_type)
        return replace(self, header=header, base_crop_bgr=None)


def union_crop(
    request: Request, *, padding: float, source_size: tuple[int, int]
) -> tuple[int, int, int, int]:
    """The area of a still of it: the smallest box around the padded crops of all its tracks, source pixels."""
    crops = [
        crop_box(one.box_source_px, padding=padding, source_size=source_size)
        for one in (request.candidate, *request.also)
    ]
    x1, y1, x2, y2 = zip(*crops, strict=True)
    return min(x1), min(y1), max(x2), max(y2)


def expected_bytes(
    request: Request, *, cost: CostEstimate, padding: float, source_size: tuple[int, int]
) -> float:
    """Expected payload of a still of this request, of one track or of several."""
    if not request.also:
        return cost.of(request.candidate)
    width, height = coded_size(union_crop(request, padding=padding, source_size=source_size))
    return cost.of_px(width * height)


def size_parameters(crop_px: Crop, size: tuple[int, int]) -> dict[str, int | float | str]:
    """The coded size for the header; nothing if it is the size of the crop."""
    if size == (crop_px[2] - crop_px[0], crop_px[3] - crop_px[1]):
        return {}
    return {"w": size[0], "h": size[1]}


def inner_box(box_source_px: Box, crop_px: Crop, size: tuple[int, int]) -> Place:
    """The box without its padding as (rows, columns) of the coded crop; never empty."""
    ranges = []
    for axis in (1, 0):
        scale = size[axis] / (crop_px[axis + 2] - crop_px[axis])
        start = min(max(0, round((box_source_px[axis] - crop_px[axis]) * scale)), size[axis] - 1)
        end = round((box_source_px[axis + 2] - crop_px[axis]) * scale)
        ranges.append(slice(start, min(max(end, start + 1), size[axis])))
    return ranges[0], ranges[1]


def _errors(image: Image, crop: Image, places: tuple[Place, ...]) -> tuple[float, ...]:
    # Sums of squared differences: colour and luma, over the crop and over each box in it.
    # Luma of the difference, not difference of the lumas: rounded to bytes these would be off by up to 5 %.
    colour = cv2.subtract(image, crop, dtype=cv2.CV_32F)
    luma = cv2.transform(colour, _BT601)
    parts = [part[place] for place in places for part in (colour, luma)]
    return tuple(cv2.norm(one, cv2.NORM_L2SQR) for one in (colour, luma, *parts))
