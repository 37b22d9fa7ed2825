"""Classifiers: preparation of pixels, batches, posteriors, names, and the real ImageNet network."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto

from hvt_common.errors import UserError
from hvt_common.inference.class_names import IMAGENET_NAMES
from hvt_common.inference.classify import OnnxClassifier, open_classifier
from hvt_common.inference.runtimes.model import open_model
from media.onnx_models import colour_classifier, colour_detector, constant_model, scaling_inside

PLAIN = {"hvt.mean": "0", "hvt.scale": "[1]"}
BLUE = np.full((20, 30, 3), (200, 100, 50), np.uint8)  # BGR


def scores(path, crop):
    """What the first three classes got, as log-probabilities relative to the third."""
    probabilities = open_classifier(str(path)).classify([crop])[0].probabilities.astype(float)
    return np.log(probabilities[:3] / probabilities[2])


@pytest.mark.parametrize(
    ("classes", "metadata", "expected"),
    [
        (1001, {}, (np.array([50, 100, 200]) - 128) / 128),
        (1000, {}, (np.array([50, 100, 200]) / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]),
        (
            1000,
            {"hvt.channel_order": "BGR"},
            (np.array([200, 100, 50]) / 255 - [0.406, 0.456, 0.485]) / [0.225, 0.224, 0.229],
        ),
        (9, {"author": "Ultralytics", "task": "classify"}, np.array([50, 100, 200]) / 255),
        (9, {"task": "classify"}, np.array([50, 100, 200]) / 255),
        (7, {"hvt.mean": "1, 2, 3", "hvt.scale": "(0.01)"}, (np.array([50, 100, 200]) - [1, 2, 3]) / 100),
        (
            1001,
            {"hvt.mean": "100", "hvt.scale": "0.1 0.02 0.01", "hvt.channel_order": "bgr"},
            (np.array([200, 100, 50]) - 100) * [0.1, 0.02, 0.01],
        ),
    ],
)
def test_pixels_are_prepared_by_the_documented_rule(tmp_path, classes, metadata, expected):
    """A wrong mean or colour order costs a third of the accuracy and looks like a bad model."""
    path = colour_classifier(tmp_path / "c.onnx", classes=classes, gain=1, metadata=metadata)
    np.testing.assert_allclose(scores(path, BLUE), expected - expected[2], atol=1e-4)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([("Div", 255)], np.array([50, 100, 200]) / 255),
        ([("Cast", TensorProto.UINT8), ("Mul", 0.02)], np.array([50, 100, 200]) * 0.02),
        ([("Cast", None), ("Mul", 1 / 127.5), ("Sub", 1)], np.array([50, 100, 200]) / 127.5),
        ([("Sub", 0.5), ("Div", 0.5)], np.array([50, 100, 200]) / 127.5),
        ([("Shape", None), ("Sub", 0), ("Div", 255)], np.array([50, 100, 200]) / 255),
        (
            [("Slice", [-1, -9, 1, -1]), ("Sub", [103.94, 116.78, 123.68]), ("Mul", 0.02)],
            (np.array([200, 100, 50]) - [103.94, 116.78, 123.68]) * 0.02,
        ),
        (
            [("Sub", [0.485, 0.456, 0.406]), ("Div", [0.229, 0.224, 0.225])],
            (np.array([50, 100, 200]) / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225],
        ),
        (
            [("Sub", [103.94, 116.78, 123.68]), ("Mul", 0.02)],
            (np.array([200, 100, 50]) - [103.94, 116.78, 123.68]) * 0.02,
        ),
    ],
)
def test_a_network_that_scales_its_pixels_gets_them_plain(tmp_path, steps, expected):
    """They would be scaled twice: each crop is black, and of one class."""
    path = scaling_inside(colour_classifier(tmp_path / "c.onnx", classes=7, gain=1), steps)
    np.testing.assert_allclose(scores(path, BLUE), expected - expected[2], atol=1e-3)


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("batch", ["N", 1, 4])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_any_batch_and_layout_gives_the_same_answers(tmp_path, *, channels_last, batch, dtype):
    """Stills would get their neighbour's class, or a model of another layout could not be used."""
    path = colour_classifier(
        tmp_path / "c.onnx", batch=batch, channels_last=channels_last, metadata=PLAIN, gain=0.1, dtype=dtype
    )
    crops = [np.zeros((9 + i, 40 - i, 3), np.uint8) for i in range(6)]
    for index, crop in enumerate(crops):
        crop[..., index % 3] = 100 + index
    answers = open_classifier(str(path)).classify(crops)
    assert [answer.class_name for answer in answers] == [f"class {2 - i % 3}" for i in range(6)]
    expected = [np.exp((100 + i) / 10) / (np.exp((100 + i) / 10) + 2) for i in range(6)]
    np.testing.assert_allclose([answer.confidence for answer in answers], expected, rtol=0.01)
    assert open_classifier(str(path)).classify([]) == []


