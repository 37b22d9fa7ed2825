"""Weights of an ONNX graph in half of their bytes; YOLOX's first layers as single convolutions, stripe by stripe."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

_SMALL = 64  # arrays up to this many numbers stay float32: they weigh nothing
_STRIPES = 8
"""A picture's height is a multiple of 32: of 4 in each, one row behind two convolutions of stride 2."""
_STRIPED_LAYERS = 3


def halve(graph: onnx.GraphProto) -> None:
    """Store large float32 weights as float16, each behind a Cast that onnxruntime folds away at load."""
    casts = []
    for weight in graph.initializer:
        values = numpy_helper.to_array(weight)
        if values.dtype != np.float32 or values.size <= _SMALL:
            continue
        name = weight.name
        weight.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
        casts.append(
            helper.make_node("Cast", [f"{name}.half"], [name], name=f"{name}.widen", to=TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)


def unfolded(weight: np.ndarray) -> np.ndarray:
    """A convolution of 3x3 over 2x2 squares folded into 12 channels, as one of 6x6 over the pixels themselves.

    It computes the same in a quarter of the time on a CPU.
    """
    squares = weight.reshape(len(weight), 2, 2, 3, 3, 3)  # out, x, y, channel, row, column
    return squares.transpose(0, 3, 4, 2, 5, 1).reshape(len(weight), 3, 6, 6)


def unfold_stem(graph: onnx.GraphProto, images: str) -> None:
    """Let the graph's first convolution take ``images`` itself; the nodes that folded them lose their use."""
    weights = {one.name: one for one in graph.initializer}
    for node in graph.node:
        if node.op_type == "Conv" and node.input[1] in weights:
            values = numpy_helper.to_array(weights[node.input[1]])
            if values.shape[1:] == (12, 3, 3):
                name = node.input[1]
                weights[name].CopyFrom(numpy_helper.from_array(np.ascontiguousarray(unfolded(values)), name))
                node.input[0] = images
                del node.attribute[:]
                node.attribute.extend(
                    helper.make_attribute(key, value)
                    for key, value in (("kernel_shape", [6, 6]), ("strides", [2, 2]), ("pads", [2, 2, 2, 2]))
                )
            return


def stripe_stem(graph: onnx.GraphProto, images: str) -> None:
    """Let the first layers take one stripe of ``images`` after the other, which gives the same numbers.

    Behind the first convolution lie the network's largest planes: 67 of 75 MB at 1920x1088. A stripe takes with it
    the rows beyond its edges that it depends on, four above and two below.
    """
    layers, out = _stem(graph, images)
    if not layers:  # it is in stripes
        return
    own = f"{images}_stripe_"
    numbers = np.arange(_STRIPES)
    tables = {
        "axis": [2],
        "count": [_STRIPES],
        "first": numbers,
        "above": np.where(numbers > 0, 4, 0),
        "next": numbers + 1,
        "below": np.where(numbers < _STRIPES - 1, 2, 0),
    }
    graph.initializer.extend(
        numpy_helper.from_array(np.asarray(table, np.int64), own + key) for key, table in tables.items()
    )
    begins, ends = ([f"{own}{key}{number}" for number in numbers] for key in ("begin", "end"))
    steps = (
        ("Div", ("high", "count"), "rows"),
        ("Mul", ("rows", "first"), "tops"),
        ("Sub", ("tops", "above"), "begin"),
        ("Mul", ("rows", "next"), "bottoms"),
        ("Add", ("bottoms", "below"), "end"),
    )
    nodes = [
        helper.make_node("Shape", [images], [f"{own}high"], start=2, end=3),
        *(helper.make_node(kind, [own + one for one in of], [own + to]) for kind, of, to in steps),
        helper.make_node("Split", [f"{own}begin"], begins, axis=0),
        helper.make_node("Split", [f"{own}end"], ends, axis=0),
    ]
    for number, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        names = {one: f"{own}{number}_{one}" for one in (images, *(layer.output[0] for layer in layers))}
        nodes.append(helper.make_node("Slice", [images, begin, end, f"{own}axis"], [names[images]]))
        nodes += [_of_stripe(layer, names, number) for layer in layers]
    nodes.append(helper.make_node("Concat", [f"{own}{number}_{out}" for number in numbers], [out], axis=2))
    others = [node for node in graph.node if node not in layers]
    place = next(index for index, node in enumerate(others) if out in node.input)
    del graph.node[:]
    graph.node.extend([*others[:place], *nodes, *others[place:]])


def _stem(graph: onnx.GraphProto, images: str) -> tuple[list[onnx.NodeProto], str]:
    # The first convolutions, each with its activation, and the name of the last one's output.
    layers: list[onnx.NodeProto] = []
    out = images
    for _ in range(_STRIPED_LAYERS):
        layers += [node for node in graph.node if node.op_type == "Conv" and out == node.input[0]]
        if not layers:
            break
        activation = [node for node in graph.node if layers[-1].output[0] in node.input]
        layers += activation
        out = activation[-1].output[0]
    return layers, out


def _of_stripe(layer: onnx.NodeProto, names: dict[str, str], number: int) -> onnx.NodeProto:
    # A layer with the names of a stripe; only at the picture's own edges does it see beyond them.
    node = onnx.NodeProto()
    node.CopyFrom(layer)
    node.name = names[layer.output[0]]
    node.input[:] = [names.get(name, name) for name in layer.input]
    node.output[:] = [names[layer.output[0]]]
    for attribute in node.attribute:
        if attribute.name == "pads":
            top, left, bottom, right = attribute.ints
            top, bottom = top * (number == 0), bottom * (number == _STRIPES - 1)
            attribute.ints[:] = [top, left, bottom, right]
    return node
