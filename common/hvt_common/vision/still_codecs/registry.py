"""Every still codec by its name on the wire."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from hvt_common.errors import UserError
from hvt_common.vision.still_codecs.contract import StillCodec
from hvt_common.vision.still_codecs.jpeg import JpegCodec

__all__ = ["STILL_CODECS", "still_codec"]

STILL_CODECS: Mapping[str, StillCodec] = MappingProxyType({codec.name: codec for codec in (JpegCodec(),)})


def still_codec(name: str) -> StillCodec:
    """The codec of that name; `UserError` names those there are."""
    codec = STILL_CODECS.get(name)
    if codec is None:
        raise UserError(f"still codec {name!r} is not known: choose one of {', '.join(STILL_CODECS)}")
    return codec