def test_more_crops_than_one_batch_keep_their_order(tmp_path):
    """A busy second with forty stills would be answered in disorder, or by a run of the network for each."""
    taken: list[int] = []
    model = open_model(colour_classifier(tmp_path / "c.onnx", metadata=PLAIN, gain=0.01))
    classifier, run = OnnxClassifier(model), model.run
    model.run = lambda feed: taken.append(len(feed)) or run(feed)  # type: ignore[method-assign, func-returns-value]
    crops = [np.full((8, 8, 3), (0, 0, 3 * i), np.uint8) for i in range(70)]
    confidences = [answer.confidence for answer in classifier.classify(crops)]
    assert taken == [32, 32, 6]
    assert len(confidences) == 70
    assert confidences == sorted(confidences)
    assert confidences[69] > confidences[0] + 0.4


@pytest.mark.parametrize("rooted", [False, True])
def test_logits_and_probabilities_give_the_same_posterior(tmp_path, caplog, *, rooted):
    """Certainty would depend on how a model was exported; a sigmoid a class is no logit, a root no fault."""
    crop = np.full((5, 5, 3), (10, 20, 40), np.uint8)
    expected = np.exp([2.0, 1.0, 0.5]) / np.exp([2.0, 1.0, 0.5]).sum()
    each = 1 / (1 + np.exp([-2.0, -1.0, -0.5]))
    answers: Any = [({}, expected), ({"softmax": True}, expected), ({"sigmoid": True}, each / each.sum())]
    for how, wanted in answers:
        path = colour_classifier(tmp_path / "c.onnx", metadata=PLAIN, gain=0.05, **how)
        if rooted:
            scaling_inside(path, [("Sqrt", None), ("Pow", [2])])
        (answer,) = open_classifier(str(path)).classify([crop])
        np.testing.assert_allclose(answer.probabilities, wanted, rtol=1e-4)
        assert (answer.class_name, answer.confidence) == ("class 0", pytest.approx(wanted[0], rel=1e-4))
        assert answer.entropy_nats == pytest.approx(-(wanted * np.log(wanted)).sum(), rel=1e-3)
        assert ("a probability of each class by itself" in caplog.text) == ("sigmoid" in how)


@pytest.mark.parametrize(("imgsz", "size"), [("[64, 96]", (96, 64)), ("128", (128, 128)), ("", (224, 224))])
def test_a_free_input_has_the_size_that_it_was_trained_at(tmp_path, imgsz, size):
    """A crop of 64 pixels would come enlarged to 224, and be something else."""
    taken: list[tuple[int, ...]] = []
    model = open_model(colour_classifier(tmp_path / "c.onnx", side="side", metadata={"imgsz": imgsz}))
    classifier = OnnxClassifier(model)
    run = model.run
    model.run = lambda feed: taken.append(feed.shape[:0:-1]) or run(feed)  # type: ignore[method-assign, assignment]
    classifier.classify([np.zeros((9, 9, 3), np.uint8)])
    assert taken == [(*size, 3)]


