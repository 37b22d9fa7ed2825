"""Whether an ONNX file keeps weights in other files, found by walking its protobuf without any library.

A model that does would make a runtime open files by the names that stand in it. onnxruntime keeps to the model's own
folder; HVT takes models of one file only, so that what was checked (size, digest) is what is run.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

__all__ = ["external_weights", "read_varint"]

_DEEPEST = 100
"""Messages in messages; protobuf itself stops here."""
_EXTERNAL = 1
"""`TensorProto.DataLocation`."""

# Fields of onnx.proto that lead to tensors: message → field number → message.
_INSIDE: Mapping[str, Mapping[int, str]] = MappingProxyType(
    {
        "Model": {7: "Graph", 20: "Training", 25: "Function"},
        "Training": {1: "Graph", 2: "Graph"},
        "Function": {7: "Node", 11: "Attribute"},
        "Graph": {1: "Node", 5: "Tensor", 15: "Sparse"},
        "Node": {5: "Attribute"},
        "Attribute": {5: "Tensor", 6: "Graph", 10: "Tensor", 11: "Graph", 22: "Sparse", 23: "Sparse"},
        "Sparse": {1: "Tensor", 2: "Tensor"},
        "Tensor": {},
    }
)
_TENSOR_EXTERNAL_DATA, _TENSOR_DATA_LOCATION = 13, 14
_FIXED_BYTES = {1: 8, 5: 4}


def external_weights(path: Path) -> str | None:
    """Where the first tensor with data outside the file says that they are; None where there is none.

    Raises:
        ValueError: the bytes do not walk as an ONNX protobuf.
        OSError: the file cannot be read.
    """
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return _in_message(data, 0, len(data), "Model", depth=0)


def _in_message(data: mmap.mmap, start: int, end: int, kind: str, *, depth: int) -> str | None:
    if depth > _DEEPEST:
        raise ValueError(f"messages nested {depth} deep")
    if kind == "Tensor":
        return _in_tensor(data, start, end)
    for field, wire_type, _, begin, stop in _fields(data, start, end):
        inner = _INSIDE[kind].get(field)
        if inner is not None and wire_type == 2:
            found = _in_message(data, begin, stop, inner, depth=depth + 1)
            if found is not None:
                return found
    return None


def _in_tensor(data: mmap.mmap, start: int, end: int) -> str | None:
    external, location = False, ""
    for field, wire_type, value, begin, stop in _fields(data, start, end):
        if field == _TENSOR_DATA_LOCATION and wire_type == 0:
            external = value == _EXTERNAL
        elif field == _TENSOR_EXTERNAL_DATA and wire_type == 2:
            external = True
            entry = {number: data[a:b] for number, _, _, a, b in _fields(data, begin, stop)}
            if entry.get(1) == b"location":
                location = entry.get(2, b"")[:200].decode(errors="replace")
    return location if external else None


def _fields(data: mmap.mmap, start: int, end: int) -> Iterator[tuple[int, int, int, int, int]]:
    """Number, wire type, value (of a varint), begin and end of each field of a message."""
    at = start
    while at < end:
        head = data[at : min(end, at + 20)]
        tag, used = read_varint(head, 0)
        wire_type, value, begin = tag & 7, 0, at + used
        if wire_type == 0:
            value, after = read_varint(head, used)
            stop = at + after
        elif wire_type == 2:
            length, after = read_varint(head, used)
            begin = at + after
            stop = begin + length
        elif wire_type in _FIXED_BYTES:
            stop = begin + _FIXED_BYTES[wire_type]
        else:
            raise ValueError(f"unknown wire type {wire_type} at byte {at}")
        if stop > end:
            raise ValueError(f"field {tag >> 3} ends {stop - end} bytes past the end")
        yield tag >> 3, wire_type, value, begin, stop
        at = stop


def read_varint(data: bytes, start: int) -> tuple[int, int]:
    """Decode a protobuf varint: (value, position after it)."""
    value = 0
    for count, byte in enumerate(data[start : start + 10]):
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, start + count + 1
    raise ValueError("a number without an end")
