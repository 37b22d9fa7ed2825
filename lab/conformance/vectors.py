"""``PYTHONPATH=.:tests/support python -m lab.conformance.vectors``: write docs/conformance/ from the code.

Nothing is drawn by chance: the same code gives the same files, and a test compares them.
"""

import json
import math
import struct
import sys
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import msgpack

from hvt_common.protocol import messages as wire
from hvt_common.protocol.messages.envelope import DEEPEST, MOST_UNKNOWN_FIELDS, WIRE_VERSION
from hvt_ground.backlog.assembly import backlog_content
from lab.conformance.dialogues import backlog_dialogues, base_orders, report_traces, still_sizes
from lab.conformance.schema import PATH, name_of, schema
from lab.conformance.sessions import poses, track_steps
from lab.conformance.stills import still_cases
from rigs.messages import BASE, EXAMPLES, INFO, REQUEST, ROI, STEP

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "conformance"
_PAYLOADS: Mapping[type[wire.Message], bytes] = {
    wire.BaseHeader: b"an access unit",
    wire.StillWire: b"a still",
}
_EXAMPLES = [one.on_wire() for one in EXAMPLES]
_WITH_NESTED = {"RoiHeader": ("also", 16), "ControlAnswer": ("tracks", 6), "Feedback": ("stills", 19)}
"""A field that holds nested arrays, and its place."""
_EXACT = 2**53 - 1
"""Beyond it a number of JSON is not exact everywhere, and stands as text."""


class _Coded(bytes):
    """A value of a message, packed already."""


def files() -> dict[str, str]:
    content = {
        "messages.json": list(_messages()),
        "refused.json": list(_refused()),
        "objects.json": list(_objects()),
        "track-steps.json": list(track_steps()),
        "poses.json": list(poses()),
        "still-cases.json": [*still_cases(), *still_sizes()],
        "base-orders.json": list(base_orders()),
        "backlog-dialogues.json": list(backlog_dialogues()),
        "report-traces.json": list(report_traces()),
    }
    # A vector a line: a change shows which.
    return {
        name: "[\n" + ",\n".join(json.dumps(one, ensure_ascii=True) for one in vectors) + "\n]\n"
        for name, vectors in content.items()
    }


def schema_text() -> str:
    """``docs/wire.json``: a field a line."""
    content = _plain(schema())
    lines = []
    for part in ("messages", "nested", "objects"):
        for name, one in content.pop(part).items():
            rows = ",\n    ".join(json.dumps(row, ensure_ascii=True) for row in one.pop("fields"))
            head = "".join(f'"{key}": {value}, ' for key, value in one.items())
            lines.append((part, f'  "{name}": {{{head}"fields": [\n    {rows}\n  ]}}'))
    parts = [f'"{key}": {json.dumps(value, ensure_ascii=True)}' for key, value in content.items()]
    parts += [
        f'"{part}": {{\n' + ",\n".join(text for where, text in lines if where == part) + "\n}"
        for part in ("messages", "nested", "objects")
    ]
    return "{\n" + ",\n".join(parts) + "\n}\n"


def main() -> int:
    FOLDER.mkdir(exist_ok=True)
    PATH.write_text(schema_text(), encoding="utf-8")
    for name, text in files().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
        print(f"{FOLDER / name}: {text.count(chr(10)) - 2} vectors")
    return 0


_OF_ANY_TYPE: tuple[tuple[Any, str], ...] = (
    (None, "is nothing"),
    (1.5, "is a fraction"),
    (True, "is true"),
    (1, "is 1"),
    ("\x07", "is a text with a control character"),
    ([], "is an empty array"),
    ({}, "is an empty map"),
    (b"", "is no bytes"),
    (2**64 - 1, "is far above all"),
)


