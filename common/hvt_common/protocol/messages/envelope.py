"""A message as bytes: a MessagePack array that begins with the schema version and ends with a CRC-32.

``[version, field, field, …, crc]``. Later minor versions add fields behind the last one: a reader skips those that it
does not know, and takes those that are missing, from an earlier sender, at their defaults.

The CRC is always the last five bytes (``0xce`` and a big-endian uint32). It is
CRC-32 as zlib, PNG and Ethernet have it (reflected polynomial 0xEDB88320, start and final inversion) over the Zenoh
payload, if the message is its attachment, followed by the array's bytes up to the CRC's own five. So one flipped
bit in either is always noticed.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import islice
from typing import Any, ClassVar, Self, TypeVar

import msgpack

from hvt_common.protocol.channels import MAX_PAYLOAD_BYTES
from hvt_common.protocol.messages.fields import Kind, WireError

WIRE_VERSION = 5
"""That of every message that is sent."""
SPOKEN_VERSIONS = (5,)
"""Versions of messages that are taken from the link."""
READ_VERSIONS = (4, 5)
"""Versions of stored messages that are read: in logs, in recordings, and on an edge's disk."""
MOST_VERSION = 255
MOST_UNKNOWN_FIELDS = 16
"""Up to this many fields behind the last known one are skipped, in each array; more are no message of ours."""
DEEPEST = 8
"""Levels of arrays and maps, the message's own array counted."""

_CRC_BYTES = 5
_CRC_TAG = 0xCE
_HEAD_BYTES = 32
"""The array's head, the version, and the two that a message on ``info`` begins with."""

_T = TypeVar("_T")


class UnknownVersionError(WireError):
    """The message is of another schema version: count it apart, warn once, skip it."""

    def __init__(
        self, message: str, version: int, *, read: Sequence[int], spoken: tuple[int, int] | None = None
    ) -> None:
        self._lowest, self._highest = spoken or (version, version)
        self.in_common = any(self._lowest <= one <= self._highest for one in read)
        """The sender also speaks one that is read."""
        self._read = " and ".join(map(str, read))
        known = f"{self._read} are" if len(read) > 1 else f"{self._read} is"
        super().__init__(f"{message} has schema version {version}, only {known} known here")

    def between(self, sender: str, reader: str) -> str:
        """The remedy, as one sentence."""
        low, high = self._lowest, self._highest
        older = reader if high > WIRE_VERSION else sender
        spoken = f"version {low}" if low == high else f"versions {low} to {high}"
        return f"{sender} speaks wire {spoken}, {reader} reads {self._read}: update {older}"


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
    TRIMMED: ClassVar[bool] = False
    """Fields at the end that have their defaults are left out."""
    NEGOTIATES: ClassVar[bool] = False
    """From version 5 on it begins with the lowest and the highest version that its sender speaks."""

    def on_wire(self) -> Message:
        """The message whose fields are sent."""
        return self

    @classmethod
    def of_version(cls, version: int, values: list[Any]) -> Self:
        """The message from the field values of that version."""
        return from_values(cls, values, version)

    def pack(self, payload: bytes = b"") -> bytes:
        """The message as bytes; ``payload`` is the Zenoh payload that it will be attached to, if any.

        Raises ValueError when a field is out of its bounds or the whole longer than ``MAX_BYTES``.
        """
        return PackedMessage.of(self).pack(payload)

    @classmethod
    def parse(cls, data: bytes, payload: bytes = b"", *, versions: Sequence[int] = SPOKEN_VERSIONS) -> Self:
        """The message that ``data`` holds and that fits ``payload``; ``versions`` are those that are read.

        Raises UnknownVersionError, CorruptError or another WireError, and nothing else, for any bytes whatever.
        """
        name = cls.__name__
        version, spoken = _versions(data, name, negotiates=cls.NEGOTIATES)
        if version not in versions or not spoken[0] <= version <= spoken[1]:
            raise UnknownVersionError(name, version, read=versions, spoken=spoken)
        if len(data) > cls.MAX_BYTES:
            raise WireError(f"{name} of {len(data)} bytes is longer than {cls.MAX_BYTES}")
        if len(payload) > cls.MAX_PAYLOAD:
            raise WireError(f"payload of {len(payload)} bytes is longer than {cls.MAX_PAYLOAD}")
        array = unpacked(data, name)
        if len(data) <= _CRC_BYTES or data[-_CRC_BYTES] != _CRC_TAG:
            raise WireError(f"{name} does not end with its checksum")
        if array[-1] != _checksum(data[:-_CRC_BYTES], payload):
            raise CorruptError(f"{name} or its payload is not what was sent: checksum differs")
        return cls.of_version(version, array[1:-1])


