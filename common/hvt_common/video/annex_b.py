"""NAL units in an Annex B byte stream (ITU-T H.264 and H.265, annex B)."""

from __future__ import annotations

import re

_START_CODE = re.compile(rb"\x00\x00\x01")
LONG_START = b"\0\0\0\1"
"""The start code of a parameter set, and of the first unit of a picture."""
_IRAP = frozenset(range(16, 22))
"""BLA, IDR and CRA pictures of H.265, table 7-1."""
PARAMETER_SETS = frozenset({32, 33, 34})
"""VPS, SPS and PPS, ibid."""


def nal_units(stream: bytes) -> list[bytes]:
    """The units, without start codes and the zeros behind them."""
    starts = [match.start() for match in _START_CODE.finditer(stream)]
    ends = [*starts, len(stream)][1:]
    found = (stream[begin + 3 : end].rstrip(b"\0") for begin, end in zip(starts, ends, strict=True))
    return [unit for unit in found if unit]


def parameter_sets(access_unit: bytes) -> bytes:
    """VPS, SPS and PPS of an HEVC access unit, as Annex B; empty unless all three are in it."""
    found = {kind: unit for unit in nal_units(access_unit) if (kind := nal_kind(unit)) in PARAMETER_SETS}
    return (
        b"".join(LONG_START + found[kind] for kind in sorted(found))
        if len(found) == len(PARAMETER_SETS)
        else b""
    )


def is_keyframe(access_unit: bytes) -> bool:
    """Whether an HEVC access unit is an IRAP picture, at which a decoder that has its parameter sets can start."""
    return any(nal_kind(unit) in _IRAP for unit in nal_units(access_unit))


def nal_kind(unit: bytes) -> int:
    """The NAL unit type, H.265 clause 7.3.1.2."""
    return unit[0] >> 1 & 0x3F
