"""A file of every message that a ground has received, each with its time: readable after ``kill -9``.

``HVTLOG`` and two bytes for the version of the form; then records: length (4 bytes, little-endian) and CRC-32 (4
bytes, of zlib) of a MessagePack array ``[received_ns, key, encoding, attachment, payload]``. Answers to ``info`` are
among them, because nothing can be read without them. A file that has become too large stays as ``FILE-before`` until
the next one has, which begins with the last answer of each edge.
"""

from __future__ import annotations

import logging
import os
import struct
import threading
import zlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import BinaryIO

import msgpack

from hvt_common.errors import UserError, telling
from hvt_common.files import check_there, created, open_plain
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import MAX_PAYLOAD_BYTES, READ_VERSIONS, Info, WireError
from hvt_common.runtime.statistics import Newest
from hvt_common.transport.inbox import Received
from hvt_ground.sinks import SinkWriter

_log = logging.getLogger(__name__)

_MAGIC = b"HVTLOG\x00\x01"
_HEAD = struct.Struct("<II")
_MOST_BYTES = MAX_PAYLOAD_BYTES + 2**17
"""Limit of a record: the largest payload, the largest message beside it, and the names."""
_MOST_EDGES = 256
"""Whose answers are remembered; beyond, the oldest is forgotten."""
_TYPES = [int, str, str, bytes, bytes]


class MessageLog(SinkWriter[Received]):
    """Appends messages to a new file; takes the place of one of that name. `UserError` where it cannot be written.

    The file and the one before it are at most ``most_bytes`` together, or one message longer.
    """

    def __init__(self, path: Path, *, most_bytes: int) -> None:
        self.path: Path = path
        self._most_bytes = most_bytes
        self._answers: Newest[str, bytes] = Newest(_MOST_EDGES)
        """The record of the last answer to ``info``, by key."""
        self._file = _created(path)
        try:
            self.before.unlink(missing_ok=True)  # of another flight
        except OSError as error:
            self._file.close()
            raise UserError(
                f"message log {path} cannot be created: {self.before} is in the way ({error.strerror})"
            ) from None

    @property
    def before(self) -> Path:
        """The file of the older half of the messages."""
        return self.path.with_stem(f"{self.path.stem}-before")

    def log(self, item: Received) -> None:
        """Append a message, whole or not at all; one that is larger than any of ours is left out."""
        body: bytes = msgpack.packb(
            [item.received_ns, item.key, item.encoding, item.attachment, item.payload]
        )
        if len(body) > _MOST_BYTES:  # no message of ours is larger, and a reader would stop at it
            return
        record = _HEAD.pack(len(body), zlib.crc32(body)) + body
        if self._file.tell() + len(record) > self._most_bytes // 2:
            self._begin_anew()
        if item.key.endswith(f"/{Channel.INFO}") and _is_info(item.payload):
            self._answers.put(item.key, record)
        self._append(record)

    def _begin_anew(self) -> None:
        with telling(f"message log {self.path} cannot be written any further: "):
            check_there(self._file.fileno(), self.path)
            self.path.replace(self.before)
        self._file.close()
        self._file = _created(self.path)
        for answer in self._answers.values():
            self._append(answer)

    def _append(self, record: bytes) -> None:
        at = self._file.tell()
        try:
            check_there(self._file.fileno(), self.path)
            view = memoryview(record)
            while view:
                view = view[self._file.write(view) or 0 :]
        except OSError as error:
            self._file.seek(at)
            self._file.truncate()
            raise UserError(
                f"message log {self.path} cannot be written any further: {error.strerror}"
            ) from error

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        self._file.close()


def _is_info(payload: bytes) -> bool:
    # Anybody on the link may send other bytes here, and as many as a picture.
    try:
        Info.parse(payload, versions=READ_VERSIONS)
    except WireError:
        return False
    return True


def _created(path: Path) -> BinaryIO:
    with telling(f"message log {path} cannot be created: "):
        file = os.fdopen(created(path), "wb", buffering=0)
        try:
            file.write(_MAGIC)
        except OSError:
            file.close()  # or its lock would be in the way of the next try
            raise
        return file


def read_log(path: Path) -> Iterator[Received]:
    """The messages of a file, in the order in which they came, without those that are damaged.

    It ends at a record that is not whole. Raises `UserError` where it cannot be read, or is no message log.
    """
    with (
        telling(f"message log {path} cannot be read (", "): give one of hvt-ground --log"),
        open_plain(path) as file,
    ):
        if file.read(len(_MAGIC)) != _MAGIC:
            raise UserError(f"{path} is no message log of hvt-ground --log")
        read_bytes = len(_MAGIC)
        while (record := _read(file)) is not None:
            if (item := _message(*record)) is not None:
                read_bytes += _HEAD.size + len(record[1])
                yield item
        if left := os.fstat(file.fileno()).st_size - read_bytes:
            _say_broken(path, left)


@cache
def _say_broken(path: Path, left: int) -> None:
    # Once: a replay reads its files several times.
    _log.warning("message log %s breaks off or is damaged: %d bytes of it are left out", path, left)


def _read(file: BinaryIO) -> tuple[int, bytes] | None:
    # The checksum and content of a record.
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    length, checksum = _HEAD.unpack(head)
    body = file.read(length) if length <= _MOST_BYTES else b""
    return (checksum, body) if body and len(body) == length else None


def _message(checksum: int, body: bytes) -> Received | None:
    if zlib.crc32(body) != checksum:
        return None
    try:
        values = msgpack.unpackb(body, max_ext_len=0)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        return None
    if type(values) is not list or [type(one) for one in values] != _TYPES:
        return None
    received_ns, key, encoding, attachment, payload = values
    return Received(key, payload, attachment, encoding, received_ns)
