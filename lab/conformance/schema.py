"""``docs/wire.json``: every message, field, type, bound and limit of the wire as data, from the code's own tables.

The lists of docs/wire-messages.md are checked against it, and the reader in TypeScript reads its fields from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
    MAX_PAYLOAD_BYTES,
    MOST_UNKNOWN_FIELDS,
    SPOKEN_VERSIONS,
    WIRE_VERSION,
    BacklogHeader,
    BacklogStill,
    BacklogUnit,
    BaseHeader,
    ControlAnswer,
    ControlRequest,
    Feedback,
    Info,
    InfoRequest,
    Message,
    PoseReport,
    Status,
    StillWire,
    TrackStep,
    kinds,
)
from hvt_common.protocol.messages.envelope import DEEPEST, Nested
from hvt_common.protocol.messages.fields import REFUSED_CHARACTERS, Kind, ListOf
from hvt_common.protocol.messages.track_boxes import MOST_BOXES, MOST_CLASSES

PATH = Path(__file__).resolve().parents[2] / "docs" / "wire.json"
MESSAGES: tuple[type[Message], ...] = (
    BaseHeader,
    StillWire,
    BacklogHeader,
    Info,
    TrackStep,
    PoseReport,
    Status,
    InfoRequest,
    ControlRequest,
    ControlAnswer,
    Feedback,
)


def schema() -> dict[str, Any]:
    """All of it; what JSON has no exact number for stays a whole number here."""
    nested = {
        one.__name__: one for message in MESSAGES for _, kind in kinds(message) for one in nested_of(kind)
    }
    return {
        "version": WIRE_VERSION,
        "reads": list(SPOKEN_VERSIONS),
        "limits": {
            "payload_bytes": MAX_PAYLOAD_BYTES,
            "object_bytes": MAX_BACKLOG_BYTES,
            "unknown_fields": MOST_UNKNOWN_FIELDS,
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
        "objects": {one.__name__: {"fields": list(_fields(one))} for one in (BacklogStill, BacklogUnit)},
    }


def name_of(message: type[Message]) -> str:
    """As the pages call it."""
    return "RoiHeader" if message is StillWire else message.__name__


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
