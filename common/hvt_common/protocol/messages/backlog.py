"""Store-and-forward: objects that an edge stored while its link was down, sent on ``backlog`` in chunks.

An object is a still, a segment of the base stream, or the `Info` of the session that both belong to. It crosses in
chunks, in order, as the budget allows; the ground acknowledges ranges in `Feedback.backlog`. A restart of either side
or a second outage costs no more than the chunk in flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import Any, ClassVar, TypeVar

import msgpack

from hvt_common.protocol.channels import MAX_PAYLOAD_BYTES
from hvt_common.protocol.messages.envelope import Message, from_values, kinds, unpacked
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
    Blob,
    Flag,
    Int,
    OneOf,
    Text,
    WireError,
    wire_field,
)
from hvt_common.protocol.messages.stream import RoiHeader

MAX_BACKLOG_BYTES = MAX_PAYLOAD_BYTES
"""Limit of one object: ten seconds of video at 3 Mbps."""
MAX_ACKNOWLEDGED_RANGES = 16
_MAX_UNITS = 2400
_MAX_HEADER_BYTES = 1024
_MAX_ENCODING_BYTES = 64
_SIZE = Int(1, MAX_BACKLOG_BYTES)

_T = TypeVar("_T")
ObjectKey = tuple[int, str, int]
"""Session, kind and number: an object's key on the link."""


class BacklogKind(StrEnum):
    """The kind of an object."""

    INFO = "info"
    """`Info` of the session, as its edge would have answered; number 0."""
    STILL = "still"
    """`BacklogStill`; its number is the still's sequence."""
    BASE = "base"
    """A run of `BacklogUnit`; its number is the frame index of the first."""


_KIND = OneOf(tuple(BacklogKind))


@dataclass(frozen=True, slots=True, kw_only=True)
class _OfObject:
    session_id: int = wire_field(Int(0, U64))
    """In which it was captured: the current one, or one of an earlier start of the edge."""
    kind: str = wire_field(_KIND)
    """A `BacklogKind`."""
    number: int = wire_field(Int(0, U32))

    @property
    def key(self) -> ObjectKey:
        return self.session_id, self.kind, self.number


@dataclass(frozen=True, slots=True, kw_only=True)
class BacklogHeader(_OfObject, Message):
    """Attachment of ``backlog``; the payload is one chunk of the object."""

    MAX_BYTES: ClassVar[int] = 80

    offset: int = wire_field(Int(0, MAX_BACKLOG_BYTES))
    """Where the chunk begins in the object, bytes."""
    total_bytes: int = wire_field(_SIZE)
    send_ns: int = wire_field(Int(0, I63))
    """When the chunk was handed to Zenoh, the edge's clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AcknowledgedRange(_OfObject):
    """The bytes of an object that a ground holds, contiguous from its beginning."""

    acknowledged_bytes: int = wire_field(Int(0, MAX_BACKLOG_BYTES))
    """The whole object: the edge may delete it. Less than before: send again from there."""


@dataclass(frozen=True, slots=True)
class BacklogStill:
    """A stored still: its message on ``roi``."""

    attachment: bytes = wire_field(Blob(_MAX_HEADER_BYTES))
    """A `RoiHeader` with the flag `STORED`, with the checksum of ``payload``."""
    encoding: str = wire_field(Text(_MAX_ENCODING_BYTES))
    """Zenoh's encoding: the media type."""
    payload: bytes = wire_field(Blob(RoiHeader.MAX_PAYLOAD, least=1))


@dataclass(frozen=True, slots=True)
class BacklogUnit:
    """One stored access unit."""

    frame_index: int = wire_field(Int(0, U32))
    capture_ns: int = wire_field(Int(0, I63))
    keyframe: bool = wire_field(Flag())
    data: bytes = wire_field(Blob(MAX_BACKLOG_BYTES, least=1))
    """HEVC, Annex B."""


def pack_backlog_still(still: BacklogStill) -> bytes:
    packed: bytes = msgpack.packb([still.attachment, still.encoding, still.payload])
    return packed


def parse_backlog_still(data: bytes) -> BacklogStill:
    """Unpack; raises `WireError` and nothing else, for any bytes. The attachment is not parsed."""
    return _exact(BacklogStill, _unpack(data, "a stored still"))


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
    units = tuple(_exact(BacklogUnit, row) for row in rows)
    for before, unit in pairwise(units):
        if unit.frame_index <= before.frame_index or unit.capture_ns <= before.capture_ns:
            raise WireError("stored video whose frames are not in order")
    return units


def _exact(kind: type[_T], values: Any) -> _T:
    # Objects are as they were stored: no field came later, and none is missing.
    if type(values) is not list or len(values) != len(kinds(kind)):
        raise WireError(f"a {kind.__name__} that is not an array of {len(kinds(kind))}")
    return from_values(kind, values)


def _unpack(data: bytes, name: str) -> list[Any]:
    if len(data) > MAX_BACKLOG_BYTES:
        raise WireError(f"{name} of {len(data)} bytes is longer than {MAX_BACKLOG_BYTES}")
    return unpacked(data, name)
