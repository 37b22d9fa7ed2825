"""Tiny ONNX graphs that find coloured squares exactly, and write them as each family of detectors does.

A graph finds class k where a pixel has the k-th of `COLOURS` in the range and the order of channels that its family
is fed, and reports the bounding box of these pixels. So the right boxes and classes are known, and a wrong range,
order, fit or form of box shows.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from media.onnx_models import cells

COLOURS = ((1, 0, 0), (0, 0, 1))
"""(red, green, blue) of class 0 and 1."""
SQUARES = ((64, 32, 160, 96), (192, 96, 288, 160))
"""x1 y1 x2 y2 of class 0 and class 1 in `picture`."""
_SIDE, _CONFIDENCES = (320, 320), (0.9, 0.8)
_KINDS = len(COLOURS)
_Tensor = str


def picture() -> np.ndarray:
    """(192, 320, 3) uint8 BGR with a square of each class on grey."""
    image = np.full((192, 320, 3), 100, np.uint8)
    for (x1, y1, x2, y2), colour in zip(SQUARES, COLOURS, strict=True):
        image[y1:y2, x1:x2] = np.array(colour[::-1]) * 255
    return image


class Graph:
    """Builds a graph node by node."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def const(self, value: object, dtype: type = np.float32) -> _Tensor:
        name = f"c{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.array(value, dtype), name))
        return name

    def ints(self, *values: int) -> _Tensor:
        return self.const(values, np.int64)

    def op(self, kind: str, *inputs: _Tensor, **attributes: object) -> _Tensor:
        name = f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def columns(self, table: _Tensor, first: int, last: int) -> _Tensor:
        return self.op("Slice", table, self.ints(first), self.ints(last), self.ints(1))

    def batch(self, tensor: _Tensor) -> _Tensor:
        return self.op("Unsqueeze", tensor, self.ints(0))

    def find(self, image: _Tensor, *, bgr: bool = False, top: float = 1.0) -> tuple[_Tensor, _Tensor]:
        """(2, 4) x1 y1 x2 y2 in input pixels and (2,) scores, 0 where a colour is not there; ``image`` is NCHW."""
        boxes, scores = [], []
        for colour, confidence in zip(COLOURS, _CONFIDENCES, strict=True):
            wanted = colour[::-1] if bgr else colour
            inside = None
            for channel, value in enumerate(wanted):
                plane = self.op("Gather", image, self.ints(channel), axis=1)
                low, high = (0.7 * top, 1.1 * top) if value else (-0.1 * top, 0.3 * top)
                good = self.op(
                    "And",
                    self.op("Greater", plane, self.const(low)),
                    self.op("Less", plane, self.const(high)),
                )
                inside = good if inside is None else self.op("And", inside, good)
            assert inside is not None
            mask = self.op("Cast", inside, to=TensorProto.FLOAT)
            ends = [self._ends(mask, axis) for axis in (3, 2)]
            parts = (ends[0][0], ends[1][0], ends[0][1], ends[1][1])
            boxes.append(self.op("Reshape", self.op("Concat", *parts, axis=0), self.ints(1, 4)))
            some = self.op("Reshape", self.op("ReduceMax", mask, keepdims=0), self.ints(1))
            scores.append(self.op("Mul", some, self.const(confidence)))
        return self.op("Concat", *boxes, axis=0), self.op("Concat", *scores, axis=0)

    def _ends(self, mask: _Tensor, axis: int) -> tuple[_Tensor, _Tensor]:
        """(1,) first and (1,) one past the last of the mask along an axis."""
        rest = [other for other in (0, 1, 2, 3) if other != axis]
        line = self.op("ReduceMax", mask, axes=rest, keepdims=0)
        length = self.op("Cast", self.op("Shape", line), to=TensorProto.FLOAT)
        first = self.op("Cast", self.op("ArgMax", line, axis=0, keepdims=1), to=TensorProto.FLOAT)
        last = self.op("ArgMax", line, axis=0, keepdims=1, select_last_index=1)
        beyond = self.op("Add", self.op("Cast", last, to=TensorProto.FLOAT), self.const([1.0]))
        return first, self.op("Min", beyond, length)

    def centred(self, boxes: _Tensor) -> _Tensor:
        """Centre x, y, width and height of (N, 4) corners."""
        low, high = self.columns(boxes, 0, 2), self.columns(boxes, 2, 4)
        middle = self.op("Mul", self.op("Add", low, high), self.const(0.5))
        return self.op("Concat", middle, self.op("Sub", high, low), axis=1)

    def shares(self, boxes: _Tensor) -> _Tensor:
        """(N, 4) in pixels as shares of the input."""
        return self.op("Div", boxes, self.const([*_SIDE, *_SIDE]))

    def by_class(self, scores: _Tensor) -> _Tensor:
        """(2, 2) with the score of row k in column k."""
        return self.op("Mul", self.const(np.eye(_KINDS)), self.op("Reshape", scores, self.ints(_KINDS, 1)))

    def column(self, scores: _Tensor) -> _Tensor:
        """(2, 1) of (2,)."""
        return self.op("Reshape", scores, self.ints(_KINDS, 1))

    def padded(self, table: _Tensor, rows: np.ndarray) -> _Tensor:
        return self.op("Concat", table, self.const(rows), axis=0)


