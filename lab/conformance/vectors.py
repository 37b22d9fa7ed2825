"""``PYTHONPATH=.:tests/support python -m lab.conformance.vectors``: write docs/conformance/ from the code.

Nothing is drawn by chance: the same code gives the same files, and a test compares them.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import msgpack

from hvt_common.protocol.messages import (
    BacklogStill,
    BacklogUnit,
    BaseHeader,
    Flags,
    Message,
    RoiHeader,
    WireError,
    kinds,
    pack_backlog_still,
    pack_backlog_units,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.protocol.messages.envelope import MOST_UNKNOWN_FIELDS, READ_VERSIONS, WIRE_VERSION
from hvt_common.protocol.messages.fields import Int
from lab.conformance.sessions import poses, track_steps
from rigs.messages import EXAMPLES, ROI

__all__ = ["FOLDER", "files", "main"]

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "conformance"
_PAYLOADS: Mapping[type[Message], bytes] = {BaseHeader: b"an access unit", RoiHeader: b"a still"}
_WITH_NESTED = {"RoiHeader": ("also", 16), "ControlAnswer": ("tracks", 6), "Feedback": ("stills", 19)}
"""A field that holds nested arrays, and its place."""
_EXACT = 2**53 - 1
"""Beyond it a number of JSON is not exact everywhere, and stands as text."""


def files() -> dict[str, str]:
    """The text of each file, by name."""
    content = {
        "messages.json": list(_messages()),
        "refused.json": list(_refused()),
        "objects.json": list(_objects()),
        "track-steps.json": list(track_steps()),
        "poses.json": list(poses()),
    }
    # A vector a line: a change shows which.
    return {
        name: "[\n" + ",\n".join(json.dumps(one, ensure_ascii=True) for one in vectors) + "\n]\n"
        for name, vectors in content.items()
    }


def main() -> int:
    """Write all of them."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in files().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
        print(f"{FOLDER / name}: {text.count(chr(10)) - 2} vectors")
    return 0


# Messages that are to be read


def _messages() -> Iterator[dict[str, Any]]:
    for message in EXAMPLES:
        yield _vector(message, "an example")
        for name, kind in kinds(type(message)):
            if isinstance(kind, Int):
                for bound in (kind.low, kind.high):
                    yield _vector(replace(message, **{name: bound}), f"{name} at its bound")
        yield from _of_other_minors(message)


def _of_other_minors(message: Message) -> Iterator[dict[str, Any]]:
    """From a sender that knows more fields than we do, or fewer."""
    payload = _PAYLOADS.get(type(message), b"")
    values = msgpack.unpackb(message.pack(payload))[:-1]
    left_bytes = type(message).MAX_BYTES - len(message.pack(payload))
    for what, unknown in (
        ("one unknown field behind its own", [0]),
        ("unknown fields of every type", [None, True, -1, 1.5, "new", b"new", [1, [2]], {"new": 1}]),
        ("as many unknown fields as are skipped", [0] * MOST_UNKNOWN_FIELDS),
    ):
        if len(b"".join(map(msgpack.packb, unknown))) + 2 <= left_bytes:
            yield _vector(message, what, _packed([*values, *unknown], payload))
    if type(message).__name__ in _WITH_NESTED:
        name, place = _WITH_NESTED[type(message).__name__]
        nested = [[*one, 7] for one in values[place]]
        longer = [*values[:place], nested, *values[place + 1 :]]
        yield _vector(message, f"an unknown field in each of {name}", _packed(longer, payload))
    optional = sum(item.default is not MISSING for item in fields(type(message)))
    for version in READ_VERSIONS if optional else (WIRE_VERSION - 1,):
        older = [version, *values[1 : len(values) - optional]]
        what = f"version {version}" + (" without what was added since" if optional else "")
        defaults = {item.name: item.default for item in fields(type(message)) if item.default is not MISSING}
        yield _vector(replace(message, **defaults), what, _packed(older, payload))


def _vector(message: Message, what: str, data: bytes | None = None) -> dict[str, Any]:
    """``data`` is the message in another form, of the same fields."""
    payload = _PAYLOADS.get(type(message), b"")
    if data is not None:
        assert type(message).parse(data, payload) == type(message).parse(message.pack(payload), payload), what
    return {
        "message": type(message).__name__,
        "what": what,
        "hex": (message.pack(payload) if data is None else data).hex(),
        "payload": payload.hex(),
        "fields": _plain(msgpack.unpackb(message.pack(payload))[1:-1]),
    }


def _plain(value: Any) -> Any:
    """As JSON can hold it: bytes as ``{"hex": …}``, whole numbers beyond 2^53 as text."""
    match value:
        case bool() | str() | float() | None:
            return value
        case int():
            return value if abs(value) <= _EXACT else str(value)
        case bytes():
            return {"hex": value.hex()}
        case dict():
            return {key: _plain(one) for key, one in value.items()}
    return [_plain(one) for one in value]


# Messages that are not


