"""Model files that somebody has prepared: what they declare, where their weights are, what their name says."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from hvt_common.errors import UserError
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from media.onnx_models import constant_model

ONE_THREAD = ModelSettings(threads=1)
PORT = helper.make_tensor_value_info


def written(path: Path, nodes, inputs, outputs, initialisers=()) -> Path:
    """A model file that nobody has checked."""
    graph = helper.make_graph(nodes, "prepared", inputs, outputs, list(initialisers))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def same(path: Path, *, inputs=1, outputs=1, shape=(1, 3, 8, 8)) -> Path:
    """A model that gives back what it gets."""
    ins = [PORT(f"x{n}", TensorProto.FLOAT, shape) for n in range(inputs)]
    outs = [PORT(f"y{n}", TensorProto.FLOAT, shape) for n in range(outputs)]
    nodes = [helper.make_node("Identity", [f"x{n % inputs}"], [f"y{n}"]) for n in range(max(inputs, outputs))]
    return written(
        path, nodes, ins, outs + [PORT(f"y{n}", TensorProto.FLOAT, shape) for n in range(outputs, inputs)]
    )


def sentence(path: Path) -> str:
    """Why it is refused."""
    with pytest.raises(UserError) as caught:
        open_model(path, settings=ONE_THREAD)
    said = str(caught.value)
    assert str(path) in said
    assert "\n" not in said
    return said


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        ({"inputs": 65}, "65 inputs; 1 to 64"),
        ({"outputs": 65}, "65 outputs; 1 to 64"),
        ({"shape": (1, 3, 200_000, 200_000)}, "1.2e+11 numbers"),
        ({"shape": (2**40, "N")}, "1.1e+12 numbers"),
        ({"shape": (1,) * 9}, "9 axes"),
    ],
)
def test_absurd_ports_are_refused(tmp_path, declared, words):
    """The first frame would ask for a hundred gigabytes, in flight."""
    assert words in sentence(same(tmp_path / "m.onnx", **declared))


def test_a_large_picture_is_no_absurd_port(tmp_path):
    """A detector for 4K pictures could not be used."""
    model = open_model(same(tmp_path / "m.onnx", shape=(1, 3, 2176, 3840)), settings=ONE_THREAD)
    assert model.inputs[0].shape == (1, 3, 2176, 3840)


def weight(name: str, *, location: str | None = None) -> TensorProto:
    """Four numbers, in the file or said to be in another."""
    if location is None:
        return numpy_helper.from_array(np.ones(4, np.float32), name)
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="offset", value="0")
    tensor.external_data.add(key="location", value=location)
    return tensor


def adding(folder: Path, tensor: TensorProto, *, where: str) -> Path:
    """A model that adds a weight, which stands in one of the places that ONNX has for it."""
    port = [PORT("x", TensorProto.FLOAT, [4])], [PORT("y", TensorProto.FLOAT, [4])]
    add = helper.make_node("Add", ["x", "w"], ["y"])
    constant = helper.make_node("Constant", [], ["w"], value=tensor)
    if where == "initialiser":
        return written(folder / "m.onnx", [add], *port, [tensor])
    if where == "constant":
        return written(folder / "m.onnx", [constant, add], *port)
    yes = numpy_helper.from_array(np.array(True), "yes")
    branch = helper.make_graph([constant], "branch", [], [PORT("w", TensorProto.FLOAT, [4])])
    choice = helper.make_node("If", ["yes"], ["v"], then_branch=branch, else_branch=branch)
    return written(folder / "m.onnx", [choice, helper.make_node("Add", ["x", "v"], ["y"])], *port, [yes])


@pytest.mark.parametrize("where", ["initialiser", "constant", "branch"])
@pytest.mark.parametrize("location", ["beside.bin", "../outside.bin", "/etc/hostname", "folder/link.bin", ""])
def test_weights_in_another_file_are_refused_wherever_they_are_named(tmp_path, where, location):
    """A model from elsewhere could read a file of the user's, or be another model than the one that was checked."""
    folder = tmp_path / "models"
    (folder / "folder").mkdir(parents=True)
    for name in ("models/beside.bin", "outside.bin"):
        (tmp_path / name).write_bytes(np.ones(4, np.float32).tobytes())
    (folder / "folder/link.bin").symlink_to(tmp_path / "outside.bin")
    said = sentence(adding(folder, weight("w", location=location), where=where))
    assert f"keeps weights in another file ({location!r})" in said
    assert "external_data=False in torch.onnx.export" in said
    assert "onnx.save(onnx.load(" in said


