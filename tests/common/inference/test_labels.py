"""Class names: from files, from metadata, and what they mean."""

from __future__ import annotations

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


def test_one_name_a_line(tmp_path: Path) -> None:
    """Every class would carry its neighbour's name."""
    path = tmp_path / "labels.txt"
    path.write_bytes("\ufeffcar\r\n traffic light \r\ncrane\r\ncrane\r\n\r\n".encode())
    assert read_labels(path) == ("car", "traffic light", "crane", "crane")


@pytest.mark.parametrize(
    ("content", "names"),
    [
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
def test_a_number_before_each_name_is_none_of_it(
    tmp_path: Path, content: str, names: tuple[str, ...]
) -> None:
    """No kind would be known: "2 car" is no car, and "n02958343 car" is nothing."""
    path = tmp_path / "labels.txt"
    path.write_text(content)
    assert read_labels(path) == names


@pytest.mark.parametrize(
    ("content", "words"),
    [
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
def test_a_file_that_holds_no_labels_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    """A wrong file would label every object with nonsense, or end in a traceback."""
    path = tmp_path / "labels.txt"
    path.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_labels(path)
    assert str(path) in str(caught.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    """A mistyped path would end in a traceback."""
    with pytest.raises(UserError, match="does not exist"):
        read_labels(tmp_path / "none.txt")
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
        ({"names": '["car", null]'}, ("car", "None")),
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
        ({"classes": '{"bus": 1, "car": 0}'}, ("car", "bus")),
        ({"names": '{"nc": 2}'}, None),
        ({"names": "[{'id': 0, 'name': 'car'}]"}, None),
        ({"names": "0: car\n1: bus"}, ("car", "bus")),
        ({"names": "- car\n- 'bus'"}, ("car", "bus")),
        ({"names": "[small car, bus]"}, ("small car", "bus")),
        ({"names": r"{0: 'a\ud800', 1: 'b\nc', 2: ''}"}, ("a?", "b?c", "class 2")),
    ],
)
def test_names_in_metadata_are_read_but_never_run(
    metadata: dict[str, str], names: tuple[str, ...] | None
) -> None:
    """A model without a labels file would show numbers, and a hostile one could run code."""
    assert metadata_labels(metadata) == names


def test_the_first_synonym_is_shown() -> None:
    """An overlay would be covered by six words for an estate car."""
    assert first_synonym("beach wagon, station wagon, wagon") == "beach wagon"
    assert first_synonym(",") == ","


def test_class_lists_have_their_published_sizes_and_order() -> None:
    """A car would be called a bus by every model without labels."""
    assert len(COCO_NAMES) == len(set(COCO_NAMES)) == 80
    assert [COCO_NAMES[i] for i in (0, 2, 5, 7, 37, 79)] == [
        "person",
        "car",
        "bus",
        "truck",
        "surfboard",
        "toothbrush",
    ]
    assert [VISDRONE_NAMES[i] for i in (0, 3, 9)] == ["pedestrian", "car", "motor"]


def of_kinds(names, wanted) -> set[str]:
    """Those names that mean a wanted kind."""
    return {name for name in names if any(same_kind(name, word) for word in wanted)}


def test_the_words_of_the_pilot_reach_every_detector() -> None:
    """A class list drawn up for COCO would find no person in a VisDrone detector."""
    wanted = ("car", "truck", "bus", "person")
    assert of_kinds(VISDRONE_NAMES, wanted) == {"pedestrian", "people", "car", "van", "truck", "bus"}
    assert of_kinds(COCO_NAMES, wanted) == set(wanted)
    assert of_kinds(("moving",), wanted) == {"moving"}
    assert of_kinds(("tree",), wanted) == set()


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("minivan", "car"),
        ("Model T", "car"),
        ("beach wagon, station wagon", "car"),
        ("trailer truck", "truck"),
        ("moving van", "truck"),
        ("trolleybus", "bus"),
        ("motor scooter", "motor"),
        ("passenger car, coach, carriage", "train"),
        ("Oak Tree", "oak tree"),
    ],
)
def test_imagenet_words_have_a_kind(name: str, kind: str) -> None:
    """Class before and class after a still could not be compared."""
    assert kind_of(name) == kind
    assert same_kind(name, kind)
    assert not same_kind(name, "zebra")


@pytest.mark.realdata
def test_every_imagenet_row_of_the_table_is_an_imagenet_class(data: Path) -> None:
    """A misspelt row would never match."""
    imagenet = {
        first_synonym(label).casefold() for label in read_labels(data / "models/imagenet_labels_1001.txt")
    }
    words = {
        "minivan",
        "sports car",
        "convertible",
        "cab",
        "jeep",
        "limousine",
        "beach wagon",
        "racer",
        "model t",
    }
    words |= {"minibus", "school bus", "trolleybus", "trailer truck", "moving van", "pickup", "garbage truck"}
    words |= {"tow truck", "fire engine", "moped", "motor scooter", "police van", "ambulance", "golfcart"}
    assert words <= imagenet
    assert {word: kind_of(word) for word in words if kind_of(word) == word} == {}


# From where a detector's scores count, and whether they are probabilities, stands in its file.


def test_a_detector_brings_its_own_threshold(tmp_path):
    """Every user would have to know that these weights want .4."""
    path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": "0.4"})
    assert default_confidence(str(path)) == 0.4
    assert default_confidence(str(colour_detector(tmp_path / "e.onnx", "yolox"))) == 0.25
    assert default_confidence("motion") == 0.25


@pytest.mark.parametrize("text", ["high", "0", "1.5", "nan", ""])
def test_a_threshold_that_makes_no_sense_is_refused(tmp_path, text):
    """Everything, or nothing, would be an object."""
    path = colour_detector(tmp_path / "d.onnx", "yolox", metadata={"hvt.confidence": text})
    with pytest.raises(
        UserError, match=r"d\.onnx has hvt\.confidence .* a number from 0\.01 to 1 is accepted"
    ):
        default_confidence(str(path))


def test_a_model_says_whether_its_scores_are_probabilities(tmp_path):
    """A check mark would stand for nothing."""
    plain = colour_detector(tmp_path / "d.onnx", "yolox")
    fitted = colour_detector(tmp_path / "e.onnx", "yolox", metadata={"hvt.calibration": "1.6 0.3"})
    assert not is_calibrated(str(plain), role="detector")
    assert is_calibrated(str(fitted), role="detector")
    assert is_calibrated("aerial-nano", role="detector")
    assert not is_calibrated("motion", role="detector")
    assert "detector d.onnx has no calibration" in uncalibrated("detector", str(plain))


def test_who_has_a_detector_without_names_is_told_how_each_side_gives_them(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """At the ground ``--labels`` names a classifier's classes: whoever did as told was refused."""
    assert detector_labels(Path("nameless.onnx"), None, "", head="", classes=1, inputs=1) == ("class 0",)
    assert "--labels FILE (hvt-ground: --detector-labels FILE) names them" in caplog.text


def test_the_motion_detector_is_not_offered_as_a_classifier():
    """``--classifier motion`` was "not known (did you mean motion?)"."""
    with pytest.raises(UserError, match="classifier 'motion' is not known: give one of aerial-nano"):
        is_calibrated("motion", role="classifier")
