"""What runs the networks: the choice, and OpenVINO against onnxruntime on real graphs."""

import logging
import re
from typing import Any

import cv2
import numpy as np
import pytest
from onnx import helper

from hvt_common.errors import UserError
from hvt_common.inference.classify import OnnxClassifier, open_classifier
from hvt_common.inference.detect import OnnxDetector, open_detector
from hvt_common.inference.runtimes import model as runtime
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.runtimes.providers import OpenVinoCpu, choose_provider
from hvt_common.values import iou
from hvt_edge.config import EdgeConfig
from hvt_edge.wiring import make_detector
from hvt_ground.config import GroundConfig
from hvt_ground.wiring import Models
from hvt_models.openvino import OpenVinoRunner, find_openvino
from media.onnx_models import colour_classifier, colour_detector, constant_model, save
from programs.processes import python

CPU = ("AzureExecutionProvider", "CPUExecutionProvider")
WITH_CUDA = ("TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider")
OPENVINO = ModelSettings(provider="openvino")

needs_openvino = pytest.mark.skipif(
    find_openvino() is None, reason="openvino is not installed: hvt[openvino]"
)
needs_bf16 = pytest.mark.skipif(
    not (find_openvino() or OpenVinoCpu("", bf16=False)).bf16,
    reason="openvino is not installed or this processor has no bf16",
)


def found(*, bf16):
    return lambda: OpenVinoCpu("2026.4", bf16=bf16)


def never():
    """OpenVINO must not be looked for: importing it takes a fifth of a second."""
    raise AssertionError


@pytest.mark.parametrize(
    ("onnxruntime", "openvino", "provider", "why"),
    [
        (CPU, lambda: None, "cpu", r"not installed \(pip install 'hvt\[openvino\]'\)"),
        (CPU, found(bf16=False), "cpu", "this processor has no bf16"),
        (CPU, found(bf16=True), "openvino", r"OpenVINO 2026\.4 .* computes in bf16"),
        (WITH_CUDA, never, "cuda", "onnxruntime-gpu is installed"),
    ],
)
def test_auto_takes_the_fastest_that_is_here_and_says_why(onnxruntime, openvino, provider, why):
    """Half the speed of a machine would lie idle, or nobody could tell what computes."""
    choice = choose_provider("auto", onnxruntime=onnxruntime, openvino=openvino)
    assert choice.provider == provider
    assert not choice.explicit
    assert re.search(why, choice.why), choice.why


def test_a_provider_that_is_asked_for_is_taken_or_refused():
    """A user who asked for the GPU would silently get the processor."""
    assert choose_provider("cpu", onnxruntime=CPU, openvino=never).provider == "cpu"
    assert choose_provider("tensorrt", onnxruntime=WITH_CUDA, openvino=never).provider == "tensorrt"
    assert "float32" in choose_provider("openvino", onnxruntime=CPU, openvino=found(bf16=False)).why
    gpu = r"--provider {} is not installed here \(.*pip install onnxruntime-gpu"
    for wanted, says in (
        *((one, gpu.format(one)) for one in ("cuda", "tensorrt")),
        ("coreml", r"coreml is not installed here \(.*on macOS only"),
        ("openvino", r"openvino is not installed here \(.*pip install 'hvt\[openvino\]'"),
        ("npu", "--provider 'npu' is not known: choose one of auto, cpu, cuda"),
    ):
        with pytest.raises(UserError, match=says):
            choose_provider(wanted, onnxruntime=CPU, openvino=lambda: None)


def test_edge_and_ground_hand_their_provider_on(tmp_path):
    """--provider would be accepted and change nothing."""
    detector = str(colour_detector(tmp_path / "d.onnx", "yolox"))
    classifier = str(colour_classifier(tmp_path / "c.onnx"))
    for word in ("cpu", "openvino") if find_openvino() else ("cpu",):
        at_edge = make_detector(EdgeConfig(source="demo", detector=detector, provider=word))
        assert isinstance(at_edge, OnnxDetector)
        ground = Models(GroundConfig(detector=detector, classifier=classifier, provider=word)).take()
        models = [at_edge.model, *(one.part.model for one in ground)]
        assert [one.provider.provider for one in models] == [word] * 3
    assert EdgeConfig().provider == GroundConfig().provider == "auto"
    with pytest.raises(UserError, match="is not known"):
        make_detector(EdgeConfig(source="demo", detector=detector, provider="fast"))


