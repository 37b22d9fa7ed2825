"""The contract of a still codec: a crop to bytes at the edge, the bytes back to a crop at the ground.

A codec is a frozen value without state that may be used by several threads. Its ``decode`` gets bytes from the
network. It reads the dimensions in the header before it decodes a block, and raises `StillError` for any malformed
input.

All codecs share one scale of quality: at the same percentage a still is about as good as JPEG at that quality, so
that a setting (``--jpeg-quality 65``), a floor and a ceiling keep their meaning when the codec changes. Each codec
has a ladder from it to its own measure: the mean Y-PSNR of 26 crops of drone_carpark, linear between the rows.
"""

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol

import cv2
import numpy as np

from hvt_common.values import Image

MAX_QP = 51

Parameters = Mapping[str, int | float | str]
"""At most 5 of them, keys of at most 16 bytes: they cross the link in the still's header, and cost bytes there."""

NO_PARAMETERS: Parameters = MappingProxyType({})
"""Nothing beside the bytes."""


class StillError(Exception):
    """A still that cannot be decoded: truncated, of another format than announced, or of another size."""


class BaseMissingError(StillError):
    """The still builds on a base picture that is not at hand, or not the one that the edge had."""


@dataclass(frozen=True, slots=True)
class CodedCrop:
    """A crop as bytes, and the facts beside them that the other side needs."""

    data: bytes
    parameters: Parameters = field(default_factory=dict)


class StillCodec(Protocol):
    """The contract of a still codec.

    One that codes alike at several qualities may say so: ``step_of(quality_pct)`` of its class is equal for them.
    """

    @property
    def name(self) -> str:
        """The word on the wire, ``[a-z0-9-]``, at most 24 characters."""

    @property
    def media_type(self) -> str:
        """``image/jpeg`` and the like; also the Zenoh encoding of the payload."""

    @property
    def needs_base(self) -> bool:
        """Whether ``base_bgr`` has to be given: the same crop of the decoded base frame, at the same size."""

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:
        """Code a crop of at least 1x1 pixels; ``quality_pct`` runs from 1 (smallest) to 100 (best).

        More quality never means a worse picture; it nearly always means more bytes.
        """

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,
        base_bgr: Image | None = None,
    ) -> Image:
        """The crop again, BGR, exactly ``size`` (width, height).

        Raises `StillError` for anything hostile, before it costs more than a picture of that size; `BaseMissingError`
        where ``base_bgr`` is needed and is None or another than the edge had.
        """


_QP = (
    *((1, 50), (5, 46.5), (20, 37), (35, 33.4), (50, 31.2)),
    *((65, 29), (80, 25.4), (90, 21.2), (97, 14), (100, 10)),
)
"""(quality in percent, QP of H.264)."""


def qp_of(quality_pct: int) -> int:
    """The QP at which x264 codes as well as JPEG does at that quality."""
    return round(on_ladder(_QP, quality_pct))


def on_ladder(rows: tuple[tuple[int, float], ...], quality_pct: int) -> float:
    """The second column at ``quality_pct``, between rows whose first column runs from 1 to 100."""
    at = min(bisect_right([row[0] for row in rows], quality_pct), len(rows) - 1)
    (low, start), (high, end) = rows[at - 1], rows[at]
    return start + (end - start) * (quality_pct - low) / (high - low)


class IntraCodec(ABC):
    """A `StillCodec` that needs no base and no parameters: a crop to bytes, and back."""

    name: str
    media_type: str
    needs_base = False

    def encode(self, crop_bgr: Image, *, quality_pct: int, base_bgr: Image | None = None) -> CodedCrop:  # noqa: ARG002
        return CodedCrop(self._encoded(crop_bgr, quality_pct))

    def decode(
        self,
        data: bytes,
        *,
        size: tuple[int, int],
        parameters: Parameters = NO_PARAMETERS,  # noqa: ARG002
        base_bgr: Image | None = None,  # noqa: ARG002
    ) -> Image:
        return self._decoded(data, size)

    @abstractmethod
    def _encoded(self, crop_bgr: Image, quality_pct: int) -> bytes: ...

    @abstractmethod
    def _decoded(self, data: bytes, size: tuple[int, int]) -> Image: ...


def imencoded(ending: str, image_bgr: Image, flags: Sequence[int]) -> bytes:
    """The picture as a file; RuntimeError where the encoder refuses, which no crop makes it do."""
    done, data = cv2.imencode(ending, image_bgr, flags)
    if not done:
        raise RuntimeError(f"{ending} encoder refused a crop of shape {image_bgr.shape}")
    return data.tobytes()


def imdecoded(data: bytes, *, size: tuple[int, int], what: str) -> Image:
    """BGR of ``size``; an EXIF orientation is ignored.

    The caller has checked the header; raises `StillError` for faults behind it.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    # It would write a line for each broken picture, and a flood of them would fill the log.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise StillError(f"{what} does not decode: {error.err}") from error
    if image is None or image.shape != (size[1], size[0], 3):
        raise StillError(f"{what} of {size[0]}x{size[1]} does not decode")
    return np.asarray(image, np.uint8)
