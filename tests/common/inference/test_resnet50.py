"""ResNet-50, the paper's refiner: its real graph, with drawn weights, on its own path of pixels, labels and batches.

The true weights are 102 MB and not at hand; what depends on them is not tested here. What does not is: the graph of
53 convolutions and one product, 224x224 RGB with ImageNet's mean and deviation, a free batch, 1000 logits.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import helper, numpy_helper

from hvt_common.inference.class_names import IMAGENET_NAMES, kind_of
from hvt_common.inference.classify import OnnxClassifier, open_classifier
from hvt_common.inference.labels import first_synonym, read_labels
from hvt_common.inference.runtimes.model import find_openvino
from hvt_common.values import Image
from hvt_models.command import main
from hvt_models.manifest import builtin_manifest

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
PARAMETERS = 25_557_032  # torchvision's count for resnet50: weights, and gain and bias of each normalisation


class Graph:
    """ResNet-50 v1 as an ONNX graph, layer by layer (He et al., 2016, table 1)."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []
        self.parameters = 0

    def weight(self, name: str, value: np.ndarray, *, learned: bool = True) -> str:
        """Add a constant."""
        self.weights.append(numpy_helper.from_array(value.astype(np.float32), name))
        self.parameters += value.size if learned else 0
        return name

    def node(self, kind: str, *inputs: str, **attributes: object) -> str:
        """Add an operator and return its output."""
        output = f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def convolution(
        self, x: str, inputs: int, outputs: int, size: int, *, stride: int = 1, gain: float = 1.0
    ) -> str:
        """Convolution without bias, and batch normalisation."""
        name = f"c{len(self.nodes)}"
        scale = np.sqrt(2 / (inputs * size * size))
        kernel = self.random.standard_normal((outputs, inputs, size, size), np.float32) * scale
        x = self.node("Conv", x, self.weight(f"{name}.w", kernel), strides=[stride] * 2, pads=[size // 2] * 4)
        return self.node(
            "BatchNormalization",
            x,
            self.weight(f"{name}.gain", np.full(outputs, gain)),
            self.weight(f"{name}.bias", np.zeros(outputs)),
            self.weight(f"{name}.mean", np.zeros(outputs), learned=False),
            self.weight(f"{name}.variance", np.ones(outputs), learned=False),
        )

    def bottleneck(self, x: str, inputs: int, middle: int, *, stride: int) -> str:
        """1x1, 3x3, 1x1 beside the identity or a projection."""
        y = self.node("Relu", self.convolution(x, inputs, middle, 1))
        y = self.node("Relu", self.convolution(y, middle, middle, 3, stride=stride))
        y = self.convolution(y, middle, 4 * middle, 1, gain=0.3)
        if inputs != 4 * middle:
            x = self.convolution(x, inputs, 4 * middle, 1, stride=stride)
        return self.node("Relu", self.node("Add", x, y))

    def write(self, path: Path) -> Path:
        """The whole network, (N, 3, 224, 224) ``data`` to (N, 1000) logits."""
        x = self.node("Relu", self.convolution("data", 3, 64, 7, stride=2))
        x = self.node("MaxPool", x, kernel_shape=[3, 3], strides=[2, 2], pads=[1] * 4)
        inputs = 64
        for stage, blocks in enumerate((3, 4, 6, 3)):
            middle = 64 << stage
            for block in range(blocks):
                x = self.bottleneck(x, inputs, middle, stride=2 if stage and not block else 1)
                inputs = 4 * middle
        x = self.node("Flatten", self.node("GlobalAveragePool", x))
        dense = self.random.standard_normal((1000, inputs), np.float32) * 0.02
        dense -= dense.mean(axis=1, keepdims=True)  # what all pictures share moves no class
        bias = self.weight("dense.bias", np.zeros(1000))
        self.nodes.append(
            helper.make_node("Gemm", [x, self.weight("dense.w", dense), bias], ["logits"], transB=1)
        )
        port = helper.make_tensor_value_info
        graph = helper.make_graph(
            self.nodes,
            "resnet50",
            [port("data", onnx.TensorProto.FLOAT, ["N", 3, 224, 224])],
            [port("logits", onnx.TensorProto.FLOAT, ["N", 1000])],
            self.weights,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 12)], ir_version=7)
        path.write_bytes(model.SerializeToString())
        return path


@pytest.fixture(scope="module")
def graph() -> Graph:
    """The graph before it is written."""
    return Graph(seed=50)