@dataclass(frozen=True, slots=True)
class PackedMessage:
    """A message whose fields are packed once, for sending at any time: `with_fields` packs only changed fields."""

    message: type[Message]
    fields: Mapping[str, bytes]
    """By name, in the order of the wire."""

    @classmethod
    def of(cls, message: Message) -> PackedMessage:
        """Raises ValueError when a field is out of its bounds."""
        sent = message.on_wire()
        table = kinds(type(sent))
        return cls(type(sent), {name: _packed(kind.encode(getattr(sent, name))) for name, kind in table})

    def with_fields(self, **values: Any) -> PackedMessage:
        """The same message with other values of these fields; rules over two fields are not checked."""
        table = dict(kinds(self.message))
        changed = {name: _packed(table[name].encode(value)) for name, value in values.items()}
        return replace(self, fields={**self.fields, **changed})

    @property
    def size_bytes(self) -> int:
        """The size of `pack`'s bytes, whatever the payload."""
        return len(self._body()) + _CRC_BYTES

    def pack(self, payload: bytes = b"") -> bytes:
        body, message = self._body(), self.message
        if len(body) + _CRC_BYTES > message.MAX_BYTES or len(payload) > message.MAX_PAYLOAD:
            raise ValueError(
                f"{message.__name__} of {len(body) + _CRC_BYTES} bytes or its payload is too long"
            )
        return body + bytes((_CRC_TAG,)) + _checksum(body, payload).to_bytes(4, "big")

    def _body(self) -> bytes:
        values = list(self.fields.values())
        if self.message.TRIMMED:
            kind: type = self.message
            defaults = _packed_defaults(kind)
            while values and values[-1] == defaults.get(len(values)):
                values.pop()
        head: bytes = msgpack.Packer().pack_array_header(len(values) + 2)
        return b"".join((head, _packed(WIRE_VERSION), *values))


@cache
def _packed_defaults(message: type) -> dict[int, bytes]:
    # By the number of the field, of those that may be left out.
    return {
        number: _packed(item.metadata["wire"].encode(item.metadata["default"]))
        for number, item in enumerate(fields(message), 1)
        if item.metadata["optional"]
    }


@dataclass(frozen=True, slots=True)
class Nested(Kind):
    """A field that holds another dataclass of `wire_field` fields, as an array without version and checksum."""

    of: type

    def _encode(self, value: Any) -> Any:
        return [kind.encode(getattr(value, name)) for name, kind in kinds(self.of)]

    def decode(self, raw: Any) -> Any:
        if type(raw) is not list:
            raise WireError(f"{type(raw).__name__} in place of a {self.of.__name__}")
        return from_values(self.of, raw)

    def schema(self) -> dict[str, Any]:
        return {"type": "nested", "of": self.of.__name__}


def _packed(value: Any) -> bytes:
    packed: bytes = msgpack.packb(value)
    return packed


def _versions(data: bytes, name: str, *, negotiates: bool) -> tuple[int, tuple[int, int]]:
    # Of a message, and of its sender: all else may be other in another version.
    head = msgpack.Unpacker()
    head.feed(data[:_HEAD_BYTES])
    found: list[Any] = []
    with suppress(ValueError, msgpack.UnpackException):
        head.read_array_header()
        found.extend(islice(head, 3))
    if not found or type(found[0]) is not int:
        raise WireError(f"{name} is not an array that begins with a version")
    version = found[0]
    bounds = [one for one in found[1:] if type(one) is int and 1 <= one <= MOST_VERSION]
    if negotiates and version >= WIRE_VERSION and len(bounds) == 2:
        return version, (bounds[0], bounds[1])
    return version, (version, version)


def unpacked(data: bytes, name: str) -> list[Any]:
    """MessagePack of one array without extensions, each key of a map once; `WireError` for all else."""
    try:
        array = msgpack.unpackb(
            data, strict_map_key=True, max_ext_len=0, ext_hook=_extension, object_pairs_hook=_once
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        reason = str(error).strip() or type(error).__name__
        raise WireError(f"{name} is not MessagePack: {reason:.80}") from None
    if type(array) is not list:
        raise WireError(f"{name} is not an array")
    if _too_deep(array, DEEPEST):
        raise WireError(f"{name} is nested more than {DEEPEST} deep")
    return array


def _extension(code: int, _data: bytes) -> None:
    raise ValueError(f"an extension of type {code}")


def _once(pairs: list[tuple[str | bytes, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("a map names a key twice")
    if any(type(key) is not str for key in found):
        raise ValueError("a map has a key that is no text")
    return found  # type: ignore[return-value]


def from_values(message: type[_T], values: list[Any], version: int = WIRE_VERSION) -> _T:
    """A dataclass of `wire_field` fields from the values of its array; raises `WireError`."""
    of: type = message
    table, least, before = _layout(of, version)
    most = len(table) + MOST_UNKNOWN_FIELDS
    if not least <= len(values) <= most:
        raise WireError(f"{message.__name__} has {len(values)} fields, not {least} to {most}")
    decoded = dict(before)
    for (name, kind), raw in zip(table, values, strict=False):
        try:
            decoded[name] = kind.decode(raw)
        except WireError as error:
            raise WireError(f"{message.__name__}.{name}: {error}") from None
    return message(**decoded)


def _too_deep(value: Any, levels: int) -> bool:
    if type(value) not in (list, dict):
        return False
    within = value if type(value) is list else value.values()
    return levels == 0 or any(_too_deep(one, levels - 1) for one in within)


@cache
def _layout(message: type, version: int) -> tuple[tuple[tuple[str, Kind], ...], int, Mapping[str, Any]]:
    # Of a version: its fields, the number of required ones, and the values of fields that came later.
    there = [item for item in fields(message) if item.metadata["since"] <= version]
    later = {item.name: item.metadata["before"] for item in fields(message) if item not in there}
    table = tuple((item.name, item.metadata["wire"]) for item in there)
    return table, sum(not item.metadata["optional"] for item in there), later


def _checksum(body: bytes, payload: bytes) -> int:
    return zlib.crc32(body, zlib.crc32(payload))