def _refused() -> Iterator[dict[str, Any]]:
    """What is damaged, of another version, or out of bounds, each with a checksum that fits unless that is it."""
    for message in EXAMPLES:
        payload = _PAYLOADS.get(type(message), b"")
        good = message.pack(payload)
        values = msgpack.unpackb(good)[:-1]
        yield _bad(message, "a bit is flipped", bytes((*good[:-7], good[-7] ^ 1, *good[-6:])), payload)
        yield _bad(message, "its end is missing", good[:-1], payload)
        yield _bad(message, "a byte follows", good + b"\0", payload)
        yield _bad(message, "the checksum is of another payload", good, payload + b"!")
        yield _bad(
            message,
            "an older version",
            _packed([READ_VERSIONS[0] - 1, *values[1:]], payload),
            payload,
            version=True,
        )
        yield _bad(
            message,
            "a newer version",
            _packed([WIRE_VERSION + 1, *values[1:]], payload),
            payload,
            version=True,
        )
        unknown = [0] * (MOST_UNKNOWN_FIELDS + 1)
        yield _bad(
            message, "more unknown fields than are skipped", _packed([*values, *unknown], payload), payload
        )
        optional = sum(item.default is not MISSING for item in fields(type(message)))
        yield _bad(
            message, "a field too few", _packed(values[: len(values) - optional - 1], payload), payload
        )
        for place, (name, kind) in enumerate(kinds(type(message)), 1):
            for wrong, what in _wrong(kind):
                changed = [*values[:place], wrong, *values[place + 1 :]]
                yield _bad(message, f"{name} {what}", _packed(changed, payload), payload)


def _wrong(kind: Any) -> Iterator[tuple[Any, str]]:
    """Values that a kind of field refuses, as far as MessagePack can hold them."""
    for value, what in (
        (None, "is nothing"),
        (1.5, "is a fraction"),
        ("\x07", "is a text with a control character"),
        ([], "is an empty array"),
        (2**64 - 1, "is far above all"),
    ):
        try:
            kind.decode(value)
        except WireError:
            yield value, what
    if isinstance(kind, Int):
        for value, what in (
            (kind.low - 1, "is just below its bound"),
            (kind.high + 1, "is just above its bound"),
        ):
            if -(2**63) <= value < 2**64:
                yield value, what


def _bad(
    message: Message, what: str, data: bytes, payload: bytes, *, version: bool = False
) -> dict[str, Any]:
    try:
        type(message).parse(data, payload)
    except WireError:
        return {
            "message": type(message).__name__,
            "what": what,
            "hex": data.hex(),
            "payload": payload.hex(),
            "version": version,
        }
    raise AssertionError(f"{type(message).__name__} is read although {what}")


def _packed(values: list[Any], payload: bytes) -> bytes:
    """The array with a checksum that fits."""
    body = msgpack.Packer().pack_array_header(len(values) + 1) + b"".join(map(msgpack.packb, values))
    return bytes(body) + b"\xce" + zlib.crc32(body, zlib.crc32(payload)).to_bytes(4, "big")


# Objects of the backlog


def _objects() -> Iterator[dict[str, Any]]:
    header = replace(ROI, flags=int(Flags.STORED))
    still = BacklogStill(header.pack(b"a still"), "image/jpeg", b"a still")
    units = [
        BacklogUnit(7, 1_000, keyframe=True, data=b"first"),
        BacklogUnit(9, 1_200, keyframe=False, data=b"second"),
    ]
    for kind, data in (("still", pack_backlog_still(still)), ("base", pack_backlog_units(units))):
        yield {"kind": kind, "what": "an example", "hex": data.hex(), "values": _plain(msgpack.unpackb(data))}
        for what, wrong in (
            ("its end is missing", data[:-1]),
            ("a byte follows", data + b"\0"),
            ("is empty", b""),
        ):
            yield _bad_object(kind, what, wrong)
    rows = [[7, 1_000, True, b"first"], [9, 1_200, False, b"second"]]
    for what, changed in (
        ("no frame at all", []),
        ("frames are not in order", rows[::-1]),
        ("times are not in order", [rows[0], [9, 1_000, False, b"second"]]),
        ("a frame is empty", [[7, 1_000, True, b""]]),
        ("a flag is a number", [[7, 1_000, 1, b"first"]]),
        ("an index is below zero", [[-1, 1_000, True, b"first"]]),
    ):
        yield _bad_object("base", what, msgpack.packb(changed))
    yield _bad_object("still", "there is no still", msgpack.packb([still.attachment, "image/jpeg", b""]))
    yield _bad_object(
        "still", "the encoding is bytes", msgpack.packb([still.attachment, b"jpeg", b"a still"])
    )


def _bad_object(kind: str, what: str, data: bytes) -> dict[str, Any]:
    try:
        (parse_backlog_still if kind == "still" else parse_backlog_units)(data)
    except WireError:
        return {"kind": kind, "what": what, "hex": data.hex()}
    raise AssertionError(f"the object {kind} is read although {what}")


if __name__ == "__main__":
    sys.exit(main())