@pytest.fixture(scope="module")
def resnet(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A file of 102 MB, removed afterwards."""
    path = graph.write(tmp_path_factory.mktemp("resnet") / "resnet50.onnx")
    yield path
    path.unlink()


@pytest.fixture(scope="module")
def classifier(resnet: Path) -> OnnxClassifier:
    """The network as HVT opens it."""
    opened = open_classifier(str(resnet))
    assert isinstance(opened, OnnxClassifier)
    return opened


def crops(count: int, *, side: int = 224, seed: int = 1) -> list[Image]:
    """Pictures of blobs in different colours."""
    random = np.random.default_rng(seed)
    small = random.integers(0, 256, (count, 7, 7, 3), dtype=np.uint8)
    return [cv2.resize(one, (side, side), interpolation=cv2.INTER_CUBIC) for one in small]


def plainly_prepared(crop_bgr: Image) -> np.ndarray:
    """(3, 224, 224) as torchvision's documentation writes it, for crops of 224 or 448 pixels."""
    values = crop_bgr.astype(np.uint32)
    if len(values) == 448:
        values = (values[0::2, 0::2] + values[1::2, 0::2] + values[0::2, 1::2] + values[1::2, 1::2] + 2) >> 2
    rgb = values[:, :, ::-1].astype(np.float64) / 255
    return ((rgb - MEAN) / DEVIATION).transpose(2, 0, 1).astype(np.float32)


def test_it_is_the_real_graph(graph: Graph, resnet: Path) -> None:
    """The tests below would speak of a toy."""
    kinds = [node.op_type for node in graph.nodes]
    assert (kinds.count("Conv"), kinds.count("Add"), kinds.count("Gemm")) == (53, 16, 1)
    assert graph.parameters == PARAMETERS
    assert resnet.stat().st_size == pytest.approx(builtin_manifest()["resnet50"].size_bytes, rel=0.002)


@pytest.mark.parametrize("side", [224, 448])
def test_answers_equal_plain_numpy_and_bare_onnxruntime(
    resnet: Path, classifier: OnnxClassifier, side: int
) -> None:
    """A wrong mean, colour order or softmax costs a third of the accuracy and looks like a bad model."""
    images = crops(3, side=side)
    session = ort.InferenceSession(str(resnet), providers=["CPUExecutionProvider"])
    logits = session.run(None, {"data": np.stack([plainly_prepared(image) for image in images])})[0]
    assert logits.std(axis=1).min() > 0.1  # the weights tell pictures apart
    powers = np.exp(logits.astype(np.float64) - logits.max(axis=1, keepdims=True))
    expected = powers / powers.sum(axis=1, keepdims=True)
    answers = classifier.classify(images)
    for answer, row in zip(answers, expected, strict=True):
        np.testing.assert_allclose(answer.probabilities, row, rtol=2e-3)
        assert answer.class_name == IMAGENET_NAMES[row.argmax()]
        assert answer.confidence == pytest.approx(row.max(), rel=2e-3)
        assert answer.entropy_nats == pytest.approx(-(row * np.log(row)).sum(), rel=1e-3)
    assert len({answer.probabilities.tobytes() for answer in answers}) == 3


def test_a_batch_of_crops_is_one_call(resnet: Path) -> None:
    """A busy second with many stills would take as many runs, each paying for the whole network's weights again."""
    classifier = open_classifier(str(resnet))
    assert isinstance(classifier, OnnxClassifier)
    shapes: list[tuple[int, ...]] = []
    run = classifier.model.run
    classifier.model.run = lambda feed: shapes.append(feed.shape) or run(feed)  # type: ignore[method-assign, func-returns-value]
    images: list[Any] = [cv2.resize(one, (40 + 30 * i, 300 - 20 * i)) for i, one in enumerate(crops(6))]
    together = classifier.classify(images)
    assert shapes == [(6, 3, 224, 224)]
    for image, answer in zip(images, together, strict=True):
        np.testing.assert_allclose(
            classifier.classify([image])[0].probabilities, answer.probabilities, rtol=2e-3
        )


def test_it_knows_imagenets_names_by_itself(classifier: OnnxClassifier) -> None:
    """The ground would show 'class 656' for a minivan until the user finds a labels file."""
    assert classifier.class_names == IMAGENET_NAMES
    assert len(IMAGENET_NAMES) == 1000
    named = {index: IMAGENET_NAMES[index] for index in (0, 151, 656, 717, 779, 864, 999)}
    assert named == {
        0: "tench",
        151: "Chihuahua",
        656: "minivan",
        717: "pickup",
        779: "school bus",
        864: "tow truck",
        999: "toilet tissue",
    }
    assert [kind_of(IMAGENET_NAMES[index]) for index in (656, 717, 779, 864)] == [
        "car",
        "truck",
        "bus",
        "truck",
    ]


@pytest.mark.realdata
def test_a_labels_file_with_a_background_fits(data: Path, resnet: Path) -> None:
    """Every class would be off by one: a tench for every goldfish."""
    file = data / "models/imagenet_labels_1001.txt"
    names = open_classifier(str(resnet), labels=file).class_names
    assert names == tuple(first_synonym(name) for name in read_labels(file)[1:])
    different = [index for index in range(1000) if names[index] != IMAGENET_NAMES[index]]
    assert different == [134, 639]  # the second crane and the second maillot, which ours tells apart


def test_it_opens_by_name_from_the_cache(
    resnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """--classifier with a name would not find what hvt-models took in."""
    monkeypatch.setenv("HVT_MODELS", str(tmp_path / "cache"))
    digest = hashlib.sha256(resnet.read_bytes()).hexdigest()
    assert main(["add", str(resnet), "--name", "drawn-resnet", "--sha256", digest]) == 0
    assert len(open_classifier("drawn-resnet").class_names) == 1000
    (tmp_path / "cache" / "drawn-resnet.onnx").unlink()


@pytest.mark.skipif(find_openvino() is None, reason="openvino is not installed: hvt[openvino]")
def test_openvino_answers_alike(resnet: Path, classifier: OnnxClassifier) -> None:
    """The faster provider would change classes of stills."""
    images = crops(4)
    answers = open_classifier(str(resnet), provider="openvino").classify(images)
    for ours, theirs in zip(classifier.classify(images), answers, strict=True):
        np.testing.assert_allclose(theirs.probabilities, ours.probabilities, rtol=0.1, atol=1e-4)
        assert ours.class_name in [IMAGENET_NAMES[index] for index in theirs.probabilities.argsort()[-3:]]