_Outputs = Mapping[str, tuple[_Tensor, int]]
_GRID = cells(_SIDE)
_MIDDLES = (_GRID[:, :2] + 0.5) * _GRID[:, 2:]
_SIDES = _GRID[:, [2, 2]]
_WEAK = 1e-3


def _a_row_a_cell(*columns: np.ndarray, times: int = 1) -> np.ndarray:
    """Rows of all cells but the first two, whose places the squares take."""
    return np.tile(np.hstack(columns), (times, 1))[_KINDS:]


def _scores(count: int = _KINDS) -> np.ndarray:
    return np.full((len(_GRID), count), _WEAK)


def _with_cells(*, objectness: float | None, times: int = 1) -> Callable[..., _Outputs]:
    def build(graph: Graph, image: _Tensor, *, bgr: bool = False, top: float = 1.0) -> _Outputs:
        boxes, scores = graph.find(image, bgr=bgr, top=top)
        parts = [graph.centred(boxes)]
        rest = [_MIDDLES, _SIDES]
        if objectness is not None:
            parts.append(graph.const(np.ones((_KINDS, 1))))
            rest.append(np.full((len(_GRID), 1), objectness))
        table = graph.op("Concat", *parts, graph.by_class(scores), axis=1)
        return {"output": (graph.batch(graph.padded(table, _a_row_a_cell(*rest, _scores(), times=times))), 1)}

    return build


def _yolox(graph: Graph, image: _Tensor) -> _Outputs:
    """Raw: the first two cells, 0,0 and 1,0 of stride 8, hold both squares."""
    boxes, scores = graph.find(image, bgr=True, top=255)
    centred = graph.op("Div", graph.centred(boxes), graph.const(8.0))
    offset = graph.op("Sub", graph.columns(centred, 0, 2), graph.const([[0, 0], [1, 0]]))
    sides = graph.op("Log", graph.op("Max", graph.columns(centred, 2, 4), graph.const(1e-3)))
    table = graph.op(
        "Concat", offset, sides, graph.const(np.ones((_KINDS, 1))), graph.by_class(scores), axis=1
    )
    rest = _a_row_a_cell(np.full((len(_GRID), 2), 0.5), np.zeros((len(_GRID), 2)), _scores(3))
    return {"output": (graph.batch(graph.padded(table, rest)), 1)}


def _yolox_decoded(graph: Graph, image: _Tensor) -> _Outputs:
    return _with_cells(objectness=_WEAK)(graph, image, bgr=True, top=255)


def _transposed(graph: Graph, image: _Tensor, *, relative: bool = False) -> _Outputs:
    boxes, scores = graph.find(image)
    centred, middles, sides = graph.centred(boxes), _MIDDLES, _SIDES
    if relative:
        centred, middles, sides = graph.shares(centred), middles / _SIDE, sides / _SIDE
    table = graph.op("Concat", centred, graph.by_class(scores), axis=1)
    table = graph.padded(table, _a_row_a_cell(middles, sides, _scores()))
    return {"output0": (graph.batch(graph.op("Transpose", table, perm=[1, 0])), 1)}


def _relative(graph: Graph, image: _Tensor) -> _Outputs:
    return _transposed(graph, image, relative=True)


def _yolov9(graph: Graph, image: _Tensor) -> _Outputs:
    """With its auxiliary branch first, which is less sure."""
    ((main, _),) = _transposed(graph, image).values()
    weaker = np.array([1, 1, 1, 1, *[0.8] * _KINDS]).reshape(1, -1, 1)
    return {"output0": (graph.op("Mul", main, graph.const(weaker)), 1), "output1": (main, 1)}


def _listed(graph: Graph, table: _Tensor, scores: _Tensor) -> _Tensor:
    """Of the squares, those that are there: from none to two rows."""
    there = graph.op("NonZero", graph.op("Greater", scores, graph.const(0.25)))
    return graph.op("Gather", table, graph.op("Reshape", there, graph.ints(-1)), axis=0)


_CLASSES = [[0.0], [1.0]]


def _few(rest: Sequence[float]) -> np.ndarray:
    """98 rows in the middle of the picture, with these behind the box."""
    return np.tile([0.5, 0.5, 0.1, 0.1, *rest], (98, 1))


