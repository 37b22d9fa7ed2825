"""Class names: from files, from metadata, and what they mean."""

from pathlib import Path

import pytest

from hvt_common.errors import UserError
from hvt_common.inference.class_names import COCO_NAMES, VISDRONE_NAMES, kind_of, same_kind
from hvt_common.inference.labels import (
    default_confidence,
    detector_labels,
    first_synonym,
    is_calibrated,
    metadata_labels,
    read_labels,
    uncalibrated,
)
from media.onnx_models import colour_detector


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (
            "\ufeffcar\r\n traffic light \r\ncrane\r\ncrane\r\n\r\n",
            ("car", "traffic light", "crane", "crane"),
        ),
        ("0 car\n1 bus", ("car", "bus")),
        ("1: car\n2: traffic light", ("car", "traffic light")),
        ("0,car\n1,bus", ("car", "bus")),
        ("n02084071 dog, domestic dog\nn02958343 car", ("dog, domestic dog", "car")),
        ("1 bus\n0 car", ("car", "bus")),
        ("- car\n- bus", ("car", "bus")),
        ("'car'\n'bus'", ("car", "bus")),
        ("2 wheeler\n4 wheeler", ("2 wheeler", "4 wheeler")),
        ("1 tonner", ("1 tonner",)),
    ],
)
def test_a_line_is_a_name_without_the_number_before_it(tmp_path, content, names):
    """No kind would be known: "2 car" is no car, and "n02958343 car" is nothing."""
    path = tmp_path / "labels.txt"
    path.write_bytes(content.encode())
    assert read_labels(path) == names


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "does not exist"),
        (b"", "empty"),
        (b"path: .\nnames:\n  0: car\n", "'names:' in line 2; .*, no table"),
        (b"names: car\n", "in line 1; .*, no table"),
        (b'["car", "bus"]', "in line 1; .*, no table"),
        (b"item {\n  id: 1\n}\n", "in line 1; .*, no table"),
        (b" \n\n", "empty"),
        (b"car\n\nbus\n", "no name in line 2"),
        (b"car\n" + b"x" * 201, "201 characters in line 2"),
        (b"\xff\x00car", "not UTF-8"),
        (b"car\x00\x01\n", "not text in line 1"),
        (b"a\n" * 100_001, "100001 lines"),
        (b"a" * (17 << 20), "larger than"),
    ],
)
def test_a_file_that_holds_no_labels_is_refused(tmp_path, content, words):
    """Every class would be called something else."""
    path = tmp_path / "labels.txt"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_labels(path)
    assert str(path) in str(caught.value)
    with pytest.raises(UserError, match="is not a file"):
        read_labels(tmp_path)


@pytest.mark.parametrize(
    ("metadata", "names"),
    [
        ({"names": "{0: 'car', 1: 'bus'}"}, ("car", "bus")),
        ({"names": "{'1': 'bus', '0': 'car'}"}, ("car", "bus")),
        ({"names": "['car', 'bus']"}, ("car", "bus")),
        ({"names": '{"0": "car", "1": "bus"}'}, ("car", "bus")),
        ({"classes": '["car", "bus"]'}, ("car", "bus")),
        ({}, None),
        ({"names": "{0: 'car', 3: 'bus'}"}, ("car", "class 1", "class 2", "bus")),
        ({"names": '["car", null, " "]'}, ("car", "class 1", "class 2")),
        ({"names": "null"}, None),
        ({"names": "{0: 'car', 1: 'bus'"}, None),
        ({"names": "{0: ['car'], 1: ['bus']}"}, None),
        ({"names": "car, small bus\nlorry"}, ("car", "small bus", "lorry")),
        ({"classes": '{"0": "car", "1": "bus"}'}, ("car", "bus")),
        ({"names": "{0: 'car', 100000: 'bus'}"}, None),
        ({"names": "{0: 'car', 'x': 'bus'}"}, None),
        ({"names": "__import__('os').getcwd()"}, None),
        ({"names": "(" * 5000}, None),
        ({"names": "{}"}, None),
        ({"classes": "[" * 100_000}, None),
        ({"classes": "3"}, None),
        ({"names": "{0: small car, 1: bus}"}, ("small car", "bus")),
        (
            {"names": "{0: driver's seat, 1: car [small], 2: 'a bus'}"},
            ("driver's seat", "car [small]", "a bus"),
        ),
        ({"names": "{0: [car, 1: bus}"}, None),
        ({"names": "{0: 'car, 1: bus}"}, None),
        ({"classes": '{"bus": 1, "car": 0}'}, ("car", "bus")),
        ({"names": '{"nc": 2}'}, None),
        ({"names": "[{'id': 0, 'name': 'car'}]"}, None),
        ({"names": "0: car\n1: bus"}, ("car", "bus")),
        ({"names": "- car\n- 'bus'"}, ("car", "bus")),
        ({"names": "[small car, bus]"}, ("small car", "bus")),
        ({"names": r"{0: 'a\ud800', 1: 'b\nc', 2: ''}"}, ("a?", "b?c", "class 2")),
    ],
)
def test_names_in_metadata_are_read_but_never_run(metadata, names):
    """A model without a labels file would show numbers, and a hostile one could run code."""
    assert metadata_labels(metadata) == names


