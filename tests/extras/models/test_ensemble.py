"""Several detectors as one: what their boxes become, and which names of several are accepted."""

import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.inference.detect import open_detector
from hvt_common.inference.labels import declared_class_names, default_confidence, is_calibrated
from hvt_common.inference.store import parts_of
from hvt_common.runtime.failures import Failures
from hvt_common.values import Detections, Image
from hvt_edge.wiring import warm_up_for
from hvt_models.detectors.ensemble import EnsembleDetector, on_scale_of, open_ensemble
from hvt_models.store import Store
from media.onnx_models import colour_detector

PICTURE = np.zeros((64, 128, 3), np.uint8)
Row = tuple[tuple[float, float, float, float], float, str]


class Says:
    """Finds the same in every picture."""

    def __init__(self, class_names: tuple[str, ...], *rows: Row) -> None:
        self.class_names = class_names
        boxes = np.array([box for box, _, _ in rows], np.float32).reshape(-1, 4)
        ids = np.array([class_names.index(name) for _, _, name in rows], np.int32)
        self._found = Detections(boxes, np.array([sure for _, sure, _ in rows], np.float32), ids)

    def detect(self, _: Image) -> Detections:
        return self._found


def merged(*parts: Says, owns: tuple[float, ...] = (0.25, 0.25)) -> list[Row]:
    ensemble = EnsembleDetector(parts, owns, confidence=0.1)
    found = ensemble.detect(PICTURE)
    return [
        (tuple(round(side, 2) for side in box), round(sure, 3), ensemble.class_names[kind])
        for box, sure, kind in zip(
            found.boxes_xyxy_px.tolist(), found.confidences.tolist(), found.class_ids.tolist(), strict=True
        )
    ]


AERIAL = ("car", "truck", "pedestrian")
STREET = ("vehicle", "person", "bike")


HERE = (0, 0, 40, 20)


@pytest.mark.parametrize(
    ("first", "second", "together"),
    [
        ([(HERE, 0.6, "truck")], [((4, 0, 44, 20), 0.3, "vehicle")], [((1.33, 0, 41.33, 20), 0.6, "truck")]),
        (  # what one part alone finds or knows passes through
            [(HERE, 0.6, "car")],
            [((0, 50, 40, 70), 0.5, "bike"), ((100, 0, 110, 20), 0.4, "person")],
            [(HERE, 0.6, "car"), ((0, 50, 40, 70), 0.5, "bike"), ((100, 0, 110, 20), 0.4, "pedestrian")],
        ),
        ([(HERE, 0.6, "car")], [(HERE, 0.5, "person")], [(HERE, 0.6, "car"), (HERE, 0.5, "pedestrian")]),
    ],
)
def test_one_object_gets_one_box_with_the_mean_of_both(
    first: list[Row], second: list[Row], together: list[Row]
) -> None:
    """Every car that two networks know would have two tracks; a rider and the car behind it are two objects."""
    assert merged(Says(AERIAL, *first), Says(STREET, *second)) == together


def test_where_one_part_fails_the_others_go_on(caplog: pytest.LogCaptureFixture) -> None:
    """A processor that lost its graphics driver showed no box at all, though the other network needed none."""

    class Fails(Says):
        def detect(self, _: Image) -> Detections:
            raise RuntimeError("device lost")

    failures = Failures(lambda: 0)
    parts: dict[str, Says] = {
        "/here/a.onnx": Says(AERIAL, (HERE, 0.6, "car")),
        "/there/b.onnx": Fails(STREET),
    }
    opened = partial(open_ensemble, owns=dict.fromkeys(parts, 0.25), confidence=0.1, failures=failures)
    both = opened(lambda part, _: parts[part])
    found = both.detect(PICTURE)
    assert found is not None
    assert found.confidences.tolist() == [pytest.approx(0.6)]
    assert [(one.part, one.reason) for one in failures.now] == [("detector 2", "RuntimeError: device lost")]
    assert "detector 2: RuntimeError: device lost; all else goes on" in caplog.text
    neither = opened(lambda _part, _: Fails(STREET))
    assert neither.detect(PICTURE) is None, "that nothing is there is not known"
    assert "detector" in {one.part for one in failures.now}, "a ground would not hear that none is detected"
    config: Any = SimpleNamespace(detector="aerial-nano", candidates="decoded")
    view: Any = SimpleNamespace(base_size=(64, 64), source_size=(64, 64), enlarges=False)
    warm_up_for(config, both, view)
    for one, why in ((neither, "none of its networks does"), (Fails(STREET), "RuntimeError: device lost")):
        with pytest.raises(UserError, match=rf"detector aerial-nano does not run \({why}\): choose another"):
            warm_up_for(config, one, view)
    answers = [found, None]
    back: Any = SimpleNamespace(class_names=AERIAL, detect=lambda _: answers.pop())
    back = EnsembleDetector([back], [0.25], confidence=0.1, failures=failures)
    assert [back.detect(PICTURE) is None, back.detect(PICTURE) is None] == [True, False]
    assert "detector" not in {one.part for one in failures.now}


