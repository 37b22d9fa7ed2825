"""The hint that another model, or another size, finds more: once, and only where something else does."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hvt_common.inference.few_found import FewFoundHint, ViewTrust
from hvt_common.inference.retried import RetriedDetector
from hvt_common.runtime.failures import Failures
from hvt_common.values import Detections

STILL = np.full((120, 160, 3), 90, np.uint8)


def found(confidence: float) -> Detections:
    """One detection."""
    return Detections(
        np.array([[0, 0, 9, 9]], np.float32), np.array([confidence], np.float32), np.zeros(1, np.int32)
    )


def said(caplog, detector: str, looks: list[Detections]) -> list[str]:
    """What is logged over these looks."""
    hint = FewFoundHint(detector, confidence=0.25)
    for look in looks:
        hint.take(look, STILL, lambda _: Detections.none())
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("weak", [Detections.none(), found(0.2)])
def test_a_view_that_it_does_not_know(caplog, weak):
    """A first user would see an empty picture, and take HVT for broken."""
    sentences = said(caplog, "aerial-nano", [*[weak] * 96, found(0.9), *[weak] * 200])
    assert len(sentences) == 1
    assert "aerial-nano found something on 0 of the first 45 pictures" in sentences[0]
    assert "hvt-models fetch yolox-s" in sentences[0]


def test_a_view_that_it_knows_or_a_flight_that_is_young(caplog):
    """A hint that is wrong is worse than none."""
    looks = [found(0.9), *[Detections.none()] * 8]
    assert said(caplog, "aerial-nano", looks * 20) == []
    assert said(caplog, "aerial-nano", [Detections.none()] * 44) == []


@pytest.mark.parametrize("detector", ["aerial-nano", "boat.onnx"])
def test_what_is_found_enlarged_is_found(caplog, detector):
    """Who sees two hundred small objects would be told that nothing is found, and sent to another model."""
    finds = SimpleNamespace(
        detect=lambda image: found(0.9) if image.shape[0] > STILL.shape[0] else Detections.none()
    )
    hint = FewFoundHint(detector, confidence=0.25)
    retried = RetriedDetector(lambda: finds, Failures(lambda: 0), hint=hint)
    large = np.repeat(STILL, 2, axis=0)
    for index in range(100):
        retried.detect(moving(index % 60))
        retried.detect_whole(large)
    assert not caplog.records


@pytest.mark.parametrize("detector", ["motion", "boat.onnx", "yolox-s", "acme-blobs:x"])
def test_who_chose_a_model_needs_no_advice_where_nothing_is(caplog, detector):
    """Somebody who looks for boats would be sent to a model of cars."""
    assert said(caplog, detector, [Detections.none()] * 100) == []


def moving(index: int) -> np.ndarray:
    """A bright square that goes right."""
    image = STILL.copy()
    image[40:60, 2 * index : 2 * index + 20] = 250
    return image


def test_a_model_that_finds_nothing_where_something_moves_is_said(caplog):
    """A file that is read wrongly finds nothing for a whole flight, without a word."""
    hint = FewFoundHint("boat.onnx", confidence=0.25)
    for index in range(100):
        hint.take(Detections.none(), moving(index % 60), lambda _: Detections.none())
    (record,) = caplog.records
    assert "boat.onnx found nothing on the first 45 pictures, and something moves in " in record.getMessage()
    assert "hvt-models info boat.onnx" in record.getMessage()


@pytest.mark.parametrize("size", ["twice", "half"])
def test_a_model_that_finds_something_at_another_size_is_said(caplog, size):
    """Objects too small or too large for the network are missed, and tiles or a size would show them."""
    patch = STILL.copy()
    patch[50:70, 70:90] = 250

    def detect(image: np.ndarray) -> Detections:
        bright = int((image[:, :, 0] > 200).sum())
        return found(0.9) if (bright > 1000 if size == "twice" else bright < 200) else Detections.none()

    hint = FewFoundHint("boat.onnx", confidence=0.25)
    for _ in range(100):
        hint.take(Detections.none(), patch, detect)
    (record,) = caplog.records
    assert f"it finds something at {size} the size" in record.getMessage()


def test_a_model_that_finds_something_is_left_in_peace(caplog):
    """A hint that is wrong is worse than none."""
    hint = FewFoundHint("boat.onnx", confidence=0.25)
    for index in range(100):
        hint.take(found(0.9) if index == 40 else Detections.none(), moving(index % 60), lambda _: found(0.9))
    assert not caplog.records


def many(*confidences: float) -> Detections:
    """Detections of these confidences."""
    count = len(confidences)
    return Detections(
        np.zeros((count, 4), np.float32), np.array(confidences, np.float32), np.zeros(count, np.int32)
    )


WATER = many(0.7, 0.45, 0.43, 0.2, 0.1)
STREET = many(0.9, 0.8, 0.45, 0.2)


def test_a_view_that_it_does_not_know_is_said_once_and_left_again(caplog):
    """Boxes that are right half the time would look like those that are right nine times in ten."""
    trust = ViewTrust("aerial-nano", hence="are drawn thin and unnamed")
    for _ in range(14):
        trust.take(WATER)
    assert not trust.unlike
    trust.take(WATER)
    assert trust.unlike
    (record,) = caplog.records
    assert "its last 45 boxes have a mean confidence of 0.53" in record.getMessage()
    for way in ("hvt-models fetch yolox-s", "--detector yolox-s", "hvt-study train"):
        assert way in record.getMessage()
    for _ in range(45):
        trust.take(STREET)
    assert not trust.unlike
    for _ in range(45):
        trust.take(WATER)
    assert trust.unlike
    assert len(caplog.records) == 1


def test_another_scene_is_told_from_the_one_before_within_seconds():
    """Boxes of water would pass for cars for a quarter of a minute after a street of a hundred of them."""
    trust = ViewTrust("aerial-nano", hence="")
    for _ in range(45):
        trust.take(many(*[0.8] * 100))
    for _ in range(15):
        assert not trust.unlike
        trust.take(WATER)
    assert trust.unlike
    for _ in range(10):
        trust.take(many(*[0.8] * 100))
    assert not trust.unlike


@pytest.mark.parametrize("view", [STREET, many(), many(0.41)])
def test_a_view_that_it_knows_or_that_is_nearly_empty_is_trusted(view):
    """A field with one far car now and then would be called unknown."""
    trust = ViewTrust("aerial-nano", hence="are drawn thin and unnamed")
    for index in range(200):
        trust.take(view if index % 2 or view is STREET else many())
        assert not trust.unlike


def test_scores_that_are_no_probabilities_say_nothing():
    """A network whose scores are low by habit would never have a name."""
    trust = ViewTrust("boat.onnx", hence="")
    for _ in range(200):
        trust.take(WATER)
    assert not trust.unlike