def edges(kind: Mapping[str, Any]) -> Iterator[tuple[Any, str]]:  # noqa: C901, PLR0912, PLR0915 - a case for each type
    """Values at and beyond the bounds of a schema; MessagePack holds no more than 64 bits."""
    match kind:
        case {"type": "int", "low": low, "high": high}:
            found = [(low, "at its bound"), (high, "at its upper bound")]
            found += [
                (low - 1, "just below its bound"),
                (high + 1, "just above its bound"),
                (float(low), "as a fraction"),
            ]
            yield from ((one, f"is {what}") for one, what in found if -(2**63) <= one < 2**64)
        case {"type": "word", "words": words, "most_bytes": most}:
            yield from edges({"type": "int", "low": 0, "high": len(words) - 1})
            yield from edges({"type": "str", "most_bytes": most})
        case {"type": "listed", "high": high, "most_bytes": most}:
            yield from edges({"type": "int", "low": 0, "high": high})
            yield from edges({"type": "str", "most_bytes": most})
        case {"type": "float", "low": low, "high": high}:
            yield from ((low, "is at its bound"), (high, "is at its upper bound"), (math.nan, "is NaN"))
            yield from (
                (math.nextafter(low, -math.inf), "is below"),
                (math.nextafter(high, math.inf), "is above"),
            )
            yield math.inf, "is infinite"
            yield 1, "is a whole number"
        case {"type": "str", "most_bytes": most}:
            yield "ü" * (most // 2), "is as long as may be"
            yield "ü" * (most // 2) + "x", "has a byte too many"
            yield from _TEXTS
        case {"type": "bin", "least_bytes": least, "most_bytes": most}:
            yield from ((bytes(most), "are as many as may be"), (bytes(most + 1), "are too many"))
            if least:
                yield bytes(least - 1), "are too few"
        case {"type": "scalar", "low": low, "high": high, "most": most}:
            yield from edges({"type": "int", "low": low, "high": high})
            yield from edges({"type": "float", "low": -most, "high": most})
            yield from edges({"type": "str", "most_bytes": kind["most_bytes"]})
        case {"type": "array", "least": least, "most": most, "of": of}:
            one = _plain_value(of)
            box = [0, 0, *[1] * 2] if "box" in kind else None
            yield box or [one] * most, "is as long as may be"
            yield [one] * (most + 1), "is longer than may be"
            if least:
                yield [one] * (least - 1), "is shorter than may be"
            if box:
                yield from (([3, 0, 2, 5], "is inside out"), ([0, 3, 5, 2], "is upside down"))
                yield from (([3, 0, 3, 5], "has no width"), ([0, 3, 5, 3], "has no height"))
            else:
                yield from (
                    ([raw] + [one] * max(0, least - 1), f"has one that {what}") for raw, what in edges(of)
                )
        case {"type": "nested", "of": name}:
            whole = _plain_value(kind)
            for place, field in enumerate(schema()["nested"][name]["fields"]):
                for raw, what in edges(field):
                    yield [*whole[:place], raw, *whole[place + 1 :]], f"has a {field['name']} that {what}"
        case {"type": "map", "most": most, "key_bytes": key_bytes, "of": of}:
            one = _plain_value(of)
            yield {f"{number}": one for number in range(most)}, "is as large as may be"
            yield {f"{number}": one for number in range(most + 1)}, "is larger than may be"
            yield from (
                ({"k" * key_bytes: one}, "has a long key"),
                ({"k" * (key_bytes + 1): one}, "has too long a key"),
            )
            yield from (({"a\u202e": one}, "has a key that turns round"), ({"": one}, "has an empty key"))
            yield from (({"a": raw}, f"has a value that {what}") for raw, what in edges(of))


_TEXTS = (
    ("", "is empty"),
    ("\x7f", "has a control"),
    ("\x85", "has a later control"),
    ("\u2028", "begins a line"),
    ("\u202e", "turns round"),
    ("\u2066", "is isolated"),
    ("\u200f", "has a mark of direction"),
    ("\ufeffa", "begins with a mark of byte order"),
    ("\U0001fae9\ue000\xa0", "has a new emoji, a private character and a space that does not break"),
)


def _plain_value(kind: Mapping[str, Any]) -> Any:
    """The smallest value of a schema."""
    match kind:
        case {"type": "int", "low": low, "high": high}:
            return min(max(0, low), high)
        case {"type": "float", "low": low}:
            return max(low, 0.0)
        case {"type": "nested", "of": name}:
            return [_plain_value(one) for one in schema()["nested"][name]["fields"]]
        case {"type": "array", "least": least, "of": of}:
            return [_plain_value(of)] * least
    return {"str": "", "bin": b"", "bool": False, "scalar": 0, "map": {}}[kind["type"]]


_PLACES: tuple[tuple[list[int], str], ...] = (
    ([0, 0, 1, 1, 0, 0, 0, 0], "is the smallest"),
    ([32766, 32766, 1, 1, -8, -8, 8, 8], "is the last pixel, and its box beside it"),
    ([9, 9, 40, 30, -100, 5, -100, 7, 20, 15], "has a coded size"),
    ([9, 9, 40, 30, 0, 0, 0, 0, 0, 15], "has a coded size of nothing"),
    ([9, 9, 40, 30, 0, 0, 0, 0, 20], "has a number too many"),
    ([9, 9, 40, 30, 0, 0, 0], "has a number too few"),
    ([9, 9, 0, 30, 0, 0, 0, 0], "is of no width"),
    ([9, 9, 40, -3, 0, 0, 0, 0], "is of a height below 0"),
    ([-1, 9, 40, 30, 0, 0, 0, 0], "begins before the frame"),
    ([32767, 9, 1, 30, 0, 0, 8, 0], "ends too far to the right"),
    ([9, 32738, 40, 30, 0, 0, 0, 8], "ends too far below"),
    ([9, 9, 40, 30, 0, 0, 0, 0, 32768, 15], "has a coded size that is too wide"),
    ([9, 9, 40, 30, 161, 0, 160, 0], "has a box that is inside out"),
    ([9, 9, 40, 30, 160, 120, 160, 120], "has a box without an inside"),
    ([9, 9, 40, 30, 0, 161, 0, 100], "has a box that is upside down"),
    ([9, 9, 40, 30, -262209, 0, 0, 0], "has a box too far to the left"),
    ([0, 0, 32767, 32767, -262136, -262136, 0, 0], "has a box as far out as may be"),
    ([9, 9, 40, 30, 0, 0, 0, 0, 1, 1], "has the smallest coded size"),
    ([9, 9, 40, 30, 0, 0, 0, 0, 32767, 32767], "has the largest coded size"),
)


# Messages that are to be read


def _messages() -> Iterator[dict[str, Any]]:
    for message in _EXAMPLES:
        yield _vector(message, "an example")
        yield from (
            _vector(replace_at(message, place, raw), what) for place, raw, what in _edges(message, good=True)
        )
        yield from _of_other_minors(message)
    yield from _good_envelopes()


def _of_other_minors(message: wire.Message) -> Iterator[dict[str, Any]]:
    """From a sender that knows more fields than we do, or fewer."""
    payload = _PAYLOADS.get(type(message), b"")
    values = _values(message)
    left_bytes = type(message).MAX_BYTES - len(message.pack(payload))
    for what, unknown in (
        ("one unknown field behind its own", [0]),
        ("unknown fields of every type", [None, True, -1, 1.5, "new", b"new", [1, [2]], {"new": 1}]),
        ("as many unknown fields as are skipped", [0] * MOST_UNKNOWN_FIELDS),
    ):
        if len(b"".join(map(msgpack.packb, unknown))) + 2 <= left_bytes:
            yield _vector(message, what, _packed([*values, *unknown], payload))
    if name_of(type(message)) in _WITH_NESTED:
        name, place = _WITH_NESTED[name_of(type(message))]
        for what, raw in (("an unknown field", 7), ("one as deep as may be", _nested(DEEPEST - 3))):
            longer = _with_nested(values, place, raw)
            yield _vector(message, f"{what} in each of {name}", _packed(longer, payload))
    table = fields(type(message))
    optional = {one.name: one.metadata["default"] for one in table if one.metadata["optional"]}
    if optional:
        fewer = _packed(values[: len(table) + 1 - len(optional)], payload)
        yield _vector(replace(message, **optional), "without what was added since", fewer)


def _with_nested(values: list[Any], place: int, *raw: Any) -> list[Any]:
    return [*values[:place], [[*one, *raw] for one in values[place]], *values[place + 1 :]]


def _vector(message: wire.Message, what: str, data: bytes | None = None) -> dict[str, Any]:
    """``data`` is the message in another form, of the same fields."""
    payload = _PAYLOADS.get(type(message), b"")
    if data is not None:
        assert type(message).parse(data, payload) == type(message).parse(message.pack(payload), payload), what
    return {
        "message": name_of(type(message)),
        "what": what,
        "hex": (message.pack(payload) if data is None else data).hex(),
        "payload": payload.hex(),
        "fields": _plain(_values(message)[1:]),
    }


def replace_at(message: wire.Message, place: int, raw: Any) -> wire.Message:
    """The message with another value of a field, as MessagePack holds it."""
    name, kind = wire.kinds(type(message))[place - 1]
    return replace(message, **{name: kind.decode(raw)})


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


def _good_envelopes() -> Iterator[dict[str, Any]]:
    """The same fields in other bytes: whatever MessagePack allows is read."""
    values = msgpack.unpackb(BASE.pack())[:-1]
    spare_bytes = wire.BaseHeader.MAX_BYTES - len(BASE.pack()) - 2
    payload = _PAYLOADS[wire.BaseHeader]
    wide = _Coded(b"\xcd" + WIRE_VERSION.to_bytes(2, "big"))
    yield _vector(BASE, "its version in 16 bits", _packed([wide, *values[1:]], payload))
    yield _vector(BASE, "as long as a message may be", _packed([*values, bytes(spare_bytes)], payload))
    deepest = _nested(DEEPEST - 1)
    yield _vector(BASE, "an unknown field as deep as may be", _packed([*values, deepest], payload))
    maps = _nested(DEEPEST - 1, map_of=True)
    yield _vector(BASE, "maps as deep as may be", _packed([*values, maps], payload))
    for what, nested in _long_heads(DEEPEST - 1):
        yield _vector(REQUEST, f"{what} as deep as may be", _packed([*_values(REQUEST), nested], b""))
    numbers: list[Any] = [math.nan, math.inf, 2**64 - 1, -(2**63), "\x07"]
    yield _vector(BASE, "unknown fields that no known one may hold", _packed([*values, *numbers], payload))
    for length, what in enumerate(("8 bits", "16 bits", "32 bits", "64 bits")):
        coded = bytes((0xCC + length,)) + (5).to_bytes(2**length, "big")
        spelt = replace(BASE, send_delay_ns=5)
        yield _vector(spelt, f"a number in {what}", _coded(spelt, {"send_delay_ns": coded}))
    small = replace(BASE, send_delay_ns=-5)
    for what, coded in (
        ("a number in a signed byte", b"\xd0\xfb"),
        ("a number in 16 signed bits", b"\xd1\xff\xfb"),
        ("a number in 32 signed bits", b"\xd2\xff\xff\xff\xfb"),
        ("a number in 64 signed bits", b"\xd3\xff\xff\xff\xff\xff\xff\xff\xfb"),
    ):
        yield _vector(small, what, _coded(small, {"send_delay_ns": coded}))
    yield _vector(INFO, "a float of 32 bits", _coded(INFO, {"fps": b"\xca" + struct.pack(">f", INFO.fps)}))
    sides = b"".join(map(msgpack.packb, INFO.base_size))
    for first, packed, what in ((0xD9, ">B", "8"), (0xDA, ">H", "16"), (0xDB, ">I", "32")):
        text = bytes((first,)) + struct.pack(packed, len(INFO.edge)) + INFO.edge.encode()
        yield _vector(INFO, f"a text with a length of {what} bits", _coded(INFO, {"edge": text}))
        boxes = bytes((first - 0xD9 + 0xC4,)) + struct.pack(packed, len(STEP.boxes)) + STEP.boxes
        yield _vector(STEP, f"bytes with a length of {what} bits", _coded(STEP, {"boxes": boxes}))
    for head, what in ((b"\xdc\0\x02", "16"), (b"\xdd\0\0\0\x02", "32")):
        array = _coded(INFO, {"base_size": head + sides})
        yield _vector(INFO, f"an array with a length of {what} bits", array)
    request = replace(REQUEST, arguments={"bps": 5})
    for what, coded in (("a map with a length of 16 bits", b"\xde\0\x01"), ("of 32 bits", b"\xdf\0\0\0\x01")):
        yield _vector(request, what, _coded(request, {"arguments": coded + b"\xa3bps\x05"}))


def _bad_envelopes() -> Iterator[dict[str, Any]]:
    values = msgpack.unpackb(BASE.pack())[:-1]
    payload = _PAYLOADS[wire.BaseHeader]
    spare_bytes = wire.BaseHeader.MAX_BYTES - len(BASE.pack()) - 2
    for what, unknown in (
        ("a byte longer than a message may be", bytes(spare_bytes + 1)),
        ("an unknown field too deep", _nested(DEEPEST)),
        ("maps too deep", _nested(DEEPEST, map_of=True)),
        ("an unknown map whose key is a number", {1: 2}),
        ("an unknown field of a type of its own", msgpack.ExtType(5, b"x")),
        ("an unknown field of a type of its own without bytes", msgpack.ExtType(5, b"")),
        ("an unknown field of a type that never was", _Coded(b"\xc1")),
    ):
        yield _bad(BASE, what, _packed([*values, unknown], payload), payload)
    for what, nested in _long_heads(DEEPEST):
        yield _bad(REQUEST, f"{what} too deep", _packed([*_values(REQUEST), nested], b""), b"")
    for what, coded in (
        ("a key twice", b"\x82\xa1a\x01\xa1a\x02"),
        ("a key that is a number", b"\x81\x01\x02"),
        ("a key that is bytes", b"\x81\xc4\x01a\x02"),
        ("a text that is no UTF-8", b"\x81\xa1a\xa2\xc3\x28"),
        ("a text with half a surrogate", b"\x81\xa1a\xa3\xed\xa0\x80"),
        ("a text in place of a map", b"\xa1a"),
    ):
        yield _bad(REQUEST, what, _coded(REQUEST, {"arguments": coded}), b"")
    for name in ("w", "h", "b"):
        sent = [kind.encode(getattr(ROI.on_wire(), one)) for one, kind in wire.kinds(wire.StillWire)]
        sent[[one for one, _ in wire.kinds(wire.StillWire)].index("parameters")] = {name: 5}
        what = f"a parameter {name}, which has a field of its own"
        yield _bad(ROI.on_wire(), what, _packed([WIRE_VERSION, *sent], b"a still"), b"a still")
    whole = BASE.pack(payload)
    other = whole[:1] + bytes((WIRE_VERSION + 1,)) + whole[2:]
    for what, data in (
        ("whose checksum is wrong", other),
        ("without a checksum", b"\x92\x07\xa1x"),
        ("with a type of its own", b"\x93\x07\xc7\0\5\xc1"),
        ("longer than a message may be", b"\x92\x07\xc4\x64" + bytes(100)),
    ):
        yield _bad(BASE, f"another version {what}", data, payload)
    body = bytes((whole[0], *whole[1:-5], 0xCF, 0, 0, 0))
    checksum = zlib.crc32(body, zlib.crc32(payload)).to_bytes(4, "big")
    yield _bad(BASE, "the checksum in eight bytes", body + b"\0" + checksum, payload)
    for message in (BASE, ROI.on_wire()):
        most = type(message).MAX_PAYLOAD
        vector = _bad(message, "a payload that is too long", message_of(message, most + 1), bytes(most + 1))
        yield vector | {"payload": {"zeros": most + 1}}


def message_of(message: wire.Message, zeros: int) -> bytes:
    """Sealed over a payload of so many zeros, however many."""
    return _packed(msgpack.unpackb(message.pack())[:-1], bytes(zeros))


def _nested(levels: int, *, map_of: bool = False) -> Any:
    value: Any = {} if map_of else []
    for _ in range(levels - 1):
        value = {"a": value} if map_of else [value]
    return value


def _long_heads(levels: int) -> Iterator[tuple[str, _Coded]]:
    """Nested so deep, with lengths of more bits than they need."""
    for what, head in (
        ("arrays of 16 bits", b"\xdc\0\1"),
        ("arrays of 32 bits", b"\xdd\0\0\0\1"),
        ("maps of 16 bits", b"\xde\0\1\xa1a"),
        ("maps of 32 bits", b"\xdf\0\0\0\1\xa1a"),
    ):
        yield what, _Coded(head * (levels - 1) + b"\x90")


def _coded(message: wire.Message, changed: Mapping[str, bytes]) -> bytes:
    """With fields in other bytes."""
    names = [name for name, _ in wire.kinds(type(message))]
    fields_of = wire.PackedMessage.of(message).fields
    rows = [changed.get(name, fields_of[name]) for name in names]
    body = msgpack.Packer().pack_array_header(len(rows) + 2) + bytes((WIRE_VERSION,)) + b"".join(rows)
    return (
        bytes(body)
        + b"\xce"
        + zlib.crc32(body, zlib.crc32(_PAYLOADS.get(type(message), b""))).to_bytes(4, "big")
    )


# Messages that are not


def _refused() -> Iterator[dict[str, Any]]:
    """Messages that are damaged, of another version, or out of bounds; the checksum fits unless it is the fault."""
    for message in _EXAMPLES:
        payload = _PAYLOADS.get(type(message), b"")
        good = message.pack(payload)
        values = _values(message)
        yield _bad(message, "a bit is flipped", bytes((*good[:-7], good[-7] ^ 1, *good[-6:])), payload)
        yield _bad(message, "its end is missing", good[:-1], payload)
        yield _bad(message, "a byte follows", good + b"\0", payload)
        yield _bad(message, "the checksum is of another payload", good, payload + b"!")
        for what, version in (("an older", WIRE_VERSION - 1), ("a newer", WIRE_VERSION + 1)):
            yield _bad(message, f"{what} version", _packed([version, *values[1:]], payload), payload)
        if name_of(type(message)) in _WITH_NESTED:
            name, place = _WITH_NESTED[name_of(type(message))]
            for what, raw in (
                ("an unknown field too deep", [_nested(DEEPEST - 2)]),
                ("more unknown fields than are skipped", [0] * (MOST_UNKNOWN_FIELDS + 1)),
            ):
                longer = _packed(_with_nested(values, place, *raw), payload)
                yield _bad(message, f"{what} in each of {name}", longer, payload)
        unknown = [0] * (MOST_UNKNOWN_FIELDS + 1)
        yield _bad(
            message, "more unknown fields than are skipped", _packed([*values, *unknown], payload), payload
        )
        optional = sum(item.metadata["optional"] for item in fields(type(message)))
        yield _bad(
            message,
            "a field too few",
            _packed(values[: len(fields(type(message))) - optional], payload),
            payload,
        )
        yield from (
            _bad(message, what, _packed([*values[:place], raw, *values[place + 1 :]], payload), payload)
            for place, raw, what in _edges(message, good=False)
        )
    yield from _bad_envelopes()


def _values(message: wire.Message) -> list[Any]:
    """Its version and all its fields as they are sent, those at the end too that are left out."""
    return [WIRE_VERSION, *(kind.encode(getattr(message, name)) for name, kind in wire.kinds(type(message)))]


def _edges(message: wire.Message, *, good: bool) -> Iterator[tuple[int, Any, str]]:
    """Values at the bounds of each field, by its place: those that are read, or those refused."""
    payload = _PAYLOADS.get(type(message), b"")
    size = len(message.pack(payload))
    values = _values(message)
    for place, (name, kind) in enumerate(wire.kinds(type(message)), 1):
        more = _PLACES if name == "place" else ()
        for raw, what in (*edges(kind.schema()), *_OF_ANY_TYPE, *more):
            changed = [*values[:place], raw, *values[place + 1 :]]
            try:
                type(message).parse(_packed(changed, payload), payload)
            except wire.WireError:
                read = False
            else:
                read = True
            grown = len(msgpack.packb(raw)) - len(msgpack.packb(values[place]))
            if read is good and size + grown <= type(message).MAX_BYTES:
                yield place, raw, f"{name} {what}"


def _bad(message: wire.Message, what: str, data: bytes, payload: bytes) -> dict[str, Any]:
    try:
        type(message).parse(data, payload)
    except wire.WireError as error:
        return {
            "message": name_of(type(message)),
            "what": what,
            "hex": data.hex(),
            "payload": payload.hex(),
            "version": isinstance(error, wire.UnknownVersionError),
        }
    raise AssertionError(f"{type(message).__name__} is read although {what}")


def _packed(values: list[Any], payload: bytes) -> bytes:
    """The array with a checksum that fits."""
    packed = (one if isinstance(one, _Coded) else msgpack.packb(one) for one in values)
    body = msgpack.Packer().pack_array_header(len(values) + 1) + b"".join(packed)
    return bytes(body) + b"\xce" + zlib.crc32(body, zlib.crc32(payload)).to_bytes(4, "big")


# Objects of the backlog


def _objects() -> Iterator[dict[str, Any]]:
    header = replace(ROI, flags=int(wire.Flags.STORED))
    still = wire.BacklogStill(header.pack(b"a still"), "image/jpeg", b"a still")
    units = [
        wire.BacklogUnit(7, 1_000, keyframe=True, data=b"first"),
        wire.BacklogUnit(9, 1_200, keyframe=False, data=b"second"),
    ]
    for kind, data in (("still", wire.pack_backlog_still(still)), ("base", wire.pack_backlog_units(units))):
        yield _good_object(kind, "an example", data)
        for what, wrong in (
            ("its end is missing", data[:-1]),
            ("a byte follows", data + b"\0"),
            ("is empty", b""),
        ):
            yield _bad_object(kind, what, wrong)
    first = replace(still, attachment=replace(header, capture_ns=0).pack(b"a still"))
    yield _good_object("still", "captured at the very first", wire.pack_backlog_still(first))
    for count, what in ((1, "one frame"), (2400, "as many frames as may be")):
        rows = [[7 + frame, frame, False, b"x"] for frame in range(count)]
        yield _good_object("base", what, msgpack.packb(rows))
    rows = [[7, 1_000, True, b"first"], [9, 1_200, False, b"second"]]
    for what, wrong_header in (
        ("it does not say that it was stored", replace(header, flags=255 - wire.Flags.STORED)),
        ("it does not say when it was captured", replace(header, capture_ns=-1)),
    ):
        unsaid = replace(still, attachment=wrong_header.pack(b"a still"))
        yield _bad_object("still", what, wire.pack_backlog_still(unsaid))
    for what, changed in (
        ("no frame at all", []),
        ("frames are not in order", rows[::-1]),
        ("times are not in order", [rows[0], [9, 1_000, False, b"second"]]),
        ("a frame is empty", [[7, 1_000, True, b""]]),
        ("a flag is a number", [[7, 1_000, 1, b"first"]]),
        ("a frame comes twice", [rows[0], [7, 1_200, False, b"second"]]),
        ("a frame has a further field", [[*rows[0], 1]]),
        ("a frame has a field too few", [rows[0][:3]]),
        ("more frames than an object holds", [[frame, frame, False, b"x"] for frame in range(2401)]),
        ("an index is below zero", [[-1, 1_000, True, b"first"]]),
    ):
        yield _bad_object("base", what, msgpack.packb(changed))
    yield _bad_object("still", "a further field", msgpack.packb([still.attachment, "image/jpeg", b"x", 1]))
    for what, values in (
        ("the attachment is a byte too long", [bytes(1025), "image/jpeg", b"x"]),
        ("the encoding is a byte too long", [b"", "x" * 65, b"x"]),
        ("the encoding has a control", [b"", "image/\n", b"x"]),
    ):
        yield _bad_object("still", what, msgpack.packb(values))
    yield _bad_object("still", "there is no still", msgpack.packb([still.attachment, "image/jpeg", b""]))
    yield _bad_object(
        "still", "the encoding is bytes", msgpack.packb([still.attachment, b"jpeg", b"a still"])
    )


def _good_object(kind: str, what: str, data: bytes) -> dict[str, Any]:
    _object(kind, data)
    return {"kind": kind, "what": what, "hex": data.hex(), "values": _plain(msgpack.unpackb(data))}


def _object(kind: str, data: bytes) -> None:
    number = ROI.sequence if kind == "still" else 7
    backlog_content((ROI.session_id, kind, number), data, edge=INFO.edge)


def _bad_object(kind: str, what: str, data: bytes) -> dict[str, Any]:
    try:
        _object(kind, data)
    except wire.WireError:
        return {"kind": kind, "what": what, "hex": data.hex()}
    raise AssertionError(f"the object {kind} is read although {what}")


if __name__ == "__main__":
    sys.exit(main())
