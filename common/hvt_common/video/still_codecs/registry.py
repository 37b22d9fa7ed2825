"""Every still codec by its name on the wire: those of this package, and those that others install.

A third party's codec is an entry point of the group ``hvt.still_codecs``: its name is the codec's word on the wire,
its object satisfies `contract.StillCodec`, or is called without arguments to give one. Nothing is imported before it
is asked for by name, so that a broken plug-in hinders nobody who does not use it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType

from hvt_common.errors import UserError
from hvt_common.video.still_codecs.contract import StillCodec

__all__ = ["GROUP", "still_codec", "still_codec_names"]

GROUP = "hvt.still_codecs"
"""The entry points' group."""

_NAME = re.compile(r"[a-z0-9-]{1,24}")
_MEDIA_TYPE = re.compile(r"[a-z]+/[a-z0-9.+-]{1,60}")


@dataclass(frozen=True, slots=True)
class _BuiltIn:
    module: str
    attribute: str
    lacking: Callable[[], str | None] = lambda: None
    """Why it cannot work on this machine, or None."""


def _opencv(ending: str) -> Callable[[], str | None]:
    def lacking() -> str | None:
        from hvt_common.video.still_codecs import cv_still  # noqa: PLC0415 - only when asked

        return cv_still.lacking(ending)

    return lacking


def _jxl() -> str | None:
    from hvt_common.video.still_codecs.jxl import jxl_lacking  # noqa: PLC0415 - only when asked

    return jxl_lacking()


_BUILT_IN: Mapping[str, _BuiltIn] = MappingProxyType(
    {
        "jpeg": _BuiltIn("jpeg", "JpegCodec"),
        "jpeg-lite": _BuiltIn("jpeg_lite", "JpegLiteCodec"),
        "webp": _BuiltIn("webp", "WebpCodec", _opencv(".webp")),
        "avif": _BuiltIn("avif", "AvifCodec", _opencv(".avif")),
        "avif-lite": _BuiltIn("avif", "AvifLiteCodec", _opencv(".avif")),
        "jxl": _BuiltIn("jxl", "JxlCodec", _jxl),
        "h264-intra": _BuiltIn("h264_intra", "H264IntraCodec"),
        "hevc-intra": _BuiltIn("hevc_intra", "HevcIntraCodec"),
        "residual": _BuiltIn("residual", "ResidualCodec"),
    }
)


def still_codec_names() -> tuple[str, ...]:
    """What `still_codec` takes on this machine: the built-in ones, then the plug-ins by name. Loads none."""
    own = [name for name, built_in in _BUILT_IN.items() if built_in.lacking() is None]
    return (*own, *sorted(_plug_ins().keys() - _BUILT_IN.keys()))


@cache
def still_codec(name: str) -> StillCodec:
    """The codec of that name; `UserError` where there is none, or where it does not work here."""
    found = _plug_ins().get(name, ())
    built_in = _BUILT_IN.get(name)
    if found and built_in is not None:
        raise UserError(
            f"still codec {name!r} is built in, and {_origin(found[0])} brings another of that name: "
            "remove that package"
        )
    if built_in is not None:
        return _own(name, built_in)
    if len(found) > 1:
        raise UserError(
            f"still codec {name!r} comes from both {_origin(found[0])} and {_origin(found[1])}: remove one of them"
        )
    if not found:
        raise UserError(f"still codec {name!r} is not known: choose one of {', '.join(still_codec_names())}")
    return _foreign(name, found[0])


def _own(name: str, built_in: _BuiltIn) -> StillCodec:
    lacking = built_in.lacking()
    if lacking is not None:
        raise UserError(f"still codec {name!r} is not available: {lacking}")
    module = import_module(f"hvt_common.video.still_codecs.{built_in.module}")
    codec: StillCodec = getattr(module, built_in.attribute)()
    return codec


def _foreign(name: str, entry: EntryPoint) -> StillCodec:
    try:
        codec = entry.load()
        if isinstance(codec, type) or not hasattr(codec, "encode"):
            codec = codec()
    except Exception as error:  # foreign code may raise anything
        raise UserError(
            f"still codec {name!r} of {_origin(entry)} does not load: {type(error).__name__}: {error}"
        ) from error
    wrong = _faults(name, codec)
    if wrong:
        raise UserError(f"still codec {name!r} of {_origin(entry)} breaks the contract: {wrong}")
    loaded: StillCodec = codec
    return loaded


def _faults(name: str, codec: object) -> str | None:
    """What keeps it from being a `StillCodec` of that name, as far as can be seen without coding anything."""
    said = getattr(codec, "name", None)
    if said != name or not _NAME.fullmatch(name):
        return f"its name is {said!r}, and has to be the entry point's: [a-z0-9-], at most 24 characters"
    if not _MEDIA_TYPE.fullmatch(str(getattr(codec, "media_type", None))):
        return f"its media_type is {getattr(codec, 'media_type', None)!r}, and has to be like image/jpeg"
    if not isinstance(getattr(codec, "needs_base", None), bool):
        return f"its needs_base is {getattr(codec, 'needs_base', None)!r}, and has to be True or False"
    missing = [word for word in ("encode", "decode") if not callable(getattr(codec, word, None))]
    return f"it has no {' and no '.join(missing)}" if missing else None


@cache  # unknown names come from the network too, and a look at all packages takes tens of milliseconds
def _plug_ins() -> dict[str, tuple[EntryPoint, ...]]:
    # One installed package can be found twice, by two paths of sys.path: same value, same codec.
    found: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=GROUP):
        found.setdefault(entry.name, {}).setdefault(entry.value, entry)
    return {name: tuple(entries.values()) for name, entries in found.items()}


def _origin(entry: EntryPoint) -> str:
    return f"package {entry.dist.name} ({entry.value})" if entry.dist is not None else entry.value
