"""Every head that the field uses: what it is taken for, and that its boxes come out where they are."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from hvt_common.errors import UserError
from hvt_common.inference.detect import OnnxDetector, open_detector
from hvt_common.inference.heads import HEAD_NAMES
from hvt_common.inference.runtimes.model import OnnxModel, Port, open_model
from hvt_common.inference.runtimes.providers import ProviderChoice
from media.head_models import FAMILIES, NEEDS_NAMES, SQUARES, Graph, family_model, picture
from media.onnx_models import cells, constant_model, save, scaling_inside

NAMED = {"names": "['red', 'blue']"}
ULTRALYTICS = {**NAMED, "author": "Ultralytics", "task": "detect", "stride": "32", "imgsz": "[320, 320]"}


def check(detector: OnnxDetector, head: str) -> None:
    """Both squares, nothing else, and nothing on grey."""
    assert detector.head.name == head
    assert detector.head.why
    found = detector.detect(picture())
    assert found.class_ids.tolist() == [0, 1]
    np.testing.assert_allclose(found.boxes_xyxy_px, SQUARES, atol=1.0)
    np.testing.assert_allclose(found.confidences, [0.9, 0.8], atol=0.01)
    assert len(detector.detect(np.full((192, 320, 3), 100, np.uint8))) == 0


def opened(path: Path, **settings: Any) -> OnnxDetector:
    detector = open_detector(str(path), **settings)
    assert isinstance(detector, OnnxDetector)
    return detector


@pytest.mark.parametrize("family", FAMILIES)
def test_a_head_is_told_by_all_its_outputs_or_named(tmp_path: Path, family: str) -> None:
    """A model of the field would find nothing, or boxes elsewhere; a file that says more would be read worse."""
    head = FAMILIES[family][0]
    assert head in HEAD_NAMES
    check(
        opened(family_model(tmp_path / "m.onnx", family, metadata=NAMED if family in NEEDS_NAMES else {})),
        head,
    )
    check(opened(family_model(tmp_path / "m.onnx", family), head=head), head)
    check(opened(family_model(tmp_path / "m.onnx", family, metadata={"head": head})), head)
    if family not in ("yolox", "yolox-decoded"):
        check(opened(family_model(tmp_path / "m.onnx", family, metadata=ULTRALYTICS)), head)


@pytest.mark.parametrize("dtype", [TensorProto.FLOAT, TensorProto.FLOAT16])
@pytest.mark.parametrize("family", ["yolov8", "yolov10", "rt-detr", "ssd", "yolo-nas"])
def test_channels_may_come_last(tmp_path: Path, family: str, dtype: int) -> None:
    """Exports of TensorFlow would be refused, or see one colour as another."""
    path = family_model(tmp_path / "m.onnx", family, channels_last=True, dtype=dtype)
    detector = opened(path)
    check(detector, FAMILIES[family][0])
    assert "channels last" in detector.pixels


@pytest.mark.parametrize(
    ("steps", "form"),
    [
        ([("Div", 255)], ".onnx"),
        ([("Clip", 0), ("Div", 255)], ".onnx"),
        ([("Sub", 0), ("Div", [255] * 3)], ".onnx"),
        ([("Gather", [2, 1, 0])], ".onnx"),
        ([("Gather", [2, 1, 0]), ("Sub", 0), ("Div", [255] * 3)], ".xml"),
        ([("Slice", [-1, -9, 1, -1])], ".onnx"),
        pytest.param([("Slice", [-1, -9, 1, -1])], ".xml", marks=pytest.mark.nightly),
    ],
)
def test_what_a_network_does_to_its_pixels_itself_is_not_done_before(
    tmp_path: Path, steps: list[tuple[str, object]], form: str
) -> None:
    """They would be divided twice, and nothing found without a word; or red would be blue."""
    path = scaling_inside(family_model(tmp_path / "m.onnx", "yolov8", metadata=NAMED), steps)
    if form == ".xml":
        openvino = pytest.importorskip("openvino")
        openvino.save_model(openvino.convert_model(path), path.with_suffix(form))
    detector = opened(path.with_suffix(form))
    check(detector, "yolov8")
    assert detector.class_names[0] in NAMED["names"]


@pytest.mark.parametrize("channels_last", [False, True])
def test_a_network_of_bytes_gets_bytes(tmp_path: Path, *, channels_last: bool) -> None:
    """Pixels would be divided by 255 and all be 0."""
    path = family_model(
        tmp_path / "m.onnx", "tensorflow", channels_last=channels_last, dtype=TensorProto.UINT8
    )
    check(opened(path), "tf-lists")


@pytest.mark.parametrize("family", NEEDS_NAMES)
def test_what_stays_open_is_refused_with_the_option_that_decides(tmp_path: Path, family: str) -> None:
    """One of two readings would be taken, and half of all users see nonsense."""
    path = family_model(tmp_path / "m.onnx", family)
    with pytest.raises(UserError, match=r"could be yolox-decoded or yolov8-rows, which --head") as caught:
        open_detector(str(path))
    assert "output (" in str(caught.value)
    with pytest.raises(UserError, match="--head 'yolo' is not known: choose one of yolox, "):
        open_detector(str(path), head="yolo")
    with pytest.raises(UserError, match="are not those of --head ssd"):
        open_detector(str(path), head="ssd")
    for given in ({"head": "ssd"}, {"labels": Path("names.txt")}, {"size": (640, 640)}):
        with pytest.raises(UserError, match="has no effect: 'motion' is no network of one file"):
            open_detector("motion", **given)


def test_rt_detr_is_told_by_what_its_file_says(tmp_path: Path) -> None:
    """Its 300 rows look like those of others where the trial lists nothing but padding."""
    rows = np.zeros((1, 300, 6))
    rows[0, 0] = [0.5, 0.25, 0.2, 0.1, 0.9, 1]
    for said in ({"head": "RTDETRDecoder"}, {"description": "Ultralytics RT-DETR-l model"}):
        path = constant_model(tmp_path / "m.onnx", rows, metadata={**NAMED, **said}, size=(320, 320))
        detector = opened(path)
        assert detector.head.name == "rt-detr-rows"
        assert detector.head.why.startswith("its metadata say")
        np.testing.assert_allclose(
            detector.detect(np.zeros((100, 200, 3), np.uint8)).boxes_xyxy_px, [[80, 20, 120, 30]], atol=1e-3
        )


CENTRE, CORNERS = [0.5, 0.5, 0.2, 0.2], [0.1, 0.1, 0.4, 0.4]


@pytest.mark.parametrize(
    ("scores", "box"),
    [
        ([0.02, 0.03, 0.95], CENTRE),
        ([0.9, 0.05, 0.05], CENTRE),
        ([-4.0, -3.0, -5.0], CORNERS),
        ([-5.0, -5.0, -5.0, -5.0, 8.0], [0.3] * 4),  # DETR's own, with a logit for "no object"
    ],
)
def test_what_is_not_detrs_form_is_not_taken_for_it(
    tmp_path: Path, scores: list[float], box: list[float]
) -> None:
    """Each query of a softmax would be an object of the class "none"; corners would be boxes elsewhere."""
    path = constant_model(tmp_path / "m.onnx", np.tile(scores, (1, 100, 1)), np.tile(box, (1, 100, 1)))
    with pytest.raises(UserError, match="--head"):
        open_detector(str(path))


class Answers:
    """A network that answers one picture after the other with these outputs, and then with the last."""

    def __init__(self, *answers: np.ndarray) -> None:
        self.left = list(answers)

    def run(self, *_feeds: np.ndarray) -> list[np.ndarray]:
        return [self.left.pop(0) if self.left[1:] else self.left[0]]


def answering(*answers: np.ndarray) -> tuple[OnnxDetector, Answers]:
    """A detector of such a network; it is tried with three pictures."""
    ports = (Port("images", (1, 3, 192, 320), np.dtype(np.float32)),), (Port("o", (), np.dtype(np.float32)),)
    network = Answers(*answers)
    choice = ProviderChoice("cpu", "", explicit=True)
    model = OnnxModel(Path("m.onnx"), *ports, metadata=NAMED, runner=network, provider=choice)
    return OnnxDetector(model), network


ROWS = np.array([[[64, 32, 160, 96, 0.9, 0], [192, 96, 288, 160, 0.8, 1]]], np.float32)


@pytest.mark.parametrize("empty", [(0,), (1, 0), (0, 6), (1, 0, 0), (1, 0, 6)])
def test_no_objects_are_an_empty_answer_of_any_form(empty: tuple[int, ...]) -> None:
    """The program ended in a traceback, or a flight went on without detections, over an empty picture."""
    nothing = np.empty(empty, np.float32)
    detector, _ = answering(nothing, ROWS, nothing, ROWS, nothing)
    check(detector, "end-to-end")


def test_an_answer_that_cannot_be_is_refused_in_words() -> None:
    """Boxes of nonsense; or a picture without objects, where the scores were a column that is none."""
    for other in (ROWS[0], ROWS[..., :5].repeat(2, axis=1), ROWS.transpose(0, 2, 1), np.array(3)):
        with pytest.raises(UserError, match="answers one picture with"):
            answering(ROWS, other)
        detector, _ = answering(ROWS, ROWS, ROWS, other)
        with pytest.raises(
            UserError, match=r"^model m\.onnx answers a picture with \(.*others with \(1, 2, 6\)$"
        ):
            detector.detect(picture())
    detector, _ = answering(ROWS[:, :0], ROWS[:, :0], ROWS[:, :0], ROWS[..., [5, 4, 0, 1, 2, 3]])
    with pytest.raises(UserError, match="confidences above 1: it is not end-to-end"):
        detector.detect(picture())
    by_centre = np.concatenate([(ROWS[..., :2] + ROWS[..., 2:4]) / 2, ROWS[..., 2:4] - ROWS[..., :2]], axis=2)
    detector, _ = answering(ROWS[:, :0], ROWS[:, :0], ROWS[:, :0], np.dstack([by_centre, ROWS[..., 4:]]))
    with pytest.raises(UserError, match="boxes that end before they begin: it is not end-to-end"):
        detector.detect(picture())


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("names", [{}, NAMED])
def test_an_angle_is_no_class(tmp_path: Path, names: dict[str, str], *, transposed: bool) -> None:
    """Rotated boxes without metadata end in a column of angles: each cell would hold an object of one more class."""
    table = np.full((1, 126, 7), 1e-3)
    table[..., :4], table[..., 6] = 32, np.linspace(0, 1, 126)
    table = table.transpose(0, 2, 1) if transposed else table
    with pytest.raises(UserError, match=r"fit no head that is known|could be yolox, which"):
        opened(constant_model(tmp_path / "m.onnx", table, size=(96, 64), metadata=names))


def test_yolov7_of_one_class_tells_by_objectness_alone(tmp_path: Path) -> None:
    """Its class is not trained, and says 0.5: each confidence would be halved, and weak objects lost."""
    table = np.tile(np.array([32, 32, 16, 16, 1e-3, 0.5], np.float32), (1, 3 * 126, 1))
    table[0, 9, 4] = 0.4
    detector = opened(
        constant_model(tmp_path / "m.onnx", table, size=(96, 64), metadata={"names": "['rat']"})
    )
    found = detector.detect(np.full((64, 96, 3), 9, np.uint8))
    assert (detector.head.name, found.confidences.tolist()) == ("yolov5", [np.float32(0.4)])


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_rf_detr_may_have_any_number_of_classes(tmp_path: Path, columns: int) -> None:
    """One of three classes and "none", as wide as its boxes, was refused, with --head rf-detr too."""
    answers = {"dets": np.full((1, 100, 4), 0.4), "labels": np.full((1, 100, columns), -5.0)}
    path = save(
        tmp_path / "m.onnx",
        [helper.make_node("Identity", [f"c_{name}"], [name]) for name in answers],
        inputs={"images": (1, 3, 320, 320)},
        outputs={name: value.shape for name, value in answers.items()},
        constants={f"c_{name}": value.astype(np.float32) for name, value in answers.items()},
    )
    head = opened(path).head
    assert (head.name, head.classes) == ("rf-detr", columns)


def test_layers_that_only_training_reads_are_passed_over(tmp_path: Path) -> None:
    """An export of DETR's kind with its auxiliary outputs would be refused."""
    graph = Graph()
    outputs = {name: tensor for name, (tensor, _) in FAMILIES["rt-detr"][1](graph, "images").items()}
    outputs |= {
        "enc_logits": graph.const(np.full((1, 100, 2), -5)),
        "enc_boxes": graph.const(np.full((1, 100, 4), 0.4)),
    }
    check(opened(write(tmp_path / "m.onnx", graph, outputs)), "rt-detr")


