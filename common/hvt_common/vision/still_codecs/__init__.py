"""Still codecs behind one small contract; see `contract`."""

from __future__ import annotations

from hvt_common.vision.still_codecs.contract import (
    BaseMissingError,
    CodedCrop,
    Parameters,
    StillCodec,
    StillError,
)
from hvt_common.vision.still_codecs.jpeg import JpegCodec
from hvt_common.vision.still_codecs.registry import STILL_CODECS, still_codec

__all__ = [
    "STILL_CODECS",
    "BaseMissingError",
    "CodedCrop",
    "JpegCodec",
    "Parameters",
    "StillCodec",
    "StillError",
    "still_codec",
]