def test_each_part_counts_from_its_own_confidence() -> None:
    """A network whose usual scores are low would never start a track beside one whose scores are high."""
    second = Says(STREET, ((0, 0, 40, 20), 0.25, "vehicle"), ((50, 0, 90, 20), 0.1, "vehicle"))
    found = merged(Says(AERIAL), second, owns=(0.4, 0.25))
    assert [row[1] for row in found] == [0.4, 0.182]
    back = on_scale_of(np.array([0.4, 0.182], np.float32), 0.4, 0.25)
    np.testing.assert_allclose(back, [0.25, 0.1], atol=1e-3)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("aerial-nano+", "a name is missing beside a +"),
        ("aerial-nano++yolox-s", "a name is missing"),
        ("aerial-nano+aerial-nano", "names aerial-nano twice"),
        ("aerial-nano+yolox-s+pvb-2003+pvb-2001", "names 4 detectors; at most 3"),
        ("aerial-nano+motion", "motion looks at several pictures"),
        ("aerial-nano+pvb-203", "detector 'pvb-203' is not known .did you mean pvb-2003"),
    ],
)
def test_wrong_names_are_one_sentence(
    spec: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slip would end in a traceback, or fly with half of what was named."""
    monkeypatch.setenv("HVT_MODELS", str(tmp_path))
    with pytest.raises(UserError, match=words) as caught:
        open_detector(spec)
    assert "\n" not in str(caught.value)


def test_files_fly_together_and_settings_of_one_are_refused(tmp_path: Path) -> None:
    """Own files could not be merged; labels would name the classes of the wrong one."""
    first = colour_detector(
        tmp_path / "a.onnx", "yolox", metadata={"hvt.confidence": "0.4", "names": "['car', 'b', 'c']"}
    )
    second = colour_detector(tmp_path / "b.onnx", "yolox", metadata={"names": "['vehicle', 'd', 'e']"})
    spec = f"{first}+{second}"
    detector = open_detector(spec)
    assert detector.class_names == ("car", "b", "c", "vehicle", "d", "e")
    assert len(detector.detect(PICTURE)) == 0
    assert default_confidence(spec) == 0.4
    assert declared_class_names(spec) is None
    assert not is_calibrated(spec, role="detector")
    with pytest.raises(UserError, match="labels file coco has no effect"):
        open_detector(spec, labels=Path("coco"))
    plus = shutil.copy(first, tmp_path / "a+b.onnx")
    assert open_detector(str(plus)).class_names == ("car", "b", "c")


@pytest.mark.realdata
def test_the_embedded_model_flies_with_one_of_the_open_model_zoo(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The heavier pair that the manual names would not open, or not know a person seen from the side."""
    pytest.importorskip("openvino")
    monkeypatch.setenv("HVT_MODELS", str(tmp_path))
    Store().add(data / "models/omz/pvb-2003.xml", name="pvb-2003")
    detector = open_detector("aerial-nano+pvb-2003", confidence=0.4)
    assert detector.class_names == (
        *("car", "van", "truck", "bus", "motor", "pedestrian", "other"),
        *("boat", "bicycle", "vehicle"),
    )
    folder = data / "aerial/sequences_dev/otb_Crossing"
    image = cv2.imread(str(min((folder / "img1").iterdir())))
    assert image is not None
    found = detector.detect(np.asarray(image, np.uint8))
    x1, y1, width, height = np.loadtxt(folder / "gt/gt.txt", delimiter=",")[0, 2:6] - (1, 1, 0, 0)
    centre = np.array([x1 + width / 2, y1 + height / 2])
    boxes = found.boxes_xyxy_px[found.class_ids == 5]
    assert ((boxes[:, :2] < centre) & (centre < boxes[:, 2:])).all(axis=1).any()


def test_a_plus_in_a_path_joins_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model in a folder of C++ could not be named, and a long name was a traceback."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a+b.onnx").touch()
    assert parts_of("~/a+b.onnx") == ("~/a+b.onnx",)
    assert parts_of("/data/c++/missing.onnx") == ("/data/c++/missing.onnx",)
    assert parts_of(f"{'x' * 300}+b") == ("x" * 300, "b")