def _mmdeploy(graph: Graph, boxes: str, scores: str) -> dict[str, str]:
    table = graph.batch(graph.op("Concat", boxes, graph.column(scores), axis=1))
    return {"dets": table, "labels": graph.const([[0, 1]], np.int64)}


def _mmyolo(graph: Graph, boxes: str, scores: str) -> dict[str, str]:
    lists = {"boxes": graph.batch(boxes), "scores": graph.batch(scores)}
    return {"num_dets": graph.const([[2]], np.int64), **lists, "labels": graph.const([[0, 1]], np.int64)}


def _damo(graph: Graph, boxes: str, scores: str) -> dict[str, str]:
    cells, rest = FAMILIES["yolo-nas"][1](graph, "images").values()
    del boxes, scores
    return {"output": rest[0], "953": cells[0]}


def _onnx_zoo(graph: Graph, boxes: str, scores: str) -> dict[str, str]:
    shares = graph.batch(graph.shares(boxes))
    return {"bboxes": shares, "labels": graph.const([[0, 1]], np.int64), "scores": graph.batch(scores)}


def _custom_vision(graph: Graph, boxes: str, scores: str) -> dict[str, str]:
    labels = graph.const([[0, 1]], np.int64)
    return {"detected_boxes": graph.batch(boxes), "labels": labels, "detected_scores": graph.batch(scores)}


