"""A camera's own HEVC stream: whether it can be the base stream, and its pictures as the ground will decode them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from statistics import median
from typing import Any

import av
from av.video.reformatter import ColorRange

from hvt_common.errors import UserError
from hvt_common.values import CameraUnit
from hvt_common.video.hevc import (
    LONG_START,
    PARAMETER_SETS,
    BaseDecoder,
    YuvPicture,
    is_keyframe,
    nal_kind,
    nal_units,
    without_filler,
)
from hvt_edge.source.contract import BaseSize, check_shape
from hvt_edge.source.decoding.pictures import matrix_of, turn_of

_HVCC_HEADER_BYTES = 22
_FIRST_OF_PICTURE = 0x80
"""``first_slice_segment_in_pic_flag``, the first bit of a slice's header (H.265, clause 7.3.6.1)."""
_MOST_SETS, _MOST_SET_BYTES = 32, 4096
"""Limits: a camera has one parameter set of each kind, and never this many or this large."""
_DELIMITER, _SLICES_END = 35, 32
"""The NAL unit types of an access unit delimiter, and behind the last of a slice (H.265, table 7-1)."""


class CameraUnits:
    """Packets of one stream as access units that HVT sends: Annex B, parameter sets before each keyframe. Pure.

    A file in MP4 or Matroska writes lengths in place of start codes and has its parameter sets once, in a header
    (hvcC, ISO/IEC 14496-15, 8.3.2.1.2); a camera may send them once, in the description of its RTSP stream. A ground
    that joins later would wait for them for ever. So they are put before each keyframe that comes without them.
    Filler, with which a camera keeps a constant rate, is removed; all else stays. ``header`` is the container's or
    the stream's description before the first packet.
    """

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
        data = without_filler(data)
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
        # The keyframe with all its sets, in order: behind the delimiter, which comes first where there is one.
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
    # The number of bytes of a length, and the parameter sets. `ValueError` for a header that breaks off.
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


@dataclass(frozen=True, slots=True)
class SeenUnit:
    """One access unit that was surveyed before the flight."""

    at_s: float
    """The camera's time stamp, from its first unit on."""
    size_bytes: int
    """Size with the parameter sets that are put before a keyframe."""
    keyframe: bool


@dataclass(frozen=True, slots=True)
class CameraStream:
    """The stream as measured before the flight: the first minutes of a file, some seconds of a camera."""

    units: tuple[SeenUnit, ...]
    """The first is a keyframe."""
    fps: float
    """The frame rate by its time stamps."""

    @property
    def keyframe_s(self) -> float:
        """The longest time from one keyframe to the next; without a second one, the time surveyed."""
        times = [unit.at_s for unit in self.units if unit.keyframe]
        return max(
            (later - earlier for earlier, later in pairwise([*times, self.units[-1].at_s])), default=0.0
        )


REENCODE = "re-encode it with --encoder x265"
_FORMATS = frozenset({"yuv420p", "yuvj420p"})
"""4:2:0 in 8 bits; the second is FFmpeg's name for the same in full range."""
LONG_STEP_S, _LONG_STEPS = 1.0, 3
"""A step from one frame to the next of more than both, in seconds and in usual steps, is a jump of the stamps."""
_OTHER_MATRICES = frozenset({4, 5, 6, 7, 9})
"""Other matrices of ITU-T H.273, table 4: BT.601 in its variants, SMPTE 240M and BT.2020."""


def without_jumps(units: Sequence[SeenUnit]) -> tuple[SeenUnit, ...]:
    """The units from time 0 on. A step back in time, or one too long for a frame, becomes the usual one (the median).

    Such a step is a clock that was set or ran over, packets that were lost, or two recordings put together.
    """
    steps = [later.at_s - earlier.at_s for earlier, later in pairwise(units)]
    usual_s = median([step for step in steps if step > 0] or [0.0])
    most_s = max(LONG_STEP_S, _LONG_STEPS * usual_s)
    mended = (step if 0 <= step <= most_s else usual_s for step in steps)
    times = accumulate(mended, initial=0.0)
    return tuple(replace(unit, at_s=at_s) for unit, at_s in zip(units, times, strict=True))


def rate_of(name: str, units: Sequence[SeenUnit], *, said: float | None) -> float:
    """Frames a second. The container's rate counts if its time stamps agree with it within 2 %.

    Raises `UserError` if they give no rate, or one that no base stream can have.
    """
    span_s = without_jumps(units)[-1].at_s
    fps = (len(units) - 1) / span_s if span_s > 0 else said or 0.0
    if said and abs(fps / said - 1) < 0.02:
        fps = said
    if not 0.1 <= fps <= 240:
        raise UserError(
            f"source {name} gives {fps:.4g} frames a second by its time stamps, and a base stream has 0.1 to 240: "
            f"{REENCODE}"
        )
    return round(fps, 3)


