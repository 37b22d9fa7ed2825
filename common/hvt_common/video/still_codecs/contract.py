"""The contract of a still codec, a crop to bytes and the bytes back, and every codec by its name on the wire.

A codec is a frozen value without state that may be used by several threads. Its ``decode`` gets bytes from the
network. It reads the dimensions in the header before it decodes a block, and raises `StillError` for any malformed
input.

All codecs share one scale of quality: at the same percentage a still is about as good as JPEG at that quality, so
that a setting (``--jpeg-quality 65``), a floor and a ceiling keep their meaning when the codec changes. Each codec
has a ladder from it to its own measure: the mean Y-PSNR of 26 crops of drone_carpark, linear between the rows.

Extras and other packages install a codec as an entry point of the group ``hvt.still_codecs``: its name is the codec's
name on the wire, its object satisfies `StillCodec`, or is called without arguments to give one. A third party's
package is imported when its codec is requested by name, so that a broken plug-in matters only where it is used.
"""

import contextlib
import re
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Any, Protocol

import cv2
import numpy as np

from hvt_common.errors import UserError, not_installed
from hvt_common.runtime.plug_ins import installed, loaded, origin, the_one
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


GROUP = "hvt.still_codecs"
"""The entry points' group."""
_WHAT = "still codec"

_NAME = re.compile(r"[a-z0-9-]{1,24}")
_MEDIA_TYPE = re.compile(r"[a-z]+/[a-z0-9.+-]{1,60}")

_PACKAGE = "hvt_common.video.still_codecs"
_BUILT_IN: Mapping[str, str] = MappingProxyType(
    {
        "jpeg": f"{_PACKAGE}.jpeg:JpegCodec",
        "h264-intra": f"{_PACKAGE}.h264_intra:H264IntraCodec",
        "residual": f"{_PACKAGE}.residual:ResidualCodec",
    }
)
_BROUGHT_BY = {"webp": "hvt", "avif": "hvt", "jxl": "hvt[jxl]"}
"""Codecs of the extra that comes with HVT, and the package to install for each. They need a library that may be
missing; ``lacking`` of the class says which."""


def still_codec_names() -> tuple[str, ...]:
    """The names that `still_codec` takes on this machine: HVT's own, then plug-ins by name; loads none of these."""
    found = installed(GROUP)
    own = [name for name in _BROUGHT_BY if name in found and _works(name)]
    return (*_BUILT_IN, *own, *sorted(found.keys() - _BUILT_IN.keys() - _BROUGHT_BY.keys()))


@cache
def still_codec(name: str) -> StillCodec:
    """The codec of that name; `UserError` where there is none, or where it does not work here."""
    target = _BUILT_IN.get(name)
    entry = the_one(GROUP, name, what=_WHAT, built_in=target is not None)
    if target is not None:
        module, _, attribute = target.partition(":")
        codec: StillCodec = getattr(import_module(module), attribute)()
        return codec
    if entry is not None:
        return _plugged_in(entry)
    if name in _BROUGHT_BY:
        raise not_installed(f"still codec {name!r}", _BROUGHT_BY[name])
    raise UserError(f"still codec {name!r} is not known: choose one of {', '.join(still_codec_names())}")


def _works(name: str) -> bool:
    with contextlib.suppress(UserError):
        return still_codec(name) is not None
    return False


def _plugged_in(entry: EntryPoint) -> StillCodec:
    def made(part: Any) -> tuple[Any, str | None]:
        # The codec, or why it does not work on this machine, if it tells.
        lacking = part.lacking() if hasattr(part, "lacking") else None
        wanted = lacking is None and (isinstance(part, type) or not hasattr(part, "encode"))
        return part() if wanted else part, lacking

    found: tuple[StillCodec, str | None] = loaded(entry, made, what=_WHAT)
    codec, lacking = found
    if lacking is not None:
        raise UserError(f"still codec {entry.name!r} is not available: {lacking}")
    wrong = _faults(entry.name, codec)
    if wrong:
        raise UserError(f"still codec {entry.name!r} of {origin(entry)} breaks the contract: {wrong}")
    return codec


def _faults(name: str, codec: object) -> str | None:
    said = getattr(codec, "name", None)
    if said != name or not _NAME.fullmatch(name):
        return f"its name is {said!r}, and has to be the entry point's: [a-z0-9-], at most 24 characters"
    if not _MEDIA_TYPE.fullmatch(str(getattr(codec, "media_type", None))):
        return f"its media_type is {getattr(codec, 'media_type', None)!r}, and has to be like image/jpeg"
    if not isinstance(getattr(codec, "needs_base", None), bool):
        return f"its needs_base is {getattr(codec, 'needs_base', None)!r}, and has to be True or False"
    missing = [word for word in ("encode", "decode") if not callable(getattr(codec, word, None))]
    return f"it has no {' and no '.join(missing)}" if missing else None
