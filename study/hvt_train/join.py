"""One file of two detectors: the aerial one, and YOLOX-nano with its COCO weights.

A network that learns views from above forgets views aslant, and the other way round: two networks know both.
The file has one input and one YOLOX head, as each of them has; to a program it is one detector.

YOLOX-nano (Ge et al., 2021; Megvii, Apache-2.0) knows objects of some size at eye level and aslant. It gets the
picture at half, where it costs four tenths of the aerial network, and its cells stand behind the
aerial ones: strides of 16, 32 and 64 pixels. Three rules keep it to its views:

* its objectness is raised, so that a box that its authors' program shows (from .3) counts here (``hvt.confidence``);
* a picture without colour is thermal, or of the night: there it sees people who are not there, and is not heard;
* a box around nearly the whole picture is no object.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import compose, helper, numpy_helper, parser, version_converter

from hvt_common.errors import UserError
from hvt_common.files import write_whole
from hvt_common.inference.class_names import COCO_NAMES
from hvt_common.inference.labels import metadata_labels
from hvt_train.learning.halve import halve, stripe_stem, unfold_stem

PREFIX = "street_"

_OWN = "own_output"
_STRIDES = (16, 32, 64)
"""Strides of its cells, pixels of the whole picture: 8, 16 and 32 of its input."""
_THEIR_CONFIDENCE = 0.3
_COCO_OF = {
    **{name: name for name in ("car", "truck", "bus", "bicycle")},
    "motor": "motorcycle",
    "pedestrian": "person",
}

# The picture, in grey (as the letterbox's border) to multiples of 64, at half: multiples of 32.
_SHRINK = """
shrink (float[1, 3, height, width] images) => (float[1, 3, h, w] street_images)
{
  street_size = Shape <start = 2> (images)
  street_cell = Constant <value = int64[1] {64}> ()
  street_negative = Neg (street_size)
  street_border = Mod (street_negative, street_cell)
  street_none = Constant <value = int64[6] {0, 0, 0, 0, 0, 0}> ()
  street_borders = Concat <axis = 0> (street_none, street_border)
  street_grey = Constant <value = float {114.0}> ()
  street_padded = Pad (images, street_borders, street_grey)
  street_whole = Add (street_size, street_border)
  street_two = Constant <value = int64[1] {2}> ()
  street_halves = Div (street_whole, street_two)
  street_planes = Constant <value = int64[2] {1, 3}> ()
  street_sizes = Concat <axis = 0> (street_planes, street_halves)
  street_images = Resize <mode = "linear"> (street_padded, , , street_sizes)
}
"""

# One level of its head, (1, 85, rows, columns): the cells inside the picture, as rows of our head.
_LEVEL = """
level (float[1, 85, h, w] street_level, int64[2] street_size, bool[1] street_colour, float[80, c] street_classes)
  => (float[1, n, m] street_rows)
{
  stride = Constant <value = int64[1] {STRIDE}> ()
  cells = Div (street_size, stride)
  zero = Constant <value = int64[2] {0, 0}> ()
  axes = Constant <value = int64[2] {2, 3}> ()
  inside = Slice (street_level, zero, cells, axes)
  shape = Constant <value = int64[3] {1, 85, -1}> ()
  flat = Reshape (inside, shape)
  rows = Transpose <perm = [0, 2, 1]> (flat)
  parts = Constant <value = int64[3] {4, 1, 80}> ()
  box, objectness, scores = Split <axis = 2> (rows, parts)
  halves = Constant <value = int64[2] {2, 2}> ()
  centre, logarithm = Split <axis = 2> (box, halves)
  strides = Exp (logarithm)
  length = Constant <value = float[1] {STRIDE.0}> ()
  lengths = Mul (strides, length)
  swapped = Constant <value = int64[2] {1, 0}> ()
  wide_high = Gather (street_size, swapped)
  sides = Cast <to = 1> (wide_high)
  shares = Div (lengths, sides)
  share = ReduceMin <axes = [2], keepdims = 1> (shares)
  most = Constant <value = float[1] {0.6}> ()
  fits = Less (share, most)
  heard = And (fits, street_colour)
  gate = Cast <to = 1> (heard)
  gain = Constant <value = float[1] {GAIN}> ()
  louder = Mul (objectness, gain)
  certain = Constant <value = float[1] {1.0}> ()
  bounded = Min (louder, certain)
  gated = Mul (bounded, gate)
  named = MatMul (scores, street_classes)
  street_rows = Concat <axis = 2> (box, gated, named)
}
"""

# Whether the picture has colour: the mean of |B - G| and |G - R| of every eighth pixel of every eighth line is 0 in a
# grey picture, and above 1 in the dullest daylight (wet asphalt).
_COLOUR = """
colour (float[1, 3, height, width] images) => (bool[1] street_colour)
{
  start = Constant <value = int64[2] {0, 0}> ()
  end = Constant <value = int64[2] {65536, 65536}> ()
  axes = Constant <value = int64[2] {2, 3}> ()
  steps = Constant <value = int64[2] {8, 8}> ()
  some = Slice (images, start, end, axes, steps)
  plane = Constant <value = int64[1] {1}> ()
  one = Constant <value = int64[1] {1}> ()
  two = Constant <value = int64[1] {2}> ()
  three = Constant <value = int64[1] {3}> ()
  none = Constant <value = int64[1] {0}> ()
  blue_green = Slice (some, none, two, plane)
  green_red = Slice (some, one, three, plane)
  difference = Sub (blue_green, green_red)
  distance = Abs (difference)
  mean = ReduceMean <keepdims = 0> (distance)
  least = Constant <value = float[1] {0.5}> ()
  street_colour = Greater (mean, least)
}
"""


def join(aerial: Path, street: Path, out: Path) -> None:
    """Write the file, whole or not at all; `UserError` where one is not of its kind.

    ``aerial`` is of `hvt_train.recipe`: a raw YOLOX head, ``classes`` and ``hvt.confidence`` in its metadata, which
    the new file takes over; of a file that was joined before it is the aerial part. ``street`` is YOLOX-nano as its
    authors export it: input ``images``, output (1, cells, 85).
    """
    ours = _aerial_part(onnx.load(str(aerial)))
    properties = {one.key: one.value for one in ours.metadata_props}
    classes = metadata_labels(properties)
    if classes is None or "hvt.confidence" not in properties:
        raise UserError(f"{aerial} has no classes or no hvt.confidence: a detector of hvt_train is expected")
    theirs, levels = _levels_of(onnx.load(str(street)), street, opset=ours.opset_import[0].version)
    halve(theirs)
    stripe_stem(ours.graph, "images")
    stripe_stem(theirs, f"{PREFIX}images")

    gain = float(properties["hvt.confidence"]) / _THEIR_CONFIDENCE
    nodes = [*ours.graph.node, *_nodes(_SHRINK), *_nodes(_COLOUR, own="colour_"), *theirs.node]
    for level, stride in zip(levels, _STRIDES, strict=True):
        text = _LEVEL.replace("STRIDE", str(stride)).replace("GAIN", f"{gain:.6f}")
        names = {"street_level": level, "street_rows": f"street_rows{stride}"}
        nodes += _nodes(text, own=f"level{stride}_", names=names)
    own = ours.graph.output[0].name
    for node in ours.graph.node:
        node.output[:] = [_OWN if name == own else name for name in node.output]
    rows = [_OWN, *(f"street_rows{stride}" for stride in _STRIDES)]
    nodes.append(helper.make_node("Concat", rows, [own], axis=1))
    weights = [*ours.graph.initializer, *theirs.initializer]
    weights.append(numpy_helper.from_array(_columns(classes), "street_classes"))

    graph = helper.make_graph(nodes, "joined", ours.graph.input, ours.graph.output, weights)
    model = helper.make_model(graph, opset_imports=ours.opset_import, ir_version=ours.ir_version)
    properties |= {"hvt.joined": "YOLOX-nano (Megvii, Apache-2.0), COCO weights", "hvt.enlarge_to": "1280"}
    helper.set_model_props(model, properties)
    model.producer_name = "hvt_train"
    onnx.checker.check_model(model)
    write_whole(out, model.SerializeToString())


def _aerial_part(model: onnx.ModelProto) -> onnx.ModelProto:
    """The model without the parts that an earlier `join` added."""
    graph, output = model.graph, model.graph.output[0].name
    parts = {name for node in graph.node if output in node.output for name in node.input}
    if _OWN not in parts:
        return model
    nodes = [
        node for node in graph.node if not node.output[0].startswith(PREFIX) and output not in node.output
    ]
    for node in nodes:
        node.output[:] = [output if name == _OWN else name for name in node.output]
    weights = [one for one in graph.initializer if not one.name.startswith(PREFIX)]
    part = helper.make_graph(nodes, graph.name, graph.input, graph.output, weights)
    aerial = helper.make_model(part, opset_imports=model.opset_import, ir_version=model.ir_version)
    helper.set_model_props(aerial, {one.key: one.value for one in model.metadata_props})
    return aerial


def _nodes(text: str, *, own: str = "", names: dict[str, str] | None = None) -> list[onnx.NodeProto]:
    """The nodes of a graph in ONNX's text form; its inner names get ``own`` before them."""
    known = names or {}

    def renamed(name: str) -> str:
        return known.get(
            name, name if not name or name.startswith((PREFIX, "images")) else PREFIX + own + name
        )

    nodes = list(parser.parse_graph(text.strip()).node)
    for node in nodes:
        node.input[:] = [renamed(name) for name in node.input]
        node.output[:] = [renamed(name) for name in node.output]
    return nodes