def test_broken_scores_say_nothing_and_odd_crops_do_not_crash(tmp_path):
    """One NaN would name an object with certainty; a sliver of a crop would end the process."""
    broken, whole = (
        open_model(constant_model(tmp_path / f"{number}.onnx", np.array([[1.0, number, 3.0, 0.0]])))
        for number in (np.nan, 2.0)
    )
    with pytest.raises(UserError, match=r"its scores of a picture are no numbers \(NaN\)"):
        OnnxClassifier(broken)
    classifier = OnnxClassifier(whole)
    whole.runner = broken.runner  # in flight
    answer = classifier.classify([BLUE])[0]
    np.testing.assert_allclose(answer.probabilities, [0.25] * 4)
    assert answer.entropy_nats == pytest.approx(np.log(4))
    classifier = OnnxClassifier(open_model(colour_classifier(tmp_path / "c.onnx")))
    shapes = [(1, 1, 3), (1, 1), (3, 900, 3), (40, 40, 1), (2000, 1, 3)]
    answers = classifier.classify([np.full(shape, 7, np.uint8) for shape in shapes])
    assert [np.isfinite(answer.probabilities).all() for answer in answers] == [True] * len(shapes)


def test_a_large_crop_is_averaged(tmp_path):
    """Sharp stills would come as noise: of each square of pixels one would speak for all."""
    path = colour_classifier(tmp_path / "c.onnx", gain=1, metadata=PLAIN)
    dots = np.zeros((128, 128, 3), np.uint8)
    dots[::4, ::4] = (160, 80, 0)
    np.testing.assert_allclose(scores(path, dots), (-10, -5, 0), atol=1e-4)


def test_names_of_1000_and_1001_classes_are_reconciled(tmp_path):
    """Every name would be that of the class beside it."""

    def opened(classes, **labels):
        return open_classifier(str(colour_classifier(tmp_path / "c.onnx", classes=classes)), **labels)

    assert opened(1000).class_names == IMAGENET_NAMES
    labels = tmp_path / "labels.txt"
    thousand = [f"thing {i}, synonym {i}" for i in range(1000)]
    for rows, classes, first in (
        (thousand, 1000, "thing 0"),
        (thousand, 1001, "background"),
        (["background", *thousand], 1001, "background"),
        (["Background", *thousand], 1000, "thing 0"),
    ):
        labels.write_text("\n".join(rows))
        names = opened(classes, labels=labels).class_names
        assert (len(names), names[0], names[-1]) == (classes, first, "thing 999")
    for rows, classes, says in (
        (["thing", *thousand], 1000, r"1001 class names.*1000 classes.*the reverse if"),
        (["a", "b"], 3, r"labels\.txt has 2 class names, .* has 3 classes"),
    ):
        labels.write_text("\n".join(rows))
        with pytest.raises(UserError, match=says):
            opened(classes, labels=labels)
    named = colour_classifier(tmp_path / "c.onnx", metadata={"classes": '["car, auto", "bus", "truck"]'})
    assert open_classifier(str(named)).class_names == ("car", "bus", "truck")


def test_what_is_no_classifier_is_refused_in_one_sentence(tmp_path):
    """A detector given by mistake would refine every track into nonsense."""
    for path in (
        colour_detector(tmp_path / "d.onnx", "yolox"),
        colour_detector(tmp_path / "u.onnx", "ultralytics"),
        constant_model(tmp_path / "one.onnx", np.ones((1, 1))),
        constant_model(tmp_path / "map.onnx", np.ones((1, 3, 8, 8))),
    ):
        with pytest.raises(UserError, match=r"is not a classifier .* accepted: an image") as caught:
            open_classifier(str(path))
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="does not exist"):
        open_classifier(str(tmp_path / "none.onnx"))


