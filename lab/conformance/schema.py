"""``docs/wire.json``: every message, field, type, bound and limit of the wire as data, from the code's own tables.

The lists of docs/wire-messages.md are checked against it, and the reader in TypeScript reads its fields from it.
"""

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from hvt_common.protocol import messages as wire
from hvt_common.protocol.messages.envelope import DEEPEST, Nested
from hvt_common.protocol.messages.fields import REFUSED_CHARACTERS, Kind, ListOf
from hvt_common.protocol.messages.track_boxes import MOST_BOXES, MOST_CLASSES

PATH = Path(__file__).resolve().parents[2] / "docs" / "wire.json"
_PARTS = {8: "eighths", 10: "tenths", 100: "hundredths", 1000: "thousandths"}
MESSAGES: tuple[type[wire.Message], ...] = (
    wire.BaseHeader,
    wire.StillWire,
    wire.BacklogHeader,
    wire.Info,
    wire.TrackStep,
    wire.PoseReport,
    wire.Status,
    wire.InfoRequest,
    wire.ControlRequest,
    wire.ControlAnswer,
    wire.Feedback,
)


def schema() -> dict[str, Any]:
    """All of it; a value without an exact JSON number stays a whole number here."""
    nested = {
        one.__name__: one
        for message in MESSAGES
        for _, kind in wire.kinds(message)
        for one in nested_of(kind)
    }
    return {
        "version": wire.WIRE_VERSION,
        "reads": list(wire.SPOKEN_VERSIONS),
        "limits": {
            "payload_bytes": wire.MAX_PAYLOAD_BYTES,
            "object_bytes": wire.MAX_BACKLOG_BYTES,
            "unknown_fields": wire.MOST_UNKNOWN_FIELDS,
            "depth": DEEPEST,
            "tracks": MOST_BOXES,
            "classes": MOST_CLASSES,
            "refused_characters": [list(one) for one in REFUSED_CHARACTERS],
        },
        "messages": {
            name_of(one): {
                "most_bytes": one.MAX_BYTES,
                "payload_bytes": one.MAX_PAYLOAD,
                "fields": list(_fields(one)),
            }
            for one in MESSAGES
        },
        "nested": {name: {"fields": list(_fields(one))} for name, one in nested.items()},
        "objects": {
            one.__name__: {"fields": list(_fields(one))} for one in (wire.BacklogStill, wire.BacklogUnit)
        },
    }


def name_of(message: type[wire.Message]) -> str:
    return "RoiHeader" if message is wire.StillWire else message.__name__


def nested_of(kind: Kind) -> Iterator[type]:
    """The nested arrays that a field holds."""
    match kind:
        case Nested(of):
            yield of
        case ListOf(inner):
            yield from nested_of(inner)


def _fields(message: type) -> Iterator[dict[str, Any]]:
    for item in fields(message):
        meta, kind = item.metadata, item.metadata["wire"]
        default = {"default": kind.encode(meta["default"])} if meta["optional"] else {}
        yield {"name": item.name, **kind.schema(), **default}


def described(kind: dict[str, Any]) -> str:  # noqa: C901, PLR0911 - one return for each kind
    """A schema in a few words, as docs/wire-messages.md has it."""
    match kind:
        case {"type": "int", "words": words}:
            return "int: " + ", ".join(f"{number} {word}" for number, word in enumerate(words))
        case {"type": "int", "low": low, "high": high, "per": per}:
            return f"int {low}…{high}, {_PARTS[per]}"
        case {"type": "int", "low": low, "high": high}:
            return _range(low, high)
        case {"type": "float", "low": low, "high": high}:
            return f"float {low:g}…{high:g}"
        case {"type": "str" | "bin" as name, "most_bytes": most}:
            return f"{name} ≤ {most} B"
        case {"type": "word", "words": words, "most_bytes": most}:
            return (
                ", ".join(f"{number} {word}" for number, word in enumerate(words)) + f"; else str ≤ {most} B"
            )
        case {"type": "listed", "high": high, "most_bytes": most}:
            return f"int 0…{high} or str ≤ {most} B"
        case {"type": "scalar", "most_bytes": most}:
            return f"int, finite float or str ≤ {most} B"
        case {"type": "array", "least": least, "most": most, "of": of}:
            return (
                f"array of {most}: {described(of)}" if least == most else f"array ≤ {most} of {described(of)}"
            )
        case {"type": "map", "most": most, "key_bytes": key_bytes, "of": of}:
            return f"map ≤ {most}: str ≤ {key_bytes} B to {described(of)}"
        case {"type": "nested", "of": name}:
            return str(name)
    return str(kind["type"])


def _range(low: int, high: int) -> str:
    # Whole numbers of so many bits by the name that the page explains: ``u32`` is 0…(2^32 - 1).
    bits = high.bit_length()
    if bits >= 32 and high == 2**bits - 1 and low in (0, -1, -high):
        return f"u{bits}" if low == 0 else f"u{bits} or −1" if low == -1 else f"±u{bits}"  # noqa: RUF001
    return f"int {low}…{high}"
