"""The attachments of the two streams: the headers of access units and stills."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import ClassVar

from hvt_common.protocol.messages.envelope import Message, Nested
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
    Box,
    Int,
    ListOf,
    MapOf,
    Scalar,
    Scaled,
    Text,
    wire_field,
)

MAX_ALSO = 15
"""How many further tracks one still may name."""

_TIME = Int(0, I63)
_DELAY = Int(-I63, I63)
_FAR_PX = 32767


class Flags(IntFlag):
    """Bits of ``flags``; unknown bits are ignored."""

    KEYFRAME = 1
    """Decoding can start here."""
    PARAMETER_SETS = 2
    """VPS, SPS and PPS are inside."""
    LOCKSTEP = 4
    """Sent as fast as the parts allow: capture times are media time and say nothing about delay."""
    STORED = 8
    """Stored at the edge while the link was down, and sent afterwards."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseHeader(Message):
    """Attachment of ``base``."""

    MAX_BYTES: ClassVar[int] = 80

    session_id: int = wire_field(Int(0, U64))
    """Random, new at each start of the edge."""
    sequence: int = wire_field(Int(0, U32))
    """0, 1, 2 … for each message sent; a hole means that messages were lost."""
    frame_index: int = wire_field(Int(0, U32))
    """Index of the frame at the source rate; a frame dropped before encoding leaves a hole here only."""
    capture_ns: int = wire_field(_TIME)
    """Unix time at the source, nanoseconds of the edge's clock."""
    send_delay_ns: int = wire_field(_DELAY)
    """Send time minus ``capture_ns``."""
    flags: int = wire_field(Int(0, 255))

    @property
    def keyframe(self) -> bool:
        """True where a decoder can start."""
        return bool(self.flags & Flags.KEYFRAME)

    @property
    def send_ns(self) -> int:
        """When the edge handed the message to Zenoh, its clock."""
        return self.capture_ns + self.send_delay_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class AlsoShown:
    """A further track that a still shows."""

    track_id: int = wire_field(Int(0, U32))
    """The edge's."""
    box_source_px: tuple[float, float, float, float] = wire_field(Box(Scaled(-_FAR_PX, _FAR_PX, 8)))
    """x1, y1, x2, y2 in eighths of a pixel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoiHeader(Message):
    """Attachment of ``roi``. Boxes are x1, y1, x2, y2 in source pixels, x2 and y2 exclusive."""

    MAX_BYTES: ClassVar[int] = 1024
    MAX_PAYLOAD: ClassVar[int] = 2**20
    """The largest still, 512x512 pixels, has 768 KiB before it is coded; a ground queues hundreds."""

    session_id: int = wire_field(Int(0, U64))
    sequence: int = wire_field(Int(0, U32))
    """Of stills: 0, 1, 2 … apart from that of ``base``."""
    frame_index: int = wire_field(Int(0, U32))
    capture_ns: int = wire_field(_TIME)
    send_delay_ns: int = wire_field(_DELAY)
    flags: int = wire_field(Int(0, 255))
    track_id: int = wire_field(Int(-1, U32))
    """The edge's track; -1 where the still belongs to none."""
    box_source_px: tuple[float, float, float, float] = wire_field(Box(Scaled(-_FAR_PX, _FAR_PX, 8)))
    """The track's box at that frame, in eighths of a pixel; may reach beyond the frame."""
    crop_source_px: tuple[int, int, int, int] = wire_field(Box(Int(0, _FAR_PX), empty=False))
    """What the still shows."""
    class_name: str = wire_field(Text(64))
    confidence: float = wire_field(Scaled(0, 1, 1000))
    reason: str = wire_field(Text(48))
    """Why the method sent it."""
    codec: str = wire_field(Text(24))
    quality_pct: int = wire_field(Int(0, 100))
    parameters: Mapping[str, int | float | str] = wire_field(MapOf(Scalar(), 8, key_bytes=16))
    """What else the codec needs to be undone; empty for JPEG. ``w`` and ``h`` are the coded size where that is not
    the size of the crop."""
    also: tuple[AlsoShown, ...] = wire_field(ListOf(Nested(AlsoShown), MAX_ALSO))
    """Further tracks that the same crop shows."""

    @property
    def send_ns(self) -> int:
        """When the edge handed the message to Zenoh, its clock; media time in lockstep."""
        return self.capture_ns + self.send_delay_ns