def _rows(*columns: str, behind: np.ndarray | None = None, batch: bool = True) -> Callable[..., _Outputs]:
    """A row an object: of these that are there, or with the rows ``behind`` them."""

    def build(graph: Graph, image: _Tensor) -> _Outputs:
        boxes, scores = graph.find(image)
        made = {
            "box": lambda: boxes,
            "centred": lambda: graph.shares(graph.centred(boxes)),
            "score": lambda: graph.column(scores),
            "scores": lambda: graph.by_class(scores),
            "class": lambda: graph.const(_CLASSES),
            "zero": lambda: graph.const(np.zeros((_KINDS, 1))),
        }
        table = graph.op("Concat", *(made[one]() for one in columns), axis=1)
        table = _listed(graph, table, scores) if behind is None else graph.padded(table, behind)
        return {"output0": (graph.batch(table) if batch else table, 1)}

    return build


def _yolo_nas(graph: Graph, image: _Tensor) -> _Outputs:
    boxes, scores = graph.find(image)
    rest = _a_row_a_cell(_MIDDLES - _SIDES / 2, _MIDDLES + _SIDES / 2)
    return {
        "out_boxes": (graph.batch(graph.padded(boxes, rest)), 1),
        "out_scores": (graph.batch(graph.padded(graph.by_class(scores), _a_row_a_cell(_scores()))), 1),
    }


def _nms_lists(graph: Graph, image: _Tensor) -> _Outputs:
    boxes, scores = graph.find(image)
    junk = np.array([[5.0, 5, 90, 90]] * 8)
    return {
        "num_dets": (graph.const([[_KINDS]], np.int32), TensorProto.INT32),
        "det_boxes": (graph.batch(graph.padded(boxes, junk)), 1),
        "det_scores": (graph.batch(graph.padded(scores, np.full(8, 0.99))), 1),
        "det_classes": (graph.const([[0, 1, *[0] * 8]], np.int32), TensorProto.INT32),
    }


def _rt_detr(graph: Graph, image: _Tensor) -> _Outputs:
    boxes, scores = graph.find(image)
    table = graph.op("Clip", graph.by_class(scores), graph.const(1e-4), graph.const(0.9999))
    logits = graph.op("Log", graph.op("Div", table, graph.op("Sub", graph.const(1.0), table)))
    rest = np.hstack([np.full((98, 2), 0.5), np.full((98, 2), 0.1)])
    return {
        "pred_logits": (graph.batch(graph.padded(logits, np.full((98, _KINDS), -6.0))), 1),
        "pred_boxes": (graph.batch(graph.padded(graph.shares(graph.centred(boxes)), rest)), 1),
    }


def _deployed(graph: Graph, image: _Tensor) -> _Outputs:
    """In the pixels of the size that stands in the second input, as D-FINE's own export."""
    boxes, scores = graph.find(image)
    size = graph.op("Cast", "orig_target_sizes", to=TensorProto.FLOAT)
    boxes = graph.op("Mul", graph.shares(boxes), graph.op("Concat", size, size, axis=1))
    return {
        "labels": (graph.const([[0, 1]], np.int64), TensorProto.INT64),
        "boxes": (graph.batch(boxes), 1),
        "scores": (graph.batch(scores), 1),
    }


def _ssd(graph: Graph, image: _Tensor) -> _Outputs:
    """The row with image -1 ends the list; what follows is none."""
    boxes, scores = graph.find(image, bgr=True, top=255)
    first = graph.const([[0.0, 0], [0, 1]])
    table = graph.op("Concat", first, graph.column(scores), graph.shares(boxes), axis=1)
    table = graph.padded(table, np.array([[-1.0, 0, 0, 0, 0, 0, 0], [0, 0, 0.9, 0.1, 0.1, 0.2, 0.2]]))
    return {"detection_out": (graph.op("Unsqueeze", table, graph.ints(0, 1)), 1)}


def _atss(graph: Graph, image: _Tensor) -> _Outputs:
    boxes, scores = graph.find(image, bgr=True, top=255)
    table = graph.op("Concat", boxes, graph.column(scores), axis=1)
    labels = _listed(graph, graph.const([0, 1], np.int64), scores)
    return {"boxes": (_listed(graph, table, scores), 1), "labels": (labels, TensorProto.INT64)}


def _tf_lists(graph: Graph, image: _Tensor) -> _Outputs:
    boxes, scores = graph.find(image, top=255)
    turned = graph.op("Gather", graph.shares(boxes), graph.ints(1, 0, 3, 2), axis=1)
    return {
        "detection_boxes": (graph.batch(turned), 1),
        "detection_scores": (graph.batch(scores), 1),
        "detection_classes": (graph.const([[1.0, 2.0]]), 1),
        "num_detections": (graph.const([2.0]), 1),
    }