def test_an_input_without_declared_sizes_is_taken(tmp_path):
    """As transformers' exporter declares them all: it was refused."""
    path = colour_classifier(tmp_path / "c.onnx")
    model = onnx.load(path)
    for number, axis in enumerate(model.graph.input[0].type.tensor_type.shape.dim):
        axis.dim_param = f"free{number}"
    onnx.save(model, path)
    red = np.zeros((9, 9, 3), np.uint8)
    red[..., 2] = 255
    assert open_classifier(str(path)).classify([red])[0].class_name == "class 0"


def test_an_answer_of_other_classes_is_refused_in_words(tmp_path):
    """A crop would get the name of another class."""
    classifier = open_classifier(str(colour_classifier(tmp_path / "c.onnx")))
    assert isinstance(classifier, OnnxClassifier)
    for shape in ((1, 2), (0, 3), (3,)):
        classifier.model.runner = SimpleNamespace(run=lambda _, shape=shape: [np.ones(shape)])
        with pytest.raises(UserError, match=r"c\.onnx answers 1 crops with \(.*\), and has 3 classes"):
            classifier.classify([np.zeros((9, 9, 3), np.uint8)])


@pytest.mark.parametrize(
    "metadata",
    [{"hvt.mean": "much"}, {"hvt.scale": "1 2"}, {"hvt.mean": "nan"}, {"hvt.channel_order": "RGBA"}],
)
def test_malformed_preparation_is_refused(tmp_path, metadata):
    """A typing mistake in an export would be a silent loss of accuracy."""
    with pytest.raises(UserError, match=next(iter(metadata))):
        open_classifier(str(colour_classifier(tmp_path / "c.onnx", metadata=metadata)))


@pytest.mark.realdata
def test_the_real_network_knows_a_flower_and_a_dragonfly(data):
    """The preparation of pixels, the labels or their offset would be wrong for the shipped classifier."""
    classifier = open_classifier(
        str(data / "models/mobilenet_v2_imagenet.onnx"), labels=data / "models/imagenet_labels_1001.txt"
    )
    crops: list[Any] = [cv2.imread(str(data / f"classify_{name}.bmp")) for name in ("sunflower", "dragonfly")]
    flower, dragonfly = classifier.classify(crops)
    assert (flower.class_name, dragonfly.class_name) == ("daisy", "dragonfly")
    assert min(flower.confidence, dragonfly.confidence) > 0.9
    assert max(flower.entropy_nats, dragonfly.entropy_nats) < 0.5
    assert flower.probabilities.shape == (1001,)
    assert flower.probabilities.sum() == pytest.approx(1, abs=1e-4)
    blank = classifier.classify([np.full((224, 224, 3), 128, np.uint8)])[0]
    assert blank.entropy_nats > 3 * max(flower.entropy_nats, dragonfly.entropy_nats)


def test_of_several_outputs_the_names_tell_which(tmp_path):
    """A colour would be shown as a make of car."""

    def opened(*outputs, **labels):
        return open_classifier(str(constant_model(tmp_path / "c.onnx", *map(np.array, outputs))), **labels)

    with pytest.raises(UserError, match="several outputs are scores, which --labels decides"):
        opened([[0.1, 0.9]], [[0.2, 0.3, 0.5]])
    labels = tmp_path / "labels.txt"
    labels.write_text("car\nbus\nvan\n")
    both = opened([[0.1, 0.9]], [[0.2, 0.3, 0.5]], labels=labels)
    assert both.classify([BLUE])[0].class_name == "van"
    with pytest.raises(UserError, match="several outputs are scores, and not of the same"):
        opened([[0.1, 0.9]], [[0.8, 0.2]])
    assert opened([[0.1, 0.9]], [[-3, 5]]).classify([BLUE])[0].confidence == pytest.approx(0.9)