@pytest.mark.parametrize("where", ["initialiser", "constant", "branch"])
def test_weights_in_the_file_itself_are_taken(tmp_path, where):
    """No model could be opened any more."""
    model = open_model(adding(tmp_path, weight("w"), where=where), settings=ONE_THREAD)
    assert model.run(np.zeros(4, np.float32))[0].tolist() == [1, 1, 1, 1]


def test_a_model_is_read_as_onnx_whatever_its_name_ends_in(tmp_path):
    """A name would choose the parser: .ort is another format with another one."""
    good = constant_model(tmp_path / "good.onnx", np.ones((1, 2)))
    for name in ("renamed.ort", "renamed.pt", "renamed"):
        path = tmp_path / name
        path.write_bytes(good.read_bytes())
        assert len(open_model(path, settings=ONE_THREAD).outputs) == 1
    pickled = tmp_path / "pickle.onnx"
    pickled.write_bytes(
        b"\x80\x04\x95\x1d\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R."
    )
    assert "is not an ONNX file" in sentence(pickled)


def test_every_truncation_of_a_model_is_refused_or_opens(tmp_path):
    """A download that broke off would end the process."""
    whole = adding(tmp_path, weight("w"), where="branch").read_bytes()
    path, refused = tmp_path / "cut.onnx", 0
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            open_model(path, settings=ONE_THREAD)
        except UserError:
            refused += 1
    assert refused > 0.9 * len(whole)


def test_messages_nested_without_end_are_refused(tmp_path):
    """A few kilobytes would end the process in a stack that ran over."""
    body = b""
    for number in range(300):  # an attribute with a graph with a node with an attribute …
        field = (b"\x32", b"\x2a", b"\x0a")[number % 3]
        body = field + _varint(len(body)) + body
    path = tmp_path / "deep.onnx"
    path.write_bytes(b"\x08\x08\x3a" + _varint(len(body)) + body)
    assert "deep" in sentence(path)


def _varint(number: int) -> bytes:
    data = b""
    while number > 0x7F:
        data, number = data + bytes([number & 0x7F | 0x80]), number >> 7
    return data + bytes([number])


def test_a_constant_that_would_fill_the_memory_is_not_made_when_the_model_is_opened(tmp_path):
    """A file of 300 bytes would take gigabytes before the flight began."""
    shape = numpy_helper.from_array(np.array([30_000, 30_000], np.int64), "shape")
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ReduceMax", ["zeros"], ["zero"], keepdims=0),
        helper.make_node("Add", ["x", "zero"], ["y"]),
    ]
    port = [PORT("x", TensorProto.FLOAT, [4])], [PORT("y", TensorProto.FLOAT, [4])]
    path = written(tmp_path / "m.onnx", nodes, *port, [shape])
    onnx.checker.check_model(str(path))
    script = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from hvt_common.inference.runtimes.model import ModelSettings, open_model\n"
        "open_model(Path(sys.argv[1]), settings=ModelSettings(threads=1))\n"
        # Not ru_maxrss: a child begins with that of the process that started it.
        "print(re.search(r'VmHWM:\\s+(\\d+)', Path('/proc/self/status').read_text())[1])\n"
    )
    limit = lambda: resource.setrlimit(resource.RLIMIT_CPU, (60, 60))  # noqa: E731
    ended = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        capture_output=True,
        text=True,
        preexec_fn=limit,
        check=True,
    )
    assert int(ended.stdout) < 1_500_000, "kilobytes; the constant alone would have 3.6 GB"
