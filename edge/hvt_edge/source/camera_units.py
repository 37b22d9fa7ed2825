"""Packets of an HEVC camera as access units that HVT sends: Annex B, parameter sets before each keyframe. Pure.

A file in MP4 or Matroska writes lengths in place of start codes and has its parameter sets once, in a header (hvcC,
ISO/IEC 14496-15, 8.3.2.1.2); a camera may send them once, in the description of its RTSP stream. A ground that joins
later would wait for them for ever. So they are put before each keyframe that comes without; all else stays as it is.
"""

from __future__ import annotations

from hvt_common.values import CameraUnit
from hvt_common.video.annex_b import LONG_START, PARAMETER_SETS, is_keyframe, nal_kind, nal_units

_HVCC_HEADER_BYTES = 22
_FIRST_OF_PICTURE = 0x80
"""``first_slice_segment_in_pic_flag``, the first bit of a slice's header (H.265, clause 7.3.6.1)."""
_MOST_SETS, _MOST_SET_BYTES = 32, 4096
"""A camera has one of each kind; more than this is no camera's."""
_DELIMITER, _SLICES_END = 35, 32
"""The NAL unit types of an access unit delimiter, and behind the last of a slice (H.265, table 7-1)."""


class CameraUnits:
    """One stream; ``header`` is the container's or the stream's description before the first packet."""

    def __init__(self, header: bytes) -> None:
        self._length_bytes = 0
        """Size of the lengths in place of start codes; 0 without any."""
        sets = nal_units(header)
        if header[:1] == b"\1":
            self._length_bytes, sets = _hvcc(header)
        self._sets: dict[int, list[bytes]] = {}
        self._note(sets)

    def unit(self, packet: bytes) -> CameraUnit:
        """The access unit of one picture. `ValueError` with the fault for anything else."""
        data = packet
        if self._length_bytes:
            data = b"".join(LONG_START + one for one in _split(packet, self._length_bytes))
        nals = nal_units(data)
        slices = [one for one in nals if nal_kind(one) < _SLICES_END]
        pictures = sum(len(one) > 2 and bool(one[2] & _FIRST_OF_PICTURE) for one in slices)
        if pictures != 1:
            raise ValueError(f"a packet holds {pictures} pictures, and not one")
        self._note(nals)
        if not is_keyframe(data):
            return CameraUnit(data, keyframe=False)
        if {nal_kind(one) for one in nals} >= PARAMETER_SETS:
            return CameraUnit(data, keyframe=True)
        return CameraUnit(self._with_sets(data, nals), keyframe=True)

    def _with_sets(self, data: bytes, nals: list[bytes]) -> bytes:
        # The keyframe with all its sets, in order: behind the delimiter, which is the first where there is one.
        if self._sets.keys() != PARAMETER_SETS:
            raise ValueError("a keyframe has no VPS, SPS and PPS, and none came before it")
        sets = b"".join(LONG_START + one for kind in sorted(self._sets) for one in self._sets[kind])
        if nal_kind(nals[0]) != _DELIMITER:
            return sets + data
        return LONG_START + nals[0] + sets + b"".join(LONG_START + one for one in nals[1:])

    def _note(self, nals: list[bytes]) -> None:
        sets = [one for one in nals if nal_kind(one) in PARAMETER_SETS]
        if len(sets) > _MOST_SETS or any(len(one) > _MOST_SET_BYTES for one in sets):
            raise ValueError("there are more parameter sets, or longer ones, than a camera has")
        for kind in {nal_kind(one) for one in sets}:
            self._sets[kind] = [one for one in sets if nal_kind(one) == kind]


def _hvcc(header: bytes) -> tuple[int, list[bytes]]:
    # How many bytes a length has, and the parameter sets. `ValueError` for a header that breaks off.
    if len(header) <= _HVCC_HEADER_BYTES:
        raise ValueError("the header of its HEVC stream breaks off")
    sets: list[bytes] = []
    at = _HVCC_HEADER_BYTES + 1
    for _ in range(header[_HVCC_HEADER_BYTES]):
        count, at = int.from_bytes(header[at + 1 : at + 3], "big"), at + 3
        for _ in range(count):
            size, at = int.from_bytes(header[at : at + 2], "big"), at + 2
            if not size or at + size > len(header):
                raise ValueError("the header of its HEVC stream breaks off")
            sets.append(header[at : at + size])
            at += size
    return (header[_HVCC_HEADER_BYTES - 1] & 3) + 1, sets


def _split(packet: bytes, length_bytes: int) -> list[bytes]:
    # NAL units of a packet with lengths. `ValueError` where they do not add up.
    nals, at = [], 0
    while at < len(packet):
        begin = at + length_bytes
        size = int.from_bytes(packet[at:begin], "big")
        at = begin + size
        if not size or at > len(packet):
            raise ValueError("the lengths in a packet do not add up")
        nals.append(packet[begin:at])
    return nals
