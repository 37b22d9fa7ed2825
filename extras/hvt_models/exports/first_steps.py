"""Whether a network scales its pixels itself or turns their colours round, read from its file: ONNX or OpenVINO's."""

import mmap
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from hvt_common.inference.letterbox import OwnSteps
from hvt_common.inference.runtimes.model_file import GRAPH_FIELD, fields_of, files_of, is_ir, text

# Field numbers of onnx.proto.
_NODE, _INITIALIZER, _INPUT = 1, 5, 11
_NODE_INPUT, _NODE_OUTPUT, _NODE_KIND, _NODE_ATTRIBUTE, _ATTRIBUTE_TENSOR = 1, 2, 4, 5, 5
_TENSOR_TYPE, _TENSOR_FLOATS, _TENSOR_NAME, _TENSOR_RAW = 2, 4, 8, 9
_TYPES = {1: "<f4", 6: "<i4", 7: "<i8", 10: "<f2", 11: "<f8"}
_MOST_BYTES = 64
_MOST_STEPS = 12
_SAME = frozenset(
    {"Cast", "Identity", "Transpose", "Squeeze", "Unsqueeze", "Reshape", "Clip", "Clamp", "Pad", "Resize"}
)
_ARITHMETIC = frozenset({"Sub", "Add", "Mul", "Div"})
_TURNING = {"Gather": 1, "Slice": 4, "StridedSlice": 3}
"""Operators that may reverse the channels, and the place of the input that decides it."""
_NO_PIXELS = frozenset({"Shape", "ShapeOf"})
_BYTE_SLOPE, _BYTE_MEAN = 0.05, 10.0
"""A smaller slope, or a larger mean, is for pixels of 0…255."""
_IMAGENET_MEANS, _NEAR = (123.7, 116.4, 103.7), 3.0
"""Means of red, green and blue; others this near are the same."""

_IR_KINDS = {
    "Convert": "Cast",
    "Subtract": "Sub",
    "Multiply": "Mul",
    "Divide": "Div",
    "Slice": "StridedSlice",  # with its inputs in that order
}
"""OpenVINO's operators that have another name."""
_IR_TYPES = {"f16": "<f2", "f32": "<f4", "f64": "<f8", "i32": "<i4", "i64": "<i8"}

_Numbers = npt.NDArray[np.float64]


@dataclass(slots=True)
class _Node:
    kind: str = ""
    inputs: list[str] = field(default_factory=list)
    output: str = ""
    value: _Numbers | None = None
    """The value of a constant."""


def own_steps(path: Path) -> OwnSteps:
    """The first steps of a checked file on its pixels; most files have none."""
    try:
        graph = _ir_graph(path) if is_ir(path) else _onnx_graph(path)
    except (OSError, ValueError, LookupError, ET.ParseError):
        return OwnSteps()  # it is another now than the one that was opened
    slope, offset, turned = _first_steps(*graph)
    if slope is None:
        return OwnSteps(turned=turned)
    bytes_expected = slope.max() < _BYTE_SLOPE or (slope.max() <= 1 and np.abs(offset).max() > _BYTE_MEAN)
    top = 255 if bytes_expected else 1
    means = -offset / slope * (255 / top)
    orders = {True: _IMAGENET_MEANS, False: _IMAGENET_MEANS[::-1]}
    near = (first for first, known in orders.items() if np.abs(means - known).max() < _NEAR)
    return OwnSteps(top, next(near, None), turned)


def _first_steps(
    at: str, users: dict[str, list[_Node]], constants: dict[str, _Numbers | None]
) -> tuple[_Numbers | None, _Numbers, bool]:
    # value = pixel * slope + offset, one number or three each; no slope where the first step is no scaling. And
    # whether the first channel became the last.
    slope, offset, scaled, reversed_ = np.ones(1), np.zeros(1), False, False
    for _ in range(_MOST_STEPS):
        (node, *others) = [one for one in users.get(at, []) if one.kind not in _NO_PIXELS] or [_Node()]
        if others or node.kind not in _SAME | _ARITHMETIC | _TURNING.keys():
            break
        by = constants.get(next((name for name in node.inputs if name != at), ""))
        if node.kind in _TURNING:
            if not _turns(node, constants):
                break
            slope, offset, reversed_ = slope[::-1], offset[::-1], not reversed_
        if node.kind in _ARITHMETIC:
            adds, first = node.kind in ("Add", "Sub"), node.kind in ("Add", "Mul") or node.inputs[0] == at
            if by is None or by.size not in (1, 3) or not first or not np.isfinite(by).all():
                break
            if adds:
                offset = offset + (by if node.kind == "Add" else -by)
            elif by.all():
                factor = by if node.kind == "Mul" else 1 / by
                slope, offset = slope * factor, offset * factor
            else:
                break
            scaled = scaled or not adds or bool(by.any())  # to add nothing is no step
        at = node.output
    return (np.abs(slope) if scaled else None), offset, reversed_


