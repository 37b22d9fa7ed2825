"""The two networks of the embedded detector in one file."""

import re

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper, parser

from hvt_common.inference.heads.choose import anchor_count
from hvt_common.inference.runtimes.model import open_model
from hvt_common.inference.store import EMBEDDED_CLASSIFIER, EMBEDDED_DETECTOR, embedded_models
from hvt_train.__main__ import main
from hvt_train.learning.halve import stripe_stem

DETECTOR, CLASSIFIER = (embedded_models()[name] for name in (EMBEDDED_DETECTOR, EMBEDDED_CLASSIFIER))


@pytest.mark.realdata
def test_the_embedded_file_is_made_of_its_parts(data, tmp_path):
    """Who trains the aerial part again could not make the file that is embedded."""
    out = tmp_path / "joined.onnx"
    assert main(["join", str(DETECTOR), str(data / "models" / "yolox_nano.onnx"), "--out", str(out)]) == 0
    assert out.read_bytes() == DETECTOR.read_bytes()
    assert [one.name for one in tmp_path.iterdir()] == ["joined.onnx"]


def test_no_layer_of_the_embedded_file_takes_a_whole_picture():
    """Its largest planes lay behind the first: 33 MB each of a 1080p picture, half of the detector's memory."""
    graph = onnx.load(str(DETECTOR)).graph
    for images in ("images", "street_images"):
        users = [node.op_type for node in graph.node if images in node.input]
        assert users.count("Slice") >= 8
        assert "Conv" not in users


@pytest.mark.parametrize("height", [32, 96])
@pytest.mark.parametrize("activation", ["SiLU", "ReLU"])
def test_stripes_give_the_same_numbers(activation, height, tmp_path):
    """Each of them sees what lies beyond its edges, and only the picture's own edges are filled up."""
    rng = np.random.default_rng(1)
    shapes = {"first": (4, 3, 6, 6), "second": (4, 1, 3, 3), "third": (5, 4, 1, 1)}
    drawn = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    weights = [numpy_helper.from_array(values, name) for name, values in drawn.items()]
    text = """
      stem (float[1, 3, height, width] images) => (float[1, 5, h, w] out) {
        a = Conv <strides = [2, 2], pads = [2, 2, 2, 2]> (images, first)
        b = Sigmoid (a)
        c = Mul (a, b)
        d = Conv <strides = [2, 2], pads = [1, 1, 1, 1], group = 4> (c, second)
        e = Sigmoid (d)
        f = Mul (d, e)
        g = Conv (f, third)
        i = Sigmoid (g)
        j = Mul (g, i)
        out = Identity (j)
      }
    """
    if activation == "ReLU":
        text = re.sub(r"\w = Sigmoid \((\w)\)\s+(\w) = Mul \(.*\)", r"\2 = Relu (\1)", text)
    whole = parser.parse_graph(text)
    whole.initializer.extend(weights)
    striped = onnx.GraphProto()
    striped.CopyFrom(whole)
    stripe_stem(striped, "images")
    assert len(striped.node) > len(whole.node)
    picture = rng.normal(size=(1, 3, height, 64)).astype(np.float32)
    answers = []
    for number, graph in enumerate((whole, striped)):
        path = tmp_path / f"{number}.onnx"
        opset = [helper.make_opsetid("", 17)]
        onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(path))
        answers.append(open_model(path).run(picture)[0])
    assert np.array_equal(*answers)


@pytest.mark.parametrize("size", [(32, 32), (64, 96), (416, 416), (672, 384)])
def test_both_parts_give_one_row_a_cell_for_every_size(size):
    """A row too few, and boxes of the second part would stand in the wrong places."""
    ours, theirs = anchor_count(size, (8, 16, 32)), anchor_count(size, (16, 32, 64))
    rows = _rows(np.random.default_rng(1).integers(0, 255, (1, 3, *size[::-1])))
    assert rows.shape == (ours + theirs, 14)
    assert np.isfinite(rows).all()


def test_the_second_part_is_silent_without_colour():
    """In thermal pictures it sees people who are not there."""
    colour = np.random.default_rng(1).integers(0, 255, (1, 3, 96, 96))
    grey = np.repeat(colour[:, :1], 3, axis=1)
    first = anchor_count((96, 96), (8, 16, 32))
    assert _rows(colour)[first:, 4].max() > 0
    assert _rows(grey)[first:, 4].max() == 0
    assert _rows(grey)[:first, 4].max() > 0


def test_what_is_no_part_is_refused(tmp_path, capsys):
    """Half an hour later a detector would find nothing, and nobody would know why."""
    out = tmp_path / "out.onnx"
    for aerial, street, sentence in (
        (CLASSIFIER, DETECTOR, "a detector of hvt_train is expected"),
        (DETECTOR, CLASSIFIER, "has 0 levels of box, objectness and classes; YOLOX-nano has 3"),
        (DETECTOR, tmp_path / "none.onnx", "none.onnx"),
    ):
        assert main(["join", str(aerial), str(street), "--out", str(out)]) == 2
        said = capsys.readouterr().err
        assert sentence in said
        assert said.count("\n") == 1
    assert not out.exists()


def _rows(feed):
    return open_model(DETECTOR).run(feed.astype(np.float32))[0][0]