def test_what_runs_a_network_is_logged_and_a_light_one_brings_no_openvino(tmp_path, monkeypatch, caplog):
    """Two machines of different speed, and nobody could see why; an edge of 300 MB would take 450 to save 40 ms."""
    monkeypatch.setattr(runtime, "find_openvino", never)
    path = colour_detector(tmp_path / "m.onnx", "yolox")
    with caplog.at_level(logging.INFO, "hvt_common.inference.runtimes.model"):
        provider = open_model(path, settings=ModelSettings(provider="auto")).provider
    assert caplog.messages == [f"m.onnx runs on {provider.provider}: {provider.why}"]
    assert provider.provider in ("cpu", "cuda")


@needs_bf16
@pytest.mark.parametrize("size", [4, 96])
def test_auto_takes_openvino_only_where_it_is_quicker(tmp_path, monkeypatch, size):
    """The embedded detector took half as much again in bf16 as in float32 on a processor that has bf16."""
    monkeypatch.setattr(runtime, "LIGHT_BYTES", 0)
    weights = np.random.default_rng(1).normal(size=(size, 3, 7, 7)).astype(np.float32)
    path = save(
        tmp_path / "m.onnx",
        [helper.make_node("Conv", ["x", "w"], ["y"])],
        inputs={"x": (1, 3, "h", "w")},
        outputs={"y": (1, size, "a", "b")},
        constants={"w": weights},
    )
    chosen = open_model(path, settings=ModelSettings(provider="auto")).provider
    (percent,) = map(int, re.findall(r"takes (\d+)% of ", chosen.why))
    rounded = percent == 80  # it may be a little less or more
    assert rounded or chosen.provider == ("openvino" if percent < 80 else "cpu"), chosen.why


@needs_bf16
def test_auto_falls_back_where_openvino_cannot_read_a_model(tmp_path, monkeypatch):
    """A model that ran yesterday would not start today because OpenVINO was installed for another."""
    monkeypatch.setattr(runtime, "LIGHT_BYTES", 0)
    path = save(
        tmp_path / "m.onnx",
        [helper.make_node("Det", ["x"], ["y"])],  # onnxruntime has it
        inputs={"x": (1, 3, 4, 4)},
        outputs={"y": (1, 3)},
    )
    with pytest.raises(UserError, match=r"cannot be read by openvino: No conversion .*Det"):
        open_model(path, settings=OPENVINO)
    model = open_model(path, settings=ModelSettings(provider="auto"))
    assert model.provider.provider == "cpu"
    assert "cannot be read by openvino" in model.provider.why