def _levels_of(model: onnx.ModelProto, path: Path, *, opset: int) -> tuple[onnx.GraphProto, list[str]]:
    """The graph up to its three levels (1, 85, rows, columns), all names with `PREFIX`; the names of the levels."""
    converted = version_converter.convert_version(model, opset)
    graph = compose.add_prefix(converted, PREFIX).graph
    unfold_stem(graph, f"{PREFIX}images")
    joined = {node.output[0]: node for node in graph.node if node.op_type == "Concat"}
    levels = [name for name, node in joined.items() if _is_level(node, graph)]
    if len(levels) != len(_STRIDES):
        raise UserError(f"{path} has {len(levels)} levels of box, objectness and classes; YOLOX-nano has 3")
    # The nodes behind them only put them into one list.
    needed, nodes = set(levels), []
    for node in reversed(graph.node):
        if needed.intersection(node.output):
            needed.update(node.input)
            nodes.append(node)
    del graph.node[:]
    graph.node.extend(reversed(nodes))
    return graph, levels


def _is_level(node: onnx.NodeProto, graph: onnx.GraphProto) -> bool:
    """Whether it joins a convolution (box) with two sigmoids (objectness, classes)."""
    kinds = {one.output[0]: one.op_type for one in graph.node}
    return [kinds.get(name) for name in node.input] == ["Conv", "Sigmoid", "Sigmoid"]


def _columns(classes: tuple[str, ...]) -> np.ndarray:
    """(80, classes) float32: 1 where a class of COCO is one of ours."""
    table = np.zeros((len(COCO_NAMES), len(classes)), np.float32)
    for column, name in enumerate(classes):
        if name in _COCO_OF:
            table[COCO_NAMES.index(_COCO_OF[name]), column] = 1
    return table
