"""Opening ONNX files that come from anywhere."""

import contextlib
import os
import resource
import sys
import threading
import time
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from hvt_common.errors import UserError
from hvt_common.inference.runtimes import model_file
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.runtimes.model_file import MAX_MODEL_BYTES, metadata_of
from hvt_common.runtime.process import with_lower_priority
from media.onnx_models import colour_detector, constant_model
from programs.processes import python

ONE_THREAD = ModelSettings(threads=1)


def test_a_model_says_its_ports_and_metadata_and_runs(tmp_path):
    """No head could be told; an input of another shape would be a traceback."""
    path = constant_model(tmp_path / "m.onnx", np.ones((1, 2)), np.zeros((1, 3)), metadata={"names": "[]"})
    model = open_model(path, settings=ONE_THREAD)
    assert [(port.name, port.shape) for port in model.outputs] == [("output0", (1, 2)), ("output1", (1, 3))]
    assert (model.inputs[0].shape, model.inputs[0].dtype) == ((1, 3, 64, 64), np.float32)
    assert model.metadata == {"names": "[]"}
    first, second = model.run(np.zeros((1, 3, 64, 64), np.float32))
    assert (first.tolist(), second.shape) == ([[1, 1]], (1, 3))
    with pytest.raises(UserError, match="does not run on a 1x3x32x32 input"):
        model.run(np.zeros((1, 3, 32, 32), np.float32))


@pytest.mark.skipif(sys.platform != "linux", reason="it is about Linux's niceness")
@pytest.mark.parametrize("threads", [1, 2])
def test_a_network_runs_below_everything_else(tmp_path, threads):
    """Video would wait for it, or for whoever waits for it with the interpreter's lock in hand."""
    others = {one.name for one in Path("/proc/self/task").iterdir()}
    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    path = colour_detector(tmp_path / "m.onnx", "yolox", size=None)
    never = threading.Event()
    model = with_lower_priority(lambda: open_model(path, settings=ModelSettings(threads=threads)), stop=never)
    assert model is not None
    with_lower_priority(lambda: model.run(np.zeros((1, 3, 64, 64), np.float32)), stop=never)
    started = {one.name for one in Path("/proc/self/task").iterdir()} - others
    levels = set()
    for one in started:
        with contextlib.suppress(OSError):  # ours of a moment ago
            levels.add(os.getpriority(os.PRIO_PROCESS, int(one)))
    assert levels == {max(11, own)} or (threads == 1 and not levels), "perception has a thread already"
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == own


def test_a_network_of_a_study_gives_way_to_nobody(tmp_path):
    """A study beside any other program would stand still, though nobody waits for video there."""
    before = threading.active_count()
    open_model(colour_detector(tmp_path / "m.onnx", "yolox", size=None)).run(
        np.zeros((1, 3, 64, 64), np.float32)
    )
    assert threading.active_count() <= before


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (lambda _good: b"not a model at all, but words\n", ""),
        (lambda _good: b"", "it is empty"),
        (lambda good: good[:-40], ""),
        (lambda good: good + b"\xff\xff", ""),
        (lambda _good: b"\x89PNG\r\n\x1a\n" + bytes(100), ""),
        (lambda _good: b"\x08\x07\x12\x07pytorch", "no graph"),
        (lambda _good: b"version https://git-lfs.github.com/spec/v1\noid".ljust(200, b"x"), "but Git LFS's"),
        (lambda _good: b"\n<!DOCTYPE html>".ljust(200, b"x"), "but a web page"),
        (lambda _good: b"PK\x03\x04\x14\0".ljust(200, b"x"), "but a zip archive"),
        (lambda _good: b"\x1c\0\0\0TFL3".ljust(200, b"x"), "but TensorFlow Lite's"),
        (
            lambda _: b"\x80\x04\x95\x1d\0\0\0\0\0\0\0\x8c\x02os\x8c\x06system\x93\x8c\x04true\x85R.",
            "is not an ONNX file",
        ),
    ],
)
def test_what_is_no_model_is_refused_in_one_sentence(tmp_path, content, words):
    """Nobody learns from a "wire type" that a download brought a page or a pointer."""
    path = constant_model(tmp_path / "m.onnx", np.ones((1, 2)))
    path.write_bytes(content(path.read_bytes()))
    assert words in sentence(path)
    for path in (tmp_path / "missing.onnx", tmp_path):
        sentence(path)