@needs_openvino
def test_openvino_says_the_same_ports_and_metadata(tmp_path):
    """Class names and input sizes would depend on what runs the network; a hostile file reach a second parser."""
    path = constant_model(
        tmp_path / "m.onnx", np.ones((1, 2)), np.arange(6.0).reshape(1, 2, 3), metadata={"names": "['a']"}
    )
    ours, theirs = open_model(path), open_model(path, settings=OPENVINO)
    assert (theirs.inputs, theirs.outputs, theirs.metadata) == (ours.inputs, ours.outputs, ours.metadata)
    feed = np.zeros((1, 3, 64, 64), np.float32)
    for one, other in zip(ours.run(feed), theirs.run(feed), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(UserError, match="does not run on a 1x3x32x32 input: it takes images"):
        theirs.run(np.zeros((1, 3, 32, 32), np.float32))
    (short := tmp_path / "short.onnx").write_bytes(path.read_bytes()[:-30])
    for path in (short, tmp_path / "none.onnx"):
        with pytest.raises(UserError, match=path.name):
            open_model(path, settings=OPENVINO)


@needs_openvino
@pytest.mark.parametrize("kind", ["yolox", "ultralytics"])
def test_a_detector_finds_the_same_in_every_size_with_openvino(tmp_path, kind):
    """A network compiled for one size would answer for another, or the last sizes would pile up."""
    path = colour_detector(tmp_path / "m.onnx", kind, size=None if kind == "yolox" else (128, 96))
    ours, theirs = (open_detector(str(path), provider=name) for name in ("cpu", "openvino"))
    for width, height in ((96, 64), (160, 96), (64, 64), (128, 128), (192, 64), (64, 96), (96, 64)):
        image = np.zeros((height, width, 3), np.uint8)
        image[16:32, 32:48] = (0, 0, 250)
        expected, got = ours.detect(image), theirs.detect(image)
        assert len(expected) > 0
        assert len(got) == len(expected) == matches(expected, got)
        np.testing.assert_allclose(got.confidences, expected.confidences, atol=0.01)


@needs_openvino
def test_answers_of_openvino_are_not_overwritten_by_the_next_run(tmp_path):
    """The last frame's boxes would turn into this frame's."""
    model = open_model(colour_detector(tmp_path / "m.onnx", "yolox", size=(64, 64)), settings=OPENVINO)
    first = model.run(np.zeros((1, 3, 64, 64), np.float32))[0]
    kept = first.copy()
    model.run(np.full((1, 3, 64, 64), 200, np.float32))
    np.testing.assert_array_equal(first, kept)


@needs_openvino
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_a_classifier_takes_every_batch_with_openvino(tmp_path, dtype):
    """Each new number of stills would compile the network anew, or mix up their answers."""
    path = colour_classifier(
        tmp_path / "c.onnx", gain=0.02, metadata={"hvt.mean": "0", "hvt.scale": "1"}, dtype=dtype
    )
    ours, theirs = (open_classifier(str(path), provider=name) for name in ("cpu", "openvino"))
    crops = [np.full((20, 20, 3), (i * 9 % 250, i * 70 % 250, i * 37 % 250), np.uint8) for i in range(40)]
    for count in (1, 5, 40):
        for one, other in zip(ours.classify(crops[:count]), theirs.classify(crops[:count]), strict=True):
            np.testing.assert_allclose(other.probabilities, one.probabilities, atol=0.02)
    runner = OpenVinoRunner(path, threads=1, bf16=False)
    assert isinstance(theirs, OnnxClassifier)
    for count in (1, 5, 40):
        runner.run(np.zeros((count, *theirs.model.inputs[0].shape[1:]), dtype))
    assert len(runner.compiled) == 1


DROPPED_ELSEWHERE = """
import gc, signal, sys, threading
from pathlib import Path
import numpy as np
from hvt_models.openvino import OpenVinoRunner

held = [OpenVinoRunner(Path(sys.argv[1]), threads=1, bf16=False)]
held[0].run(np.zeros((1, 3, 64, 64), np.float32))
other = threading.Thread(target=lambda: (held.clear(), gc.collect()))
other.start()
other.join()
signal.signal(signal.SIGINT, lambda *_: print("stopped in order"))
signal.raise_signal(signal.SIGINT)
"""


@needs_openvino
def test_ctrl_c_is_heard_after_another_thread_dropped_a_network(tmp_path):
    """The program would end with a segmentation fault: no summary, and recordings without an end."""
    path = colour_detector(tmp_path / "m.onnx", "yolox", size=(64, 64))
    done = python(DROPPED_ELSEWHERE, str(path), check=False)
    assert (done.returncode, done.stdout) == (0, "stopped in order\n"), done.stderr


@pytest.mark.realdata
@needs_openvino
def test_openvino_costs_at_most_a_point_of_f1_on_a_real_picture(data):
    """The recommended speed-up would be paid for with objects nobody sees."""
    picture: Any = cv2.imread(str(data / "visdrone/0000001_02999_d_0000005.jpg"))
    path = str(data / "models/yolov5su_visdrone_640.onnx")
    ours, theirs = (open_detector(path, provider=name).detect(picture) for name in ("cpu", "openvino"))
    assert len(ours) > 30
    assert 2 * matches(ours, theirs) / (len(ours) + len(theirs)) >= 0.99


def matches(expected, got):
    """Pairs of one class and IoU 0.5, each box once."""
    overlaps = iou(got.boxes_xyxy_px, expected.boxes_xyxy_px)
    overlaps[got.class_ids[:, None] != expected.class_ids] = 0
    free = np.ones(len(expected), bool)
    for row in overlaps:
        best = (row * free).argmax()
        free[best] &= row[best] < 0.5
    return int((~free).sum())