class CameraDecoder:
    """Takes packets in their order; returns each unit that can be sent with its picture. One thread.

    A damaged unit is left out with all units up to the next keyframe, as a ground would have to.
    """

    def __init__(self, units: CameraUnits) -> None:
        self._units = units
        self._decoder = BaseDecoder()  # of any size: with a size it would only fail at a larger picture
        self._size: tuple[int, int] | None = None
        self.whole = False
        """Whether all units since a keyframe were decoded; read by other threads too."""
        self.trouble = ""
        """The fault of the newest unit that was left out, in a few words."""
        self.is_other = False
        """Whether that unit is intact, but of another size or format than is accepted."""

    def expect(self, size: tuple[int, int] | None) -> None:
        """From now on a picture of another size (width, height) is not accepted."""
        self._size = size

    def skip(self) -> None:
        self.whole = False

    def decode(self, packet: bytes) -> tuple[CameraUnit, YuvPicture] | None:
        """The unit and its picture; None where it cannot be sent."""
        try:
            unit = self._units.unit(packet)
        except ValueError as error:
            self._leave_out(str(error))
            return None
        if not unit.keyframe and not self.whole:
            return None
        if unit.keyframe and not self.whole:
            self._decoder.reset()
        picture = self._decoder.decode_yuv(unit.data)
        if picture is None:
            self._leave_out("a unit cannot be decoded by itself")
            return None
        if picture.frame.format.name not in _FORMATS:
            self._leave_out(f"a picture has the format {picture.frame.format.name}", is_other=True)
            return None
        if self._size is not None and picture.size != self._size:
            self._leave_out(f"a picture has {picture.size[0]}x{picture.size[1]} pixels", is_other=True)
            return None
        self.whole = True
        return unit, picture

    def _leave_out(self, why: str, *, is_other: bool = False) -> None:
        self.whole, self.trouble, self.is_other = False, why, is_other


def open_units(name: str, stream: Any) -> CameraUnits:
    """The converter of an open stream's packets. Raises `UserError` where its header is damaged."""
    try:
        return CameraUnits(stream.codec_context.extradata or b"")
    except ValueError as error:
        raise UserError(f"source {name} cannot be passed through ({error}): {REENCODE}") from error


def check_stream(name: str, stream: Any) -> None:
    """Raise `UserError` if an open stream cannot be the base stream, with the accepted ones."""
    codec, fault = stream.codec_context, ""
    aspect = None if codec is None else stream.sample_aspect_ratio or codec.sample_aspect_ratio
    takes = "and --encoder passthrough takes"
    if codec is None or codec.name != "hevc":
        fault = f"is {codec.name if codec else 'no codec that is known'}, {takes} HEVC alone: "
    elif codec.pix_fmt not in _FORMATS:
        has = f"HEVC {codec.profile or ''} in {codec.pix_fmt}"
        fault = f"is {has}, {takes} Main, 4:2:0 in 8 bits: set the camera to Main, or "
    elif aspect and not 0.99 < aspect < 1.01:
        fault = f"has pixels that are {float(aspect):.2f} times as wide as high, {takes} square ones: "
    elif codec.has_b_frames:
        fault = f"shows pictures in another order than it sends them (B-frames), {takes} none: switch them off, or "
    if fault:
        raise UserError(f"source {name} {fault}{REENCODE}")


def check_picture(name: str, picture: av.VideoFrame, *, size: BaseSize) -> str:
    """Raise `UserError` where a picture is not shown as it is coded, or has another size than is requested.

    Return the other differences that a ground will see, as a sentence; empty for none.
    """
    has = (picture.width, picture.height)
    wanted = size(has) if callable(size) else size
    if has != wanted:
        raise UserError(
            f"source {name} is {has[0]}x{has[1]}, --size is {wanted[0]}x{wanted[1]}, and --encoder passthrough "
            f"sends the camera's own size: leave --size out, or {REENCODE}"
        )
    try:
        check_shape(size=has, fps=1)
    except UserError as error:
        raise UserError(f"source {name}: its {str(error).removeprefix('--')}; {REENCODE}") from error
    if turn := turn_of(picture):
        raise UserError(
            f"source {name} is to be shown {turn}, and --encoder passthrough sends it as it is coded: {REENCODE}"
        )
    if picture.interlaced_frame:
        return f"source {name} is interlaced: grounds show its combs, unless you {REENCODE}"
    if picture.color_range == ColorRange.JPEG or matrix_of(picture) in _OTHER_MATRICES:
        return f"source {name} is not BT.709 in limited range: grounds show its colours a little off"
    return ""