def test_a_file_over_the_cap_is_not_even_parsed(tmp_path):
    """One wrong path would fill the memory."""
    with (tmp_path / "huge.onnx").open("wb") as file:
        file.truncate(MAX_MODEL_BYTES + 1)
    assert str(MAX_MODEL_BYTES + 1) in sentence(tmp_path / "huge.onnx")


def test_a_file_is_gone_through_once_and_again_where_it_is_another(tmp_path, monkeypatch):
    """A start would read a large model four times; or a file that was written over would be trusted."""
    path, passes = constant_model(tmp_path / "model.onnx", np.ones((1, 2))), []
    through = model_file.mmap.mmap
    monkeypatch.setattr(
        model_file.mmap, "mmap", lambda *given, **how: passes.append(1) or through(*given, **how)
    )
    for written_s, times in (
        (time.time() + 60, 3),
        (1e9, 1),
    ):  # one of now may be written again at the same time
        os.utime(path, (written_s, written_s))
        passes.clear()
        for _ in range(3):
            model_file.check_onnx_file(path)
        assert len(passes) == times
    before = path.stat()
    path.write_bytes(b"\xff" * before.st_size)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    for check in (model_file.onnx_metadata, model_file.check_onnx_file):
        with pytest.raises(UserError, match="cut short"):
            check(path)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"ir_version": 99},
            r"IR version 99 \(written by tool\), and onnxruntime .* reads up to \d+: pip install -U",
        ),
        ({"opset": 99}, r"it has opset 99 .* knows up to \d+: .* opset_version=\d+"),
        (
            {"domain": "mmdeploy"},
            r"operator Relu of mmdeploy, which onnxruntime .* export the model without it",
        ),
        ({"operator": "Foo"}, r"opset 13 has no operator Foo .*export the model anew"),
        ({"operator": "BatchedNMS_TRT"}, r"operator BatchedNMS_TRT of TensorRT, which .* without NMS inside"),
    ],
)
def test_what_the_runtime_does_not_read_is_said_with_what_to_do(tmp_path, settings, words):
    """A model of a newer exporter would be refused with a line of C++."""
    value = helper.make_tensor_value_info
    domain = settings.get("domain", "")
    graph = helper.make_graph(
        [helper.make_node(settings.get("operator", "Relu"), ["x"], ["y"], domain=domain)],
        "newer",
        [value("x", TensorProto.FLOAT, [4])],
        [value("y", TensorProto.FLOAT, [4])],
    )
    opsets = [helper.make_opsetid("", settings.get("opset", 13))]
    opsets += [helper.make_opsetid(domain, 1)] if domain else []
    model = helper.make_model(
        graph, opset_imports=opsets, ir_version=settings.get("ir_version", 8), producer_name="tool"
    )
    (tmp_path / "m.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(UserError, match=words) as caught:
        open_model(tmp_path / "m.onnx")
    assert ".cc:" not in str(caught.value)


def test_an_openvino_model_needs_its_weights_and_its_runtime(tmp_path, monkeypatch):
    """Half a copy would end in a traceback of openvino, and a machine without it in none at all."""
    path = tmp_path / "net.xml"
    path.write_text("<net name='n' version='11'></net>")
    with pytest.raises(UserError, match=r"net\.xml has no net\.bin beside it"):
        open_model(path)
    path.with_suffix(".bin").write_bytes(b"1")
    with pytest.raises(UserError, match=r"net\.xml (cannot be read by openvino|has 0 inputs)"):
        open_model(path)
    with pytest.raises(UserError, match="--provider cuda cannot run it"):
        open_model(path, settings=ModelSettings(provider="cuda"))
    monkeypatch.setattr("hvt_models.openvino.find_openvino", lambda: None)
    with pytest.raises(UserError, match=r"pip install 'hvt\[openvino\]'"):
        open_model(path)
    path.write_text("<?xml version='1.0'?><!DOCTYPE net [<!ENTITY a 'b'>]><net></net>")
    with pytest.raises(UserError, match="is not an OpenVINO model"):
        open_model(path)


PORT = helper.make_tensor_value_info


def written(path, nodes, inputs, outputs, initialisers=()):
    graph = helper.make_graph(nodes, "prepared", inputs, outputs, list(initialisers))
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def same(path, *, inputs=1, outputs=1, shape=(1, 3, 8, 8)):
    ins = [PORT(f"x{n}", TensorProto.FLOAT, shape) for n in range(inputs)]
    outs = [PORT(f"y{n}", TensorProto.FLOAT, shape) for n in range(outputs)]
    nodes = [helper.make_node("Identity", [f"x{n % inputs}"], [f"y{n}"]) for n in range(max(inputs, outputs))]
    return written(
        path, nodes, ins, outs + [PORT(f"y{n}", TensorProto.FLOAT, shape) for n in range(outputs, inputs)]
    )


def sentence(path):
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


def test_a_list_among_the_outputs_is_refused(tmp_path):
    """A classifier of scikit-learn's exporter ended the program in a traceback."""
    out = helper.make_tensor_sequence_value_info("listed", TensorProto.FLOAT, (1, 3, 8, 8))
    node = helper.make_node("SequenceConstruct", ["x"], ["listed"])
    path = written(tmp_path / "m.onnx", [node], [PORT("x", TensorProto.FLOAT, (1, 3, 8, 8))], [out])
    assert "has 'listed', a seq(tensor(float)); tensors are accepted: export it without" in sentence(path)


def test_a_large_picture_is_no_absurd_port(tmp_path):
    """A network for 4K pictures would be refused."""
    large = (1, 3, 2176, 3840)
    assert open_model(same(tmp_path / "m.onnx", shape=large), settings=ONE_THREAD).inputs[0].shape == large


def weight(name, *, location=None):
    """Four numbers, in the file or said to be in another."""
    if location is None:
        return numpy_helper.from_array(np.ones(4, np.float32), name)
    tensor = TensorProto(name=name, data_type=TensorProto.FLOAT, dims=[4], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="offset", value="0")
    tensor.external_data.add(key="location", value=location)
    return tensor


def adding(folder, tensor, *, where):
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
    """A file called .ort would reach another parser, and a pickle be run."""
    good = constant_model(tmp_path / "good.onnx", np.ones((1, 2)))
    for name in ("renamed.ort", "renamed.pt", "renamed"):
        (tmp_path / name).write_bytes(good.read_bytes())
        assert len(open_model(tmp_path / name, settings=ONE_THREAD).outputs) == 1


def test_messages_nested_without_end_are_refused(tmp_path):
    """A few kilobytes would end the process in a stack that ran over."""
    body = b""
    for number in range(300):  # an attribute with a graph with a node with an attribute …
        field = (b"\x32", b"\x2a", b"\x0a")[number % 3]
        body = field + _varint(len(body)) + body
    path = tmp_path / "deep.onnx"
    path.write_bytes(b"\x08\x08\x3a" + _varint(len(body)) + body)
    assert "deep" in sentence(path)


def _varint(number):
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
    ended = python(script, str(path), preexec_fn=limit)
    assert int(ended.stdout) < 1_500_000, "kilobytes; the constant alone would have 3.6 GB"


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("", {}),
        ('<scale_values value="255.0"/>', {"hvt.mean": "0", "hvt.scale": "0.00392156862745098"}),
        (
            '<mean_values value="[10, 20, 30]"/><scale_values value="2 4 5"/><reverse_input_channels value="YES"/>',
            {"hvt.mean": "10, 20, 30", "hvt.scale": "0.5 0.25 0.2", "hvt.channel_order": "RGB"},
        ),
        ('<mean_values value="128"/>', {"hvt.mean": "128", "hvt.scale": "1.0"}),
        ('<reverse_input_channels value="False"/>', {"hvt.channel_order": "BGR"}),
        ('<scale_values value="0"/>', {"hvt.mean": "0", "hvt.scale": "0"}),
        ('<scale_values value="255"/><embedded_processing value="True"/>', {}),
        (
            '</model_info><cli_parameters><reverse_input_channels value="True"/></cli_parameters><model_info>',
            {"hvt.channel_order": "BGR"},
        ),
    ],
)
def test_an_openvino_model_says_its_pixels(tmp_path, said, expected):
    """A network of Geti or DL Streamer would get other pixels than it was trained with, and find little."""
    (tmp_path / "m.bin").write_bytes(b"")
    (tmp_path / "m.xml").write_text(f"<net><rt_info><model_info>{said}</model_info></rt_info></net>")
    found = metadata_of(tmp_path / "m.xml")
    assert {key: value for key, value in found.items() if key.startswith("hvt.")} == expected


def test_a_model_whose_name_is_not_utf_8_is_refused(tmp_path):
    """Onnxruntime takes no such name, and says so in a TypeError."""
    path = constant_model(tmp_path / "m.onnx", np.ones((1, 2)))
    with pytest.raises(UserError, match="its name is not UTF-8, rename it"):
        open_model(path.rename(tmp_path / os.fsdecode(b"caf\xe9.onnx")), settings=ONE_THREAD)
