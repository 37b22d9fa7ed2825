"""A message as bytes: a MessagePack array that begins with the schema version and ends with a CRC-32.

``[version, field, field, …, crc]``. The CRC is always the last five bytes (``0xce`` and a big-endian uint32). It is
CRC-32 as zlib, PNG and Ethernet have it (reflected polynomial 0xEDB88320, start and final inversion) over the Zenoh
payload, if the message is its attachment, followed by the array's bytes up to the CRC's own five. So one flipped
bit in either is always noticed.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self, TypeVar

import msgpack

from hvt_common.protocol.messages.fields import Kind, WireError

__all__ = [
    "MAX_PAYLOAD_BYTES",
    "WIRE_VERSION",
    "CorruptError",
    "Message",
    "Nested",
    "UnknownVersionError",
    "kinds",
]

WIRE_VERSION = 3
MAX_PAYLOAD_BYTES = 4 * 2**20
"""No access unit and no still is larger; a larger payload is refused unread."""

_CRC_BYTES = 5
_CRC_TAG = 0xCE

_T = TypeVar("_T")


class UnknownVersionError(WireError):
    """The message is of another schema version: count it apart, warn once, skip it."""


class CorruptError(WireError):
    """The checksum does not fit: bytes changed on the way, or the payload belongs to another message."""


def kinds(message: type) -> tuple[tuple[str, Kind], ...]:
    """Name and kind of every field of a message type, in the order of the wire."""
    return tuple((item.name, item.metadata["wire"]) for item in fields(message))


class Message:
    """Base of every message: a frozen dataclass whose fields are all `wire_field`."""

    __slots__ = ()
    MAX_BYTES: ClassVar[int] = 1024
    MAX_PAYLOAD: ClassVar[int] = MAX_PAYLOAD_BYTES
    """Bytes of the payload that it may be attached to."""

    def pack(self, payload: bytes = b"") -> bytes:
        """The message as bytes; ``payload`` is the Zenoh payload that it will be attached to, if any.

        Raises ValueError when a field is out of its bounds or the whole longer than ``MAX_BYTES``.
        """
        values = [kind.encode(getattr(self, name)) for name, kind in kinds(type(self))]
        packed: bytes = msgpack.packb([WIRE_VERSION, *values, 2**32 - 1])
        body = packed[:-_CRC_BYTES]
        if len(packed) > self.MAX_BYTES or len(payload) > self.MAX_PAYLOAD:
            raise ValueError(f"{type(self).__name__} of {len(packed)} bytes or its payload is too long")
        return body + bytes((_CRC_TAG,)) + _checksum(body, payload).to_bytes(4, "big")

    @classmethod
    def parse(cls, data: bytes, payload: bytes = b"") -> Self:
        """The message that ``data`` holds and that fits ``payload``.

        Raises UnknownVersionError, CorruptError or another WireError, and nothing else, for any bytes whatever.
        """
        name = cls.__name__
        if len(data) > cls.MAX_BYTES:
            raise WireError(f"{name} of {len(data)} bytes is longer than {cls.MAX_BYTES}")
        if len(payload) > cls.MAX_PAYLOAD:
            raise WireError(f"payload of {len(payload)} bytes is longer than {cls.MAX_PAYLOAD}")
        array = _unpack(data, name)
        if len(data) <= _CRC_BYTES or data[-_CRC_BYTES] != _CRC_TAG:
            raise WireError(f"{name} does not end with its checksum")
        if array[-1] != _checksum(data[:-_CRC_BYTES], payload):
            raise CorruptError(f"{name} or its payload is not what was sent: checksum differs")
        return _from_values(cls, array[1:-1])


@dataclass(frozen=True, slots=True)
class Nested(Kind):
    """A field that holds another dataclass of `wire_field` fields, as an array without version and checksum."""

    of: type

    def _encode(self, value: Any) -> Any:
        return [kind.encode(getattr(value, name)) for name, kind in kinds(self.of)]

    def decode(self, raw: Any) -> Any:
        if type(raw) is not list:
            raise WireError(f"{type(raw).__name__} in place of a {self.of.__name__}")
        return _from_values(self.of, raw)

    def describe(self) -> str:
        return self.of.__name__


def _unpack(data: bytes, name: str) -> list[Any]:
    """The array in ``data``, its version checked. Sizes inside are bounded by the length of ``data`` itself."""
    try:
        array = msgpack.unpackb(data, raw=False, strict_map_key=True, use_list=True, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        reason = str(error).strip() or type(error).__name__
        raise WireError(f"{name} is not MessagePack: {reason:.80}") from None
    if type(array) is not list or not array or type(array[0]) is not int:
        raise WireError(f"{name} is not an array that begins with a version")
    if array[0] != WIRE_VERSION:
        raise UnknownVersionError(f"{name} has schema version {array[0]}, only {WIRE_VERSION} is known here")
    return array


def _from_values(message: type[_T], values: list[Any]) -> _T:
    table = kinds(message)
    if len(values) != len(table):
        raise WireError(f"{message.__name__} has {len(values)} fields in place of {len(table)}")
    decoded = {}
    for (name, kind), raw in zip(table, values, strict=True):
        try:
            decoded[name] = kind.decode(raw)
        except WireError as error:
            raise WireError(f"{message.__name__}.{name}: {error}") from None
    try:
        return message(**decoded)
    except ValueError as error:
        raise WireError(f"{message.__name__}: {error}") from None


def _checksum(body: bytes, payload: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(payload))