def _turns(node: _Node, constants: dict[str, _Numbers | None]) -> bool:
    said = constants.get("".join(node.inputs[_TURNING[node.kind] :][:1]))
    return said is not None and (said.tolist() == [2, 1, 0] if node.kind == "Gather" else said.min() == -1)


def _ir_graph(path: Path) -> tuple[str, dict[str, list[_Node]], dict[str, _Numbers | None]]:
    # The same of OpenVINO's two files.
    model, weights = files_of(path)
    root = ET.parse(model).getroot()  # noqa: S314 - checked: no entities
    nodes: dict[str, _Node] = {}
    constants: dict[str, _Numbers | None] = {}
    users: dict[str, list[_Node]] = {}
    with weights.open("rb") as file:
        for layer in root.iterfind("layers/layer"):
            number, kind = layer.get("id", ""), layer.get("type", "")
            nodes[number] = _Node(_IR_KINDS.get(kind, kind), output=number)
            data = layer.find("data")
            if kind == "Const" and data is not None and 0 < int(data.attrib["size"]) <= _MOST_BYTES:
                file.seek(int(data.attrib["offset"]))
                dtype = _IR_TYPES.get(data.get("element_type", ""))
                value = file.read(int(data.attrib["size"]))
                constants[number] = np.frombuffer(value, dtype).astype(np.float64) if dtype else None
    edges = sorted(root.iterfind("edges/edge"), key=lambda edge: int(edge.get("to-port", "0")))
    for edge in edges:
        source, node = edge.attrib["from-layer"], nodes[edge.attrib["to-layer"]]
        node.inputs.append(source)
        users.setdefault(source, []).append(node)
        if node.kind == "Cast" and source in constants:  # kept in half precision
            constants[node.output] = constants[source]
    first = next((number for number, node in nodes.items() if node.kind == "Parameter"), "")
    return first, users, constants


def _onnx_graph(path: Path) -> tuple[str, dict[str, list[_Node]], dict[str, _Numbers | None]]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        spans = [span[3:] for span in fields_of(data, 0, len(data)) if span[0] == GRAPH_FIELD]
        return _graph(data, *(spans or [(0, 0)])[-1])


def _graph(
    data: mmap.mmap, start: int, end: int
) -> tuple[str, dict[str, list[_Node]], dict[str, _Numbers | None]]:
    # The first input, the nodes by the name of an input, and the values of small constants.
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
            names = (text(data[span[3] : span[4]]) for span in fields_of(data, begin, stop) if span[0] == 1)
            inputs.append(next(names, ""))
    return next((name for name in inputs if name not in constants), ""), users, constants


def _node(data: mmap.mmap, start: int, end: int) -> _Node:
    node = _Node()
    for number, _, _, begin, stop in fields_of(data, start, end):
        if number == _NODE_INPUT:
            node.inputs.append(text(data[begin:stop]))
        elif number == _NODE_OUTPUT:
            node.output = text(data[begin:stop])
        elif number == _NODE_KIND:
            node.kind = text(data[begin:stop])
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
            name = text(data[begin:stop])
        elif number == _TENSOR_TYPE:
            kind = said
        elif number in (_TENSOR_FLOATS, _TENSOR_RAW) and wire_type == 2 and stop - begin <= _MOST_BYTES:
            value = data[begin:stop]
    dtype = np.dtype(_TYPES.get(kind, "<f4"))
    known = value is not None and kind in _TYPES and len(value) % dtype.itemsize == 0
    return name, np.frombuffer(value, dtype).astype(np.float64) if known and value else None
