"""Tiny ONNX models, built in memory, that behave like the real kinds on real pixels.

The colour detectors look at the image: in every cell of strides 8, 16 and 32 the scores of the three classes are the
mean values of the three input channels, and the box is the cell. So a red square gives a detection of the channel
that red arrived in, where it arrived.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

STRIDES = (8, 16, 32)

Shape = Sequence[int | str | None]


def save(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    *,
    inputs: Mapping[str, Shape],
    outputs: Mapping[str, Shape],
    constants: Mapping[str, np.ndarray] | None = None,
    metadata: Mapping[str, str] | None = None,
    dtype: type = np.float32,
) -> Path:
    """Write a checked model of these nodes and return its path."""
    element = helper.np_dtype_to_tensor_dtype(np.dtype(dtype))
    ports = [
        [helper.make_tensor_value_info(name, element, shape) for name, shape in group.items()]
        for group in (inputs, outputs)
    ]
    weights = [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()]
    graph = helper.make_graph(list(nodes), "tiny", *ports, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def scaling_inside(path: Path, steps: Sequence[tuple[str, Any]]) -> Path:
    """The model with these operators between its (N, 3, H, W) input and what takes it now, each with its constant."""
    model = onnx.load(path)
    graph = model.graph
    first = last = graph.input[0].name
    nodes = []
    for number, (kind, value) in enumerate(steps):
        made = f"scaled{number}"
        extra = {"Cast": {"to": TensorProto.FLOAT}, "Gather": {"axis": 1}}.get(kind, {})
        if kind == "Slice":
            constants = [np.array([one], np.int64) for one in value]
        elif value in (None, TensorProto.UINT8):  # a Cast, of what goes in
            graph.input[0].type.tensor_type.elem_type = value or TensorProto.FLOAT
            constants = []
        else:
            shape, dtype = {"Gather": ((-1,), np.int64), "Clip": ((), np.float32)}.get(
                kind, ((-1, 1, 1), np.float32)
            )
            constants = [np.array(value, dtype).reshape(shape)]
        names = [f"by{number}_{place}" for place in range(len(constants))]
        graph.initializer.extend(map(numpy_helper.from_array, constants, names))
        nodes.append(helper.make_node(kind, [last, *names], [made], **extra))
        last = last if kind == "Shape" else made
    for node in graph.node:
        node.input[:] = [last if name == first else name for name in node.input]
    rest = list(graph.node)
    del graph.node[:]
    graph.node.extend([*nodes, *rest])
    path.write_bytes(model.SerializeToString())
    return path


def constant_model(
    path: Path,
    *outputs: np.ndarray,
    size: tuple[int, int] = (64, 64),
    metadata: Mapping[str, str] | None = None,
    dtype: type = np.float32,
) -> Path:
    """A model that answers every (1, 3, height, width) image with the same arrays; ``size`` is (width, height)."""
    names = [f"output{index}" for index in range(len(outputs))]
    return save(
        path,
        [helper.make_node("Identity", [f"c_{name}"], [name]) for name in names],
        inputs={"images": (1, 3, size[1], size[0])},
        outputs={name: value.shape for name, value in zip(names, outputs, strict=True)},
        constants={f"c_{name}": value.astype(dtype) for name, value in zip(names, outputs, strict=True)},
        metadata=metadata,
        dtype=dtype,
    )


def cells(size: tuple[int, int], strides: Sequence[int] = STRIDES) -> np.ndarray:
    """(A, 3): column, row and stride of every cell, stride by stride, row by row."""
    return np.array(
        [(x, y, s) for s in strides for y in range(size[1] // s) for x in range(size[0] // s)], np.float32
    )


def colour_detector(
    path: Path,
    head: str,
    *,
    size: tuple[int, int] | None = (64, 64),
    metadata: Mapping[str, str] | None = None,
    dtype: type = np.float32,
) -> Path:
    """A detector of colours with a ``yolox`` head (any size) or an ``ultralytics`` head (fixed size).

    YOLOX sees 0…255 and scores channel/255; Ultralytics sees 0…1.
    """
    yolox = head == "yolox"
    weights = np.zeros((8, 3, 1, 1), dtype)
    weights[5:, :, 0, 0] = np.eye(3) / (255 if yolox else 1)
    nodes, constants = [], {"w": weights, "flat": np.array([1, 8, -1], np.int64)}
    constants["b"] = np.array([0.5, 0.5, 0, 0, 1, 0, 0, 0], dtype)
    for s in STRIDES:
        nodes += [
            helper.make_node("AveragePool", ["images"], [f"p{s}"], kernel_shape=[s, s], strides=[s, s]),
            helper.make_node("Conv", [f"p{s}", "w", "b"], [f"c{s}"]),
            helper.make_node("Reshape", [f"c{s}", "flat"], [f"r{s}"]),
        ]
    nodes.append(helper.make_node("Concat", [f"r{s}" for s in STRIDES], ["columns"], axis=2))
    width, height = size or ("W", "H")
    if yolox:
        nodes.append(helper.make_node("Transpose", ["columns"], ["output"], perm=[0, 2, 1]))
        shape: Shape = (1, "A", 8)
    else:
        assert size is not None
        grid = cells(size)
        centre = (grid[:, :2] + 0.5) * grid[:, 2:]
        constants["boxes"] = np.concatenate([centre.T, grid[:, [2, 2]].T])[None].astype(dtype)
        constants |= {n: np.array([v], np.int64) for n, v in (("from", 5), ("to", 8), ("axis", 1))}
        nodes.append(helper.make_node("Slice", ["columns", "from", "to", "axis"], ["scores"]))
        nodes.append(helper.make_node("Concat", ["boxes", "scores"], ["output"], axis=1))
        shape = (1, 7, len(grid))
    return save(
        path,
        nodes,
        inputs={"images": (1, 3, height, width)},
        outputs={"output": shape},
        constants=constants,
        metadata=metadata,
        dtype=dtype,
    )


def colour_classifier(
    path: Path,
    *,
    classes: int = 3,
    batch: int | str = "N",
    channels_last: bool = False,
    softmax: bool = False,
    sigmoid: bool = False,
    side: int | str = 32,
    gain: float = 10.0,
    metadata: Mapping[str, str] | None = None,
    dtype: type = np.float32,
) -> Path:
    """A classifier whose score of class k is ``gain`` times the mean of input channel k; other classes score 0."""
    weights = np.zeros((3, classes), dtype)
    weights[:, :3] = np.eye(3) * gain
    nodes = [helper.make_node("Transpose", ["input"], ["chw"], perm=[0, 3, 1, 2])] if channels_last else []
    nodes += [
        helper.make_node("GlobalAveragePool", ["chw" if channels_last else "input"], ["mean"]),
        helper.make_node("Flatten", ["mean"], ["flat"]),
        helper.make_node("MatMul", ["flat", "w"], ["logits" if softmax or sigmoid else "scores"]),
    ]
    if softmax:
        nodes.append(helper.make_node("Softmax", ["logits"], ["scores"], axis=1))
    if sigmoid:
        nodes.append(helper.make_node("Sigmoid", ["logits"], ["scores"]))
    return save(
        path,
        nodes,
        inputs={"input": (batch, side, side, 3) if channels_last else (batch, 3, side, side)},
        outputs={"scores": (batch, classes)},
        constants={"w": weights},
        metadata=metadata,
        dtype=dtype,
    )


def failing_in_the_light(path: Path, *, size: tuple[int, int] = (320, 192)) -> Path:
    """A colour detector of the YOLOX kind whose run raises on any picture with a mean of 128 or more (of 255)."""
    model = onnx.load(
        colour_detector(path, "yolox", size=size, metadata={"names": "['blue', 'green', 'red']"})
    )
    (output,) = model.graph.output
    model.graph.node[-1].output[0] = "plain"
    model.graph.initializer.extend(
        numpy_helper.from_array(value, name)
        for name, value in {"half": np.float32(1 / 128), "table": np.zeros(1, np.float32)}.items()
    )
    model.graph.node.extend(
        [
            helper.make_node("ReduceMean", ["images"], ["mean"], keepdims=0),
            helper.make_node("Mul", ["mean", "half"], ["brightness"]),
            helper.make_node("Cast", ["brightness"], ["index"], to=TensorProto.INT64),
            helper.make_node("Gather", ["table", "index"], ["nothing"]),  # of one place: 1 is outside
            helper.make_node("Add", ["plain", "nothing"], [output.name]),
        ]
    )
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path
