"""Store-and-forward: objects that an edge stored while its link was down, sent on ``backlog`` in chunks.

An object is a still, a segment of the base stream, or the `Info` of the session that both belong to. It crosses in
chunks, in order, as the budget allows; the ground acknowledges ranges in `Feedback.backlog`. A restart of either side
or a second outage costs no more than the chunk in flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any, ClassVar

import msgpack

from hvt_common.protocol.messages.envelope import MAX_PAYLOAD_BYTES, Message
from hvt_common.protocol.messages.fields import I63, U32, U64, Int, OneOf, WireError, wire_field

__all__ = [
    "MAX_ACKNOWLEDGED_RANGES",
    "MAX_BACKLOG_BYTES",
    "AcknowledgedRange",
    "BacklogHeader",
    "BacklogKind",
    "BacklogStill",
    "BacklogUnit",
    "ObjectKey",
    "pack_backlog_still",
    "pack_backlog_units",
    "parse_backlog_still",
    "parse_backlog_units",
]

MAX_BACKLOG_BYTES = MAX_PAYLOAD_BYTES
"""Of one object: ten seconds of video at 3 Mbps."""
MAX_ACKNOWLEDGED_RANGES = 16
_MAX_UNITS = 2400
_MAX_HEADER_BYTES = 1024
_MAX_ENCODING_BYTES = 64
_SIZE = Int(1, MAX_BACKLOG_BYTES)


ObjectKey = tuple[int, str, int]
"""Session, kind and number: what an object is called on the link."""


class BacklogKind(StrEnum):
    """What an object is."""

    INFO = "info"
    """`Info` of the session, as its edge would have answered; number 0."""
    STILL = "still"
    """`BacklogStill`; its number is the still's sequence."""
    BASE = "base"
    """A run of `BacklogUnit`; its number is the frame index of the first."""


_KIND = OneOf(tuple(BacklogKind))


@dataclass(frozen=True, slots=True, kw_only=True)
class BacklogHeader(Message):
    """Attachment of ``backlog``; the payload is one chunk of the object."""

    MAX_BYTES: ClassVar[int] = 80

    session_id: int = wire_field(Int(0, U64))
    """In which it was captured: the current one, or one of an earlier start of the edge."""
    kind: str = wire_field(_KIND)
    """A `BacklogKind`."""
    number: int = wire_field(Int(0, U32))
    offset: int = wire_field(Int(0, MAX_BACKLOG_BYTES))
    """Where the chunk begins in the object, bytes."""
    total_bytes: int = wire_field(_SIZE)
    """Of the object."""
    send_ns: int = wire_field(Int(0, I63))
    """When the chunk was handed to Zenoh, the edge's clock."""

    @property
    def key(self) -> ObjectKey:
        """Of the object."""
        return self.session_id, self.kind, self.number


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgedRange:
    """How much of an object a ground holds, contiguous from its beginning."""

    session_id: int = wire_field(Int(0, U64))
    kind: str = wire_field(_KIND)
    number: int = wire_field(Int(0, U32))
    acknowledged_bytes: int = wire_field(Int(0, MAX_BACKLOG_BYTES))
    """The whole object: the edge may delete it. Less than before: send again from there."""

    @property
    def key(self) -> ObjectKey:
        """Of the object."""
        return self.session_id, self.kind, self.number


@dataclass(frozen=True, slots=True)
class BacklogStill:
    """A stored still: what would have crossed on ``roi``."""

    attachment: bytes
    """A `RoiHeader` with the flag `STORED`, sealed over ``payload``."""
    encoding: str
    """Of Zenoh: the media type."""
    payload: bytes


@dataclass(frozen=True, slots=True)
class BacklogUnit:
    """One stored access unit."""

    frame_index: int
    capture_ns: int
    keyframe: bool
    data: bytes
    """HEVC, Annex B."""


def pack_backlog_still(still: BacklogStill) -> bytes:
    """The object's bytes."""
    packed: bytes = msgpack.packb([still.attachment, still.encoding, still.payload])
    return packed


def parse_backlog_still(data: bytes) -> BacklogStill:
    """Unpack; raises `WireError` and nothing else, for any bytes. The attachment is not parsed."""
    values = _unpack(data, "a stored still")
    if len(values) != 3 or [type(value) for value in values] != [bytes, str, bytes]:
        raise WireError("a stored still is not an attachment, an encoding and a payload")
    attachment, encoding, payload = values
    if len(attachment) > _MAX_HEADER_BYTES or len(encoding) > _MAX_ENCODING_BYTES or not payload:
        raise WireError("a stored still has an attachment or encoding that is too long, or no payload")
    return BacklogStill(attachment, encoding, payload)


def pack_backlog_units(units: Sequence[BacklogUnit]) -> bytes:
    """The object's bytes; ``units`` are in the order of capture."""
    packed: bytes = msgpack.packb(
        [[unit.frame_index, unit.capture_ns, unit.keyframe, unit.data] for unit in units]
    )
    return packed


def parse_backlog_units(data: bytes) -> tuple[BacklogUnit, ...]:
    """Unpack, in the order of capture; raises `WireError` and nothing else, for any bytes."""
    rows = _unpack(data, "stored video")
    if not 1 <= len(rows) <= _MAX_UNITS:
        raise WireError(f"stored video of {len(rows)} frames: 1 to {_MAX_UNITS} are accepted")
    units = tuple(_unit(row) for row in rows)
    for before, unit in pairwise(units):
        if unit.frame_index <= before.frame_index or unit.capture_ns <= before.capture_ns:
            raise WireError("stored video whose frames are not in order")
    return units


def _unit(row: Any) -> BacklogUnit:
    if type(row) is not list or [type(value) for value in row] != [int, int, bool, bytes]:
        raise WireError("stored video with a frame that is not an index, a time, a flag and bytes")
    frame_index, capture_ns, keyframe, data = row
    if not (0 <= frame_index <= U32 and 0 <= capture_ns <= I63 and data):
        raise WireError("stored video with an index or a time out of bounds, or an empty frame")
    return BacklogUnit(frame_index, capture_ns, keyframe, data)


def _unpack(data: bytes, name: str) -> list[Any]:
    if len(data) > MAX_BACKLOG_BYTES:
        raise WireError(f"{name} of {len(data)} bytes is longer than {MAX_BACKLOG_BYTES}")
    try:
        values = msgpack.unpackb(data, raw=False, strict_map_key=True, use_list=True, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(
            f"{name} is not MessagePack: {str(error).strip() or type(error).__name__:.80}"
        ) from None
    if type(values) is not list:
        raise WireError(f"{name} is not an array")
    return values
