"""A still from its crop to the line, and the codecs that the grounds decode."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from hvt_common.protocol.messages import BASE_CODEC, AlsoShown, InfoRequest, RoiHeader
from hvt_common.runtime.statistics import Newest
from hvt_common.values import Image, View
from hvt_common.video.base_crop import base_crop
from hvt_common.video.hevc import Picture
from hvt_common.video.still_codecs import StillCodec, psnr_y_db

_log = logging.getLogger(__name__)

Box = tuple[float, float, float, float]
Crop = tuple[int, int, int, int]
Place = tuple[slice, slice]
"""(rows, columns)."""

_BT601 = np.array([[0.114, 0.587, 0.299]], np.float32)
_FAR_OFF_SHARE = 0.5
"""Share of the crop's variance in the difference to the base above which the base is too far off to build on."""
_NO_PIXELS: Image = np.empty((0, 0, 3), np.uint8)
_PLAIN_ENCODING = "application/octet-stream"
"""The encoding of formats that only HVT reads; one byte on the wire."""
_OWN_TYPES = "application/vnd.hvt."
_FORGET_NS = 60_000_000_000
"""A ground queries ``info`` three times in this time; one that has not counts as gone."""
_MOST_READERS = 16
_MOST_SAID = 8


@dataclass(frozen=True, slots=True)
class Alternative:
    """The distance of the base from the source at a crop; a still must come closer."""

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
        """Measure the base crop; ``min_gain_db`` is by how much a still must be closer to the source."""
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


@dataclass(frozen=True, slots=True)
class Still:
    """A still: its crop until it is coded, its bytes from then on.

    A pending still holds no whole frames: a 4K frame takes 25 MB, its crops a few kilobytes each.
    """

    header: RoiHeader
    """The header as sent, except session, delay and flags; sequence and quality are set once it is coded."""
    media_type: str
    crop_bgr: Image = field(default_factory=lambda: _NO_PIXELS, repr=False, compare=False)
    """The crop of the source, at the size at which it is coded; empty afterwards."""
    base_crop_bgr: Image | None = field(default=None, repr=False, compare=False)
    """The same region in the decoded base frame of the same source frame, at that size; None without one."""
    alternative: Alternative | None = field(default=None, repr=False, compare=False)
    """The base's crop as a comparison; None where the base was not at hand."""
    data: bytes = b""

    @classmethod
    def cropped(
        cls,
        source_bgr: Image,
        crop_px: Crop,
        size: tuple[int, int],
        *,
        codec: StillCodec,
        also: tuple[AlsoShown, ...] = (),
        **facts: Any,
    ) -> Still:
        """Crop the source to ``size`` (width, height), never enlarged; ``facts`` are further fields of the header."""
        x1, y1, x2, y2 = crop_px
        crop = source_bgr[y1:y2, x1:x2]
        shrinks = size != (x2 - x1, y2 - y1)
        pixels = cv2.resize(crop, size, interpolation=cv2.INTER_AREA) if shrinks else crop.copy()
        header = RoiHeader(
            session_id=0,
            sequence=0,
            send_delay_ns=0,
            flags=0,
            crop_source_px=crop_px,
            codec=codec.name,
            also=also,
            parameters=size_parameters(crop_px, size),
            **facts,
        )
        return cls(header, codec.media_type, np.asarray(pixels, np.uint8))

    def beside(self, base: Picture, *, view: View, min_gain_db: float, used: bool = False) -> Still:
        """The same still beside the base's crop of that place; ``used``: its codec builds on that crop."""
        height, width = self.crop_bgr.shape[:2]
        size, header = (width, height), self.header
        shown = base_crop(base, view=view, crop_source_px=header.crop_source_px, size=size)
        boxes = (header.box_source_px, *(one.box_source_px for one in header.also))
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

    @property
    def encoding(self) -> str:
        """The encoding declared to Zenoh: the media type, if any program beside HVT could read the payload.

        A media type of our own would cost up to 34 bytes a still, and the header names the codec anyway.
        """
        return _PLAIN_ENCODING if self.media_type.startswith(_OWN_TYPES) else self.media_type

    def with_header(self, **changes: Any) -> Still:
        return replace(self, header=replace(self.header, **changes))

    def of_codec(self, codec: StillCodec) -> Still:
        return replace(self.with_header(codec=codec.name), media_type=codec.media_type)

    def without_base(self, codec: StillCodec) -> Still:
        """The same for a codec that needs no base; it must be closer than the base all the same."""
        return replace(self.of_codec(codec), base_crop_bgr=None)

    def coded(self, data: bytes, *, quality_pct: int, parameters: Mapping[str, int | float | str]) -> Still:
        """The still as sent; ``parameters`` are added to those of the header."""
        header = replace(
            self.header, quality_pct=quality_pct, parameters={**self.header.parameters, **parameters}
        )
        return Still(header, self.media_type, data=data)


def size_parameters(crop_px: Crop, size: tuple[int, int]) -> dict[str, int | float | str]:
    """The coded size for the header; empty if it is the size of the crop."""
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


class StillReaders:
    """The still codecs that each ground decodes, by its `InfoRequest`; one that named none decodes all. Thread-safe.

    ``clock`` is Unix nanoseconds without steps.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._readers: Newest[int, tuple[frozenset[str], int]] = Newest(_MOST_READERS)
        """Codecs by requester, and the time of its last request; a forged requester number takes one place."""
        self._said: set[str] = set()
        self._video_said = False

    def on_request(self, request: InfoRequest) -> None:
        if BASE_CODEC not in request.base_codecs and not self._video_said:
            self._video_said = True
            _log.warning(
                "a ground reads video of %s: this edge sends %s, and that ground will show none",
                ", ".join(request.base_codecs) or "no codec",
                BASE_CODEC,
            )
        with self._lock:
            self._readers.put(request.requester_id, (frozenset(request.still_codecs), self._clock()))

    def read(self, codec: str) -> bool:
        """Whether every ground that named its codecs within the last minute decodes this one."""
        since_ns = self._clock() - _FORGET_NS
        with self._lock:
            good = all(
                codec in read for read, requested_ns in self._readers.values() if requested_ns >= since_ns
            )
            news = not good and codec not in self._said and len(self._said) < _MOST_SAID
            if news:
                self._said.add(codec)
        if news:
            _log.warning("a ground does not read stills of %s: others are sent while it listens", codec)
        return good
