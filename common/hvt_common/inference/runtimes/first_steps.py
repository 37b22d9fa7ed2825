"""Whether an ONNX network scales its pixels itself, and which pixels it expects then; read from its file."""

from __future__ import annotations

import mmap
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.inference.runtimes.model_file import GRAPH_FIELD, fields_of, is_ir

# Field numbers of onnx.proto.
_NODE, _INITIALIZER, _INPUT = 1, 5, 11
_NODE_INPUT, _NODE_OUTPUT, _NODE_KIND, _NODE_ATTRIBUTE, _ATTRIBUTE_TENSOR = 1, 2, 4, 5, 5
_TENSOR_TYPE, _TENSOR_FLOATS, _TENSOR_NAME, _TENSOR_RAW = 2, 4, 8, 9
_TYPES = {1: "<f4", 10: "<f2", 11: "<f8"}
_MOST_BYTES = 64
_MOST_STEPS = 12
_SAME = frozenset({"Cast", "Identity", "Transpose", "Squeeze", "Unsqueeze", "Reshape"})
_ARITHMETIC = frozenset({"Sub", "Add", "Mul", "Div"})
_BYTE_SLOPE, _BYTE_MEAN = 0.05, 10.0
"""A smaller slope, or a larger mean, is for pixels of 0…255."""
_IMAGENET_MEANS, _NEAR = (123.7, 116.4, 103.7), 3.0
"""Of red, green, blue."""

_Numbers = npt.NDArray[np.float64]


@dataclass(slots=True)
class _Node:
    kind: str = ""
    inputs: list[str] = field(default_factory=list)
    output: str = ""
    value: _Numbers | None = None
    """Of a constant."""


def own_scaling(path: Path) -> tuple[int, bool | None] | None:
    """(greatest pixel, RGB) that a checked ONNX file expects; None where its first step is no scaling, as of most.

    The greatest pixel is 1 or 255. Whether red comes first is told by means alone; else None.
    """
    if is_ir(path):
        return None
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            spans = [span[3:] for span in fields_of(data, 0, len(data)) if span[0] == GRAPH_FIELD]
            slope, offset = _first_steps(data, *(spans or [(0, 0)])[-1])
    except (OSError, ValueError):  # it is another now than the one that was opened
        return None
    if slope is None:
        return None
    bytes_expected = slope.max() < _BYTE_SLOPE or (slope.max() <= 1 and np.abs(offset).max() > _BYTE_MEAN)
    top = 255 if bytes_expected else 1
    means = -offset / slope * (255 / top)
    orders = {True: _IMAGENET_MEANS, False: _IMAGENET_MEANS[::-1]}
    near = (first for first, known in orders.items() if np.abs(means - known).max() < _NEAR)
    return top, next(near, None)


def _first_steps(data: mmap.mmap, start: int, end: int) -> tuple[_Numbers | None, _Numbers]:
    # value = pixel * slope + offset, one number or three each; no slope where the first step is no scaling.
    at, users, constants = _graph(data, start, end)
    slope, offset, scaled = np.ones(1), np.zeros(1), False
    for _ in range(_MOST_STEPS):
        (node, *others) = users.get(at) or (_Node(),)
        if others or node.kind not in _SAME | _ARITHMETIC:
            break
        if node.kind in _ARITHMETIC:
            by = constants.get(next((name for name in node.inputs if name != at), ""))
            turned = node.kind in ("Sub", "Div") and node.inputs[0] != at
            if by is None or by.size not in (1, 3) or turned or not (np.isfinite(by) & (by != 0)).all():
                break
            factor = {"Mul": by, "Div": 1 / by}.get(node.kind, np.ones(1))
            more = {"Add": by, "Sub": -by}.get(node.kind, np.zeros(1))
            slope, offset, scaled = slope * factor, offset * factor + more, True
        at = node.output
    return (np.abs(slope) if scaled else None), offset


def _graph(
    data: mmap.mmap, start: int, end: int
) -> tuple[str, dict[str, list[_Node]], dict[str, _Numbers | None]]:
    # The first input, the nodes by what they take, and the numbers of constants that are few.
    users: dict[str, list[_Node]] = {}
    constants: dict[str, _Numbers | None] = {}
    inputs = []
    for number, _, _, begin, stop in fields_of(data, start, end):
        if number == _NODE:
            node = _node(data, begin, stop)
            constants |= {node.output: node.value} if node.kind == "Constant" else {}
            for name in node.inputs:
                users.setdefault(name, []).append(node)
        elif number == _INITIALIZER:
            name, value = _tensor(data, begin, stop)
            constants[name] = value
        elif number == _INPUT:
            inputs.append(_text(data, begin, stop, 1))
    return next((name for name in inputs if name not in constants), ""), users, constants


def _node(data: mmap.mmap, start: int, end: int) -> _Node:
    node = _Node()
    for number, _, _, begin, stop in fields_of(data, start, end):
        if number == _NODE_INPUT:
            node.inputs.append(data[begin:stop].decode(errors="replace"))
        elif number == _NODE_OUTPUT:
            node.output = data[begin:stop].decode(errors="replace")
        elif number == _NODE_KIND:
            node.kind = data[begin:stop].decode(errors="replace")
        elif number == _NODE_ATTRIBUTE:
            for inner, wire_type, _, first, last in fields_of(data, begin, stop):
                if inner == _ATTRIBUTE_TENSOR and wire_type == 2:
                    node.value = _tensor(data, first, last)[1]
    return node


def _tensor(data: mmap.mmap, start: int, end: int) -> tuple[str, _Numbers | None]:
    # Its name, and its numbers where they are few.
    name, kind, value = "", 0, None
    for number, wire_type, said, begin, stop in fields_of(data, start, end):
        if number == _TENSOR_NAME:
            name = data[begin:stop].decode(errors="replace")
        elif number == _TENSOR_TYPE:
            kind = said
        elif number in (_TENSOR_FLOATS, _TENSOR_RAW) and wire_type == 2 and stop - begin <= _MOST_BYTES:
            value = data[begin:stop]
    dtype = np.dtype(_TYPES.get(kind, "<f4"))
    known = value is not None and kind in _TYPES and len(value) % dtype.itemsize == 0
    return name, np.frombuffer(value, dtype).astype(np.float64) if known and value else None


def _text(data: mmap.mmap, start: int, end: int, wanted: int) -> str:
    spans = (span[3:] for span in fields_of(data, start, end) if span[0] == wanted)
    return next((data[begin:stop].decode(errors="replace") for begin, stop in spans), "")