@pytest.mark.parametrize(
    ("build", "head"),
    [
        (_mmdeploy, "atss"),
        (_mmyolo, "nms-lists"),
        (_damo, "yolo-nas"),
        (_onnx_zoo, "labels-boxes-scores"),
        (_custom_vision, "labels-boxes-scores"),
    ],
)
def test_where_pixels_may_be_of_several_kinds_the_file_has_to_say(
    tmp_path: Path, build: Any, head: str
) -> None:
    """Networks with these outputs take pixels in three ways, and all look alike: nothing would be found."""
    graph = Graph()
    outputs = build(graph, *graph.find("images", bgr=head == "atss", top=255 if head == "atss" else 1))
    path = write(tmp_path / "m.onnx", graph, outputs)
    with pytest.raises(UserError, match=f"could be {head}, which --head .* hvt.mean"):
        opened(path)
    check(opened(path, head=head), head)
    model = onnx.load(path)
    helper.set_model_props(model, {"hvt.mean": "0"})
    onnx.save(model, path)
    check(opened(path), head)


def test_raw_levels_beside_the_rows_are_passed_over(tmp_path: Path) -> None:
    """YOLOv5 exports the levels before decoding too; the model would be refused as two."""
    rows = np.zeros((1, 252, 7))
    rows[0, :, :4] = 20
    levels = [np.zeros((1, 3, side, side, 7)) for side in (8, 4, 2)]
    assert opened(constant_model(tmp_path / "m.onnx", rows, *levels)).head.name == "yolov5"


