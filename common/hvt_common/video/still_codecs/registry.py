"""Every still codec by its name on the wire: the core's, and those that extras and other packages install.

Such a codec is an entry point of the group ``hvt.still_codecs``: its name is the codec's name on the wire, its object
satisfies `contract.StillCodec`, or is called without arguments to give one. A third party's package is imported when
its codec is requested by name, so that a broken plug-in matters only where it is used.
"""

import contextlib
import re
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Any

from hvt_common.errors import UserError, not_installed
from hvt_common.runtime.plug_ins import installed, loaded, origin, the_one
from hvt_common.video.still_codecs.contract import StillCodec

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