def _padded_lists(graph: Graph, image: _Tensor) -> _Outputs:
    """Likewise, with a count that says more than there is."""
    boxes, scores = graph.find(image)
    more = np.full((98, 5), -1.0, np.float32)
    kinds = np.concatenate([[0, 1], np.full(98, -1)])[None]
    return {
        "num_dets": (graph.const([[100]], np.int32), TensorProto.INT32),
        "det_boxes": (graph.batch(graph.padded(boxes, more[:, :4])), 1),
        "det_scores": (graph.batch(graph.op("Concat", scores, graph.const(more[:, 4]), axis=0)), 1),
        "det_classes": (graph.const(kinds, np.int32), TensorProto.INT32),
    }


def _tf_eight(graph: Graph, image: _Tensor) -> _Outputs:
    """As the Object Detection API saves a model: what it came from stands beside."""
    beside = {
        "detection_anchor_indices": np.zeros((1, 2)),
        "detection_multiclass_scores": np.zeros((1, 2, 3)),
        "raw_detection_boxes": np.full((1, 50, 4), 0.5),
        "raw_detection_scores": np.full((1, 50, 3), 0.1),
    }
    return _tf_lists(graph, image) | {name: (graph.const(value), 1) for name, value in beside.items()}


FAMILIES: Mapping[str, tuple[str, Callable[[Graph, _Tensor], _Outputs]]] = {
    "yolox": ("yolox", _yolox),
    "yolox-decoded": ("yolox-decoded", _yolox_decoded),
    "yolov5": ("yolov5", _with_cells(objectness=_WEAK, times=3)),
    "yolov6": ("yolov6", _with_cells(objectness=1.0)),
    "yolov8": ("yolov8", _transposed),
    "yolov8, relative": ("yolov8", _relative),
    "yolov8, transposed": ("yolov8-rows", _with_cells(objectness=None)),
    "yolov9, both branches": ("yolov8", _yolov9),
    "yolov10": ("end-to-end", _rows("box", "score", "class", behind=np.zeros((98, 6)))),
    "NMS inside": ("end-to-end", _rows("box", "score", "class")),
    "yolov7, NMS inside": ("yolov7-rows", _rows("zero", "box", "class", "score", batch=False)),
    "yolo-nas": ("yolo-nas", _yolo_nas),
    "yolo-nas, NMS inside": ("nas-rows", _rows("zero", "box", "score", "class", batch=False)),
    "TensorRT's NMS": ("nms-lists", _nms_lists),
    "rt-detr": ("rt-detr", _rt_detr),
    "rt-detr, rows of six": ("rt-detr-rows", _rows("centred", "score", "class", behind=_few([_WEAK, 0]))),
    "rt-detr, a score a class": ("rt-detr-rows", _rows("centred", "scores", behind=_few([_WEAK] * _KINDS))),
    "d-fine, deployed": ("labels-boxes-scores", _deployed),
    "ssd": ("ssd", _ssd),
    "atss": ("atss", _atss),
    "tensorflow": ("tf-lists", _tf_lists),
    "tensorflow, eight outputs": ("tf-lists", _tf_eight),
    "NMS inside, -1 behind": ("end-to-end", _rows("box", "score", "class", behind=np.full((98, 6), -1.0))),
    "TensorRT's NMS, -1 behind": ("nms-lists", _padded_lists),
}
"""By what a user calls it: the head that it has, and what builds it."""

NEEDS_NAMES = ("yolox-decoded", "yolov8, transposed")
"""Told from each other by the number of names alone."""


def family_model(
    path: Path,
    family: str,
    *,
    channels_last: bool = False,
    dtype: int = TensorProto.FLOAT,
    metadata: Mapping[str, str] | None = None,
    side: Sequence[int | str] = _SIDE,
) -> Path:
    """Write a detector of `picture`'s squares in the form of a family."""
    graph = Graph()
    image = "images" if dtype == TensorProto.FLOAT else graph.op("Cast", "images", to=TensorProto.FLOAT)
    if channels_last:
        image = graph.op("Transpose", image, perm=[0, 3, 1, 2])
    outputs = FAMILIES[family][1](graph, image)
    for name, (tensor, _) in outputs.items():
        graph.nodes.append(helper.make_node("Identity", [tensor], [name]))
    width, height = side
    shape = [1, height, width, 3] if channels_last else [1, 3, height, width]
    inputs = [helper.make_tensor_value_info("images", dtype, shape)]
    if any("orig_target_sizes" in node.input for node in graph.nodes):
        inputs.append(helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [1, 2]))
    ports = [helper.make_tensor_value_info(name, element, None) for name, (_, element) in outputs.items()]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "family", inputs, ports, graph.weights),
        opset_imports=[helper.make_opsetid("", 13)],
        ir_version=8,
    )
    helper.set_model_props(model, dict(metadata or {}))
    path.write_bytes(model.SerializeToString())
    return path