@pytest.mark.parametrize("strides", [(8, 16, 32), (4, 8, 16, 32), (16, 32), (4, 8, 16), (8, 16)])
def test_a_network_may_have_other_levels(tmp_path: Path, strides: tuple[int, ...]) -> None:
    """One for small objects, without the coarse level, could not be used even with --head."""
    table = np.full((1, 6, sum(96 * 64 // stride**2 for stride in strides)), 1e-3)
    table[:, :4] = 32
    path = constant_model(tmp_path / "m.onnx", table, size=(96, 64), metadata=NAMED)
    assert opened(path).head.name == "yolov8"


def test_classes_without_names_are_numbers_and_said_once(tmp_path: Path, caplog) -> None:
    """Ten classes of somebody's own would be called pedestrian, people and bicycle."""
    for classes in (10, 80):
        caplog.clear()
        table = np.full((1, 4 + classes, 126), 1e-3)
        table[:, :4] = 32
        path = str(constant_model(tmp_path / "m.onnx", table, size=(96, 64)))
        detector = opened(Path(path))
        assert detector.class_names == tuple(f"class {index}" for index in range(classes))
        said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
        assert len(said) == 1
        assert f"class 0 to class {classes - 1}" in said[0]
    assert opened(Path(path), labels=Path("coco")).class_names[:2] == ("person", "bicycle")


@pytest.mark.parametrize(
    ("family", "truck"), [("tensorflow", 7), ("ssd", 8), ("TensorRT's NMS", 7), ("d-fine, deployed", 7)]
)
def test_coco_names_are_those_of_the_numbers_that_a_network_lists(
    tmp_path: Path, family: str, truck: int
) -> None:
    """TensorFlow, torchvision and the Open Model Zoo number by COCO's ids: a person would be a bicycle."""
    names = opened(family_model(tmp_path / "m.onnx", family), labels=Path("coco")).class_names
    assert names[truck] == "truck"
    by_id = family in ("tensorflow", "ssd")
    assert (len(names), names[-1]) == (83 + truck if by_id else 80, "toothbrush")
    assert (names[truck + 4] == "class 12") == by_id


@pytest.mark.parametrize("family", ["ssd", "d-fine, deployed"])
def test_names_that_lack_the_background_name_nothing(tmp_path: Path, family: str) -> None:
    """Of torchvision's lists, which begin at 1, each object had the name of the next class."""
    path = family_model(tmp_path / "m.onnx", family, metadata={"names": "['red']"})
    with pytest.raises(
        UserError, match=r"lists class 1, and has names of class 0 to class 0: .*a background too"
    ):
        opened(path).detect(picture())


def test_lists_of_tensorflow_that_count_from_0_name_nothing(tmp_path: Path) -> None:
    """Its first class was left out as the background, and each other had the name of the one before."""
    graph = Graph()
    boxes, scores = graph.find("images", top=255)
    lists = {
        "detection_boxes": graph.batch(
            graph.op("Gather", graph.shares(boxes), graph.ints(1, 0, 3, 2), axis=1)
        ),
        "detection_scores": graph.batch(scores),
        "detection_classes": graph.const([[0.0, 1.0]]),
    }
    with pytest.raises(UserError, match="lists class 0, and its classes are taken to count from 1: add 1"):
        opened(write(tmp_path / "m.onnx", graph, lists)).detect(picture())


def test_a_background_among_the_names_of_tensorflow_shifts_none(tmp_path: Path) -> None:
    """Its classes begin at 1, and were called by the name before: the first one "background"."""
    names = {"names": "['__background__', 'red', 'blue']"}
    detector = opened(family_model(tmp_path / "m.onnx", "tensorflow", metadata=names))
    assert detector.class_names == ("red", "blue")
    check(detector, "tf-lists")


def test_a_class_beyond_the_names_is_said_once(tmp_path: Path, caplog) -> None:
    """Its objects would vanish, and nobody know why."""
    rows = np.zeros((1, 20, 6))
    rows[0, 0] = [10, 10, 40, 40, 0.9, 7]
    rows[0, 1] = [10, 10, 40, 40, 0.8, 1]
    detector = opened(constant_model(tmp_path / "m.onnx", rows, metadata=NAMED))
    caplog.clear()
    for _ in range(3):
        assert detector.detect(np.zeros((64, 64, 3), np.uint8)).class_ids.tolist() == [1]
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 1
    assert "lists class 7, and has names up to class 1" in said[0]


@pytest.mark.parametrize("score", [0.0, 0.4])
def test_scores_that_are_all_alike_are_said_once(tmp_path: Path, caplog, score: float) -> None:
    """With one INT8 scale for pixels and scores each score is 0: nothing was found, and nobody knew why.

    A sound network of INT8 has such pictures too, and is not blamed.
    """
    columns, rows, strides = cells((64, 64)).T
    table = np.full((1, 7, len(columns)), score)
    table[0, :4] = (columns + 0.5) * strides, (rows + 0.5) * strides, strides, strides
    detector = opened(constant_model(tmp_path / "m.onnx", table), head="yolov8")
    sound = opened(detector.model.path, head="yolov8")
    table[0, 4, 0] = 0.9
    seeing = opened(constant_model(tmp_path / "sound.onnx", table), head="yolov8").model
    caplog.clear()
    contrast = np.eye(64, dtype=np.uint8)[..., None].repeat(3, 2) * 255
    for shown in [np.zeros((64, 64, 3), np.uint8)] + [contrast] * 19:
        detector.detect(shown)
        sound.detect(shown)
    sound.model = seeing
    assert not caplog.records
    for _ in range(20):
        detector.detect(contrast)
        sound.detect(contrast)
    (said,) = [record.getMessage() for record in caplog.records]
    assert (
        f"m.onnx gave all places of each of 20 pictures one score ({score:.3g}), and told no object" in said
    )


@pytest.mark.parametrize("said", [{}, {"stride": "64"}])
def test_a_network_of_stride_64_gets_multiples_of_it(tmp_path: Path, said: dict[str, str]) -> None:
    """P6 networks fail on 1280x736, whose 23 rows of 32 are no whole number of 64."""
    path = free_network(tmp_path / "m.onnx", stride=64, metadata=said)
    detector = opened(path)
    assert detector.input_size((1280, 720)) == (1280, 768)
    detector.detect(np.zeros((720, 1280, 3), np.uint8))
    assert opened(free_network(tmp_path / "n.onnx", stride=32)).input_size((1280, 720)) == (1280, 736)


def test_a_free_network_gets_the_side_that_it_was_trained_at(tmp_path: Path) -> None:
    """Objects would be twice as large as in training, and half of them missed."""
    detector = opened(free_network(tmp_path / "m.onnx", stride=32, metadata={"imgsz": "[640, 640]"}))
    sizes = [(1280, 720), (640, 360), (320, 180), (100, 100)]
    assert [detector.input_size(size) for size in sizes] == [(640, 384), (640, 384), (640, 384), (224, 224)]


def free_network(path: Path, *, stride: int, metadata: dict[str, str] | None = None) -> Path:
    """A raw YOLOX head of any size that is a multiple of a stride."""
    nodes = [
        helper.make_node("MaxPool", ["images"], ["low"], kernel_shape=[stride] * 2, strides=[stride] * 2),
        helper.make_node("Resize", ["low", "", "scales"], ["again"], mode="nearest"),
        helper.make_node("Add", ["images", "again"], ["whole"]),  # fails where the sides are no multiples
    ]
    weights = np.zeros((7, 3, 1, 1), np.float32)
    constants: dict[str, Any] = {"w": weights, "flat": np.array([1, 7, -1], np.int64)}
    constants["scales"] = np.array([1, 1, stride, stride], np.float32)
    for s in (8, 16, 32):
        nodes += [
            helper.make_node("AveragePool", ["whole"], [f"p{s}"], kernel_shape=[s, s], strides=[s, s]),
            helper.make_node("Conv", [f"p{s}", "w"], [f"c{s}"]),
            helper.make_node("Reshape", [f"c{s}", "flat"], [f"r{s}"]),
        ]
    nodes.append(helper.make_node("Concat", ["r8", "r16", "r32"], ["columns"], axis=2))
    nodes.append(helper.make_node("Transpose", ["columns"], ["output"], perm=[0, 2, 1]))
    return save(
        path,
        nodes,
        inputs={"images": (1, 3, "H", "W")},
        outputs={"output": (1, "A", 7)},
        constants=constants,
        metadata=metadata,
    )


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "head"), [("pvb-2001", "ssd"), ("pvb-2003", "atss"), ("crossroad-1016-int8", "ssd")]
)
def test_models_of_the_open_model_zoo_find_people(data: Path, name: str, head: str) -> None:
    """Intel's networks for street cameras are what many have; in OpenVINO's own form they could not be opened."""
    pytest.importorskip("openvino")
    detector = OnnxDetector(open_model(data / f"models/omz/{name}.xml"), confidence=0.3)
    assert detector.head.name == head
    assert detector.model.provider.provider == "openvino"
    frames = sorted((data / "aerial/sequences_dev/otb_Crossing/img1").iterdir())
    import cv2

    image: Any = cv2.imread(str(frames[0]))
    truth = np.loadtxt(data / "aerial/sequences_dev/otb_Crossing/gt/gt.txt", delimiter=",")[0, 2:6]
    found = detector.detect(image).boxes_xyxy_px
    x1, y1 = truth[:2] - 1
    target = np.array([x1, y1, x1 + truth[2], y1 + truth[3]])
    shared = np.minimum(found[:, 2:], target[2:]) - np.maximum(found[:, :2], target[:2])
    overlap = np.clip(shared, 0, None).prod(axis=1)
    area = (found[:, 2:] - found[:, :2]).prod(axis=1) + (target[2:] - target[:2]).prod()
    assert (overlap / (area - overlap)).max() > 0.4


@pytest.mark.parametrize(("name", "swap"), [("orig_target_sizes", False), ("image_shape", True)])
def test_the_size_of_the_picture_comes_as_its_name_says(tmp_path: Path, name: str, *, swap: bool) -> None:
    """Boxes of an input that is no square would be stretched."""
    graph = Graph()
    boxes, scores = graph.find("images")
    size = graph.op("Cast", name, to=TensorProto.FLOAT)
    size = graph.op("Gather", size, graph.ints(1, 0), axis=1) if swap else size
    shares = graph.op("Div", boxes, graph.const([[320.0, 192, 320, 192]]))
    outputs = {
        "labels": graph.const([[0, 1]], np.int64),
        "boxes": graph.batch(graph.op("Mul", shares, graph.op("Concat", size, size, axis=1))),
        "scores": graph.batch(scores),
    }
    path = write(tmp_path / "m.onnx", graph, outputs, second=name)
    check(opened(path), "labels-boxes-scores")


def test_a_second_input_that_is_a_scale_is_refused(tmp_path: Path) -> None:
    """Paddle's boxes would be divided by the size of the picture (PaddleDetection#6202)."""
    graph = Graph()
    boxes, scores = graph.find("images")
    table = graph.op("Concat", boxes, graph.column(scores), graph.const([[0.0], [1.0]]), axis=1)
    path = write(tmp_path / "m.onnx", graph, {"output0": graph.batch(table)}, second="scale_factor")
    with pytest.raises(UserError, match="second input 'scale_factor' is no size of the picture"):
        opened(path)


def write(path: Path, graph: Graph, outputs: dict[str, str], *, second: str = "") -> Path:
    """A detector of 320x192 with a second input, else of 320x320."""
    high = 192 if second else 320
    inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, high, 320])]
    inputs += [helper.make_tensor_value_info(second, TensorProto.FLOAT, [1, 2])] if second else []
    graph.nodes += [helper.make_node("Identity", [tensor], [name]) for name, tensor in outputs.items()]
    ports = [
        helper.make_tensor_value_info(
            name, TensorProto.INT64 if name in ("labels", "num_dets") else TensorProto.FLOAT, None
        )
        for name in outputs
    ]
    made = helper.make_graph(graph.nodes, "two inputs", inputs, ports, graph.weights)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path