def test_class_lists_have_their_published_sizes_and_order():
    """A model without names would call a truck a boat."""
    assert len(COCO_NAMES) == len(set(COCO_NAMES)) == 80
    coco = {0: "person", 2: "car", 5: "bus", 7: "truck", 37: "surfboard", 79: "toothbrush"}
    assert {number: COCO_NAMES[number] for number in coco} == coco
    assert [VISDRONE_NAMES[i] for i in (0, 3, 9)] == ["pedestrian", "car", "motor"]
    assert [first_synonym(one) for one in ("beach wagon, station wagon, wagon", ",")] == ["beach wagon", ","]


def of_kinds(names, wanted):
    return {name for name in names if any(same_kind(name, word) for word in wanted)}


def test_the_words_of_the_pilot_reach_every_detector():
    """A class list drawn up for COCO would find no person in a VisDrone detector."""
    wanted = ("car", "truck", "bus", "person")
    assert of_kinds(VISDRONE_NAMES, wanted) == {"pedestrian", "people", "car", "van", "truck", "bus"}
    assert of_kinds(COCO_NAMES, wanted) == set(wanted)
    assert of_kinds(("moving",), wanted) == {"moving"}
    assert of_kinds(("tree",), wanted) == set()


def test_imagenet_words_have_a_kind():
    """A still's class would never agree with the track's."""
    kinds = {
        "minivan": "car",
        "Model T": "car",
        "beach wagon, station wagon": "car",
        "trailer truck": "truck",
        "moving van": "truck",
        "trolleybus": "bus",
        "motor scooter": "motor",
        "Oak Tree": "oak tree",
        "passenger car, coach, carriage": "train",
    }
    assert {name: kind_of(name) for name in kinds} == kinds
    assert all(same_kind(name, kind) and not same_kind(name, "zebra") for name, kind in kinds.items())


@pytest.mark.realdata
def test_every_imagenet_row_of_the_table_is_an_imagenet_class(data):
    """A typo in the table would cost one class of vehicles its kind."""
    labels = read_labels(data / "models/imagenet_labels_1001.txt")
    words = {
        *[
            "minivan",
            "sports car",
            "convertible",
            "cab",
            "jeep",
            "limousine",
            "beach wagon",
            "racer",
            "model t",
        ],
        *("minibus", "school bus", "trolleybus", "trailer truck", "moving van", "pickup", "garbage truck"),
        *("tow truck", "fire engine", "moped", "motor scooter", "police van", "ambulance", "golfcart"),
    }
    assert words <= {first_synonym(label).casefold() for label in labels}
    assert {word: kind_of(word) for word in words if kind_of(word) == word} == {}


# From where a detector's scores count, and whether they are probabilities, stands in its file.


def test_a_detector_brings_its_own_threshold(tmp_path):
    """A calibrated detector would be used at the wrong confidence; nonsense would be taken for one."""
    path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": "0.4"})
    plain = colour_detector(tmp_path / "e.onnx", "yolox")
    assert [default_confidence(str(one)) for one in (path, plain, "motion")] == [0.4, 0.25, 0.25]
    for text in ("high", "0", "1.5", "nan", ""):
        path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": text})
        with pytest.raises(
            UserError, match=r"d\.onnx has hvt\.confidence .* a number from 0\.01 to 1 is acc"
        ):
            default_confidence(str(path))


def test_a_model_says_whether_its_scores_are_probabilities(tmp_path):
    """Sums of scores would be taken for numbers of objects; ``--classifier motion`` was "not known (… motion?)"."""
    plain = colour_detector(tmp_path / "d.onnx", "yolox")
    fitted = colour_detector(tmp_path / "e.onnx", "yolox", metadata={"hvt.calibration": "1.6 0.3"})
    found = [is_calibrated(str(one), role="detector") for one in (plain, fitted, "aerial-nano", "motion")]
    assert found == [False, True, True, False]
    assert "detector d.onnx has no calibration" in uncalibrated("detector", str(plain))
    with pytest.raises(UserError, match="classifier 'motion' is not known: give one of aerial-nano"):
        is_calibrated("motion", role="classifier")


def test_who_has_a_detector_without_names_is_told_how_each_side_gives_them(caplog):
    """At the ground ``--labels`` names a classifier's classes: whoever did as told was refused."""
    assert detector_labels(Path("nameless.onnx"), None, "", head="", classes=1, inputs=1) == ("class 0",)
    assert "--labels FILE (hvt-ground: --detector-labels FILE) names them" in caplog.text
