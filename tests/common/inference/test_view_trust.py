"""The sentence that a view is unlike what the detector knows, and what follows from it."""

import numpy as np
import pytest

from hvt_common.inference.view_trust import ViewTrust, trust_from
from rigs.examples import detections


def many(*confidences):
    count = len(confidences)
    return detections(np.zeros((count, 4)), confidences)


WATER = many(0.6, 0.35, 0.25, 0.1)
STREET = many(0.9, 0.8, 0.25, 0.1)


def test_a_view_that_it_does_not_know_is_said_once_and_left_again(caplog):
    """Boxes that are right half the time would look like those that are right nine times in ten."""
    trust = ViewTrust(trust_from("aerial-nano"), hence="are drawn thin and unnamed")
    for picture in range(10):
        assert not caplog.records, "few pictures are not worth a warning"
        assert trust.unlike == (picture >= 5)
        trust.take(WATER)
    (record,) = caplog.records
    assert "its last 30 boxes have a mean confidence of 0.40" in record.getMessage()
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
    trust = ViewTrust(trust_from("aerial-nano"), hence="")
    for _ in range(45):
        trust.take(many(*[0.8] * 100))
    for _ in range(15):
        assert not trust.unlike
        trust.take(WATER)
    assert trust.unlike
    for _ in range(10):
        trust.take(many(*[0.8] * 100))
    assert not trust.unlike


@pytest.mark.parametrize(
    ("view", "detector"),
    [
        *((one, "aerial-nano") for one in (STREET, many(), many(0.21), many(0.45), many(0.7, 0.25))),
        (WATER, "b.onnx"),
    ],
)
def test_a_view_that_it_knows_or_that_is_nearly_empty_is_trusted(view, detector):
    """A good flight would be drawn thin; scores that are no probabilities say nothing."""
    trust = ViewTrust(trust_from(detector), hence="are drawn thin and unnamed")
    for index in range(200):
        trust.take(view if index % 2 or view is STREET or view is WATER else many())
        assert not trust.unlike
