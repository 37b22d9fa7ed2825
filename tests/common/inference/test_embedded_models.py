"""The models that come with the package: that they open, say what they are, and are as good as documented."""

import json
from typing import Any

import cv2
import numpy as np
import pytest

from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.inference.labels import default_confidence
from hvt_common.inference.runtimes.model import open_model
from hvt_common.inference.store import EMBEDDED_CLASSIFIER, EMBEDDED_DETECTOR, embedded_models
from hvt_common.values import iou
from hvt_scene import Scene
from hvt_study.cli import main
from hvt_train.evaluate import (
    CLEAN,
    clip_frames,
    drawn_pictures,
    evaluate_drawn,
    evaluate_real,
    reference_vehicles,
)
from hvt_train.pictures.crops import held_out_crops


def test_they_are_there_and_small_together():
    """A fresh installation would have no model, or a package too large for a thin link."""
    sizes = [path.stat().st_size for path in embedded_models().values()]
    assert all(size > 10_000 for size in sizes)
    assert sum(sizes) < 6_000_000


@pytest.mark.parametrize("name", embedded_models())
def test_metadata_says_classes_licence_and_where_it_comes_from(name):
    """Nobody could tell what a file in the field is, or whether it may be passed on."""
    metadata = open_model(embedded_models()[name]).metadata
    assert metadata["model"] == name
    assert metadata["license"] == "Apache-2.0"
    assert len(metadata["hvt.training_commit"]) >= 7
    assert metadata["hvt.training_date"].startswith("20")
    assert metadata["hvt.training_seed"].isdigit()


def test_the_names_are_those_of_the_scene():
    """Ground truth of the demo and what the models say could not be compared."""
    assert open_detector(EMBEDDED_DETECTOR).class_names == (*Scene.class_names, "boat", "bicycle")
    assert open_classifier(EMBEDDED_CLASSIFIER).class_names == Scene.class_names


def test_a_score_is_the_calibrated_one_whatever_the_class():
    """Of vehicles that were .87 sure .98 were right: the class's share was the most that a score could be."""
    answer = open_model(embedded_models()[EMBEDDED_DETECTOR]).run(np.full((1, 3, 64, 64), 90, np.float32))[0]
    own = answer[0, : 8 * 8 + 4 * 4 + 2 * 2]
    np.testing.assert_allclose(own[:, 5:].max(axis=1), 1, rtol=1e-4)


def test_any_picture_size_goes_in():
    """A camera of another shape would end in an error of the runtime."""
    detector = open_detector(EMBEDDED_DETECTOR)
    for shape in ((64, 64, 3), (100, 333, 3), (720, 1280, 3)):
        found = detector.detect(np.full(shape, 90, np.uint8))
        assert len(found) <= 2  # an empty grey picture shows nothing to speak of


@pytest.mark.nightly
def test_detector_on_held_out_scenes():
    """The demo would show a detector that finds nothing, and a retrained file could be worse unseen."""
    floors = {CLEAN: 0.80, 800_000: 0.70}
    pictures = drawn_pictures(range(200, 203), moments=1, bitrates_bps=tuple(floors), coded_frames=5)
    detector = open_detector(EMBEDDED_DETECTOR, confidence=0.01)
    for bitrate_bps, floor in floors.items():
        assert evaluate_drawn(detector, pictures[bitrate_bps]).mean >= floor


@pytest.mark.nightly
def test_classifier_on_held_out_stills():
    """Stills would turn right classes into wrong ones."""
    stills = list(held_out_crops(range(200, 202), moments=1))
    assert len(stills) > 50
    posteriors = open_classifier(EMBEDDED_CLASSIFIER).classify([image for image, _ in stills])
    hits = [p.class_name == name for p, (_, name) in zip(posteriors, stills, strict=True)]
    assert np.mean(hits) >= 0.90


@pytest.mark.realdata
def test_vehicles_on_real_pixels(data):
    """Whoever brings their own clip would see nothing found: drawn scenes alone prove little."""
    frames = list(clip_frames(data / "clips" / "drone_carpark.mp4", every=150))
    truth = reference_vehicles(data / "models" / "yolov5su_visdrone_736x1280.onnx", frames)
    assert sum(map(len, truth)) > 100
    result = evaluate_real(open_detector(EMBEDDED_DETECTOR, confidence=0.25), frames, truth)
    assert result.recall >= 0.80
    assert result.precision >= 0.75


@pytest.mark.nightly
@pytest.mark.realdata
def test_vehicles_and_people_that_training_never_saw(data, tmp_path):
    """Paint marks and shrubs would be people, and the ground of a real town full of cars."""
    scored = {}
    sets = {
        "minsk_dev": ("car,truck,bus,minibus,cyclist", "vehicle"),
        "hit_uav": ("Person,Car,Bicycle,OtherVehicle,DontCare", "person,vehicle"),
    }
    for name, (classes, labelled) in sets.items():
        place, out = data / "aerial" / name, tmp_path / name
        options = ["--classes", classes, "--labelled", labelled, "--vehicles-as-one", "--provider", "cpu"]
        assert main(["detect", str(place), "--out", str(out), *options]) == 0
        scored[name] = json.loads((out / "score.json").read_text())["by_class"]
    minsk = scored["minsk_dev"]["vehicle"]
    assert minsk["recall"] >= 0.95
    assert minsk["precision"] >= 0.60
    assert scored["hit_uav"]["person"]["recall"] >= 0.35, "most of these flights were trained on"


@pytest.mark.nightly
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "share"), [("uav123_car10", 0.9), ("uavdt_S0601", 0.5), ("otb_Crossing", 0.8)]
)
def test_what_is_seen_aslant(data, name, share):
    """A camera that does not look straight down would show a street with nobody in it."""
    folder = data / "aerial" / "sequences_dev" / name
    labels = np.loadtxt(folder / "gt" / "gt.txt", delimiter=",")[::8]
    detector = open_detector(EMBEDDED_DETECTOR, confidence=default_confidence(EMBEDDED_DETECTOR))
    found = 0
    for frame, _, x, y, width, height in labels[:, :6]:
        picture: Any = cv2.imread(str(folder / "img1" / f"{int(frame):06d}.jpg"))
        scale = min(1280 / picture.shape[1], 720 / picture.shape[0])
        boxes = detector.detect(cv2.resize(picture, None, fx=scale, fy=scale)).boxes_xyxy_px / scale
        truth = np.array([[x, y, x + width, y + height]], np.float32)
        found += bool(len(boxes)) and iou(boxes, truth).max() >= 0.5
    assert found / len(labels) >= share


@pytest.mark.nightly
@pytest.mark.realdata
def test_asphalt_shows_nobody(data):
    """Chipped paint and stones were pedestrians, .99 sure."""
    detector = open_detector(EMBEDDED_DETECTOR, confidence=default_confidence(EMBEDDED_DETECTOR))
    frames = list(clip_frames(data / "clips" / "intel_car-detection.mp4", every=40))
    found = [detector.class_names[kind] for frame in frames for kind in detector.detect(frame).class_ids]
    assert found.count("pedestrian") <= len(frames)
