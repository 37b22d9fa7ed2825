"""The words in which a dataset, a detector and a classifier with names of its own are compared."""

from __future__ import annotations

import pytest

from hvt_common.errors import UserError
from hvt_common.inference.class_names import COCO_NAMES, IMAGENET_NAMES, VISDRONE_NAMES
from hvt_study.datasets.class_map import joint_classes
from hvt_study.metrics.classes import class_score
from hvt_study.metrics.judged import judged
from studies.metric_frames import labels, square, view

UAVDT = ("bus", "car", "truck")


def test_a_right_still_is_right_in_whatever_words():
    """Every still that an ImageNet classifier names rightly would count as an error that the hybrids made."""
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, UAVDT)
    truth = labels((square(0), "car"), (square(100), "truck"), (square(200), "car"))
    shown = view(
        (square(0), "minivan", 1, 0.9, "bus"),
        (square(100), "pickup", 2, 0.9, "truck"),
        (square(200), "van", 3, 0.9, "van"),
    )
    frames = [(truth, shown)]
    after = class_score(judged(frames, word=found.word, classes=found.classes))
    before = class_score(judged(frames, word=found.word, classes=found.classes), refined=False)
    assert (after.counts.right, before.counts.right) == (3, 2)
    assert after.counts.top1_all == 1.0


def test_what_one_model_cannot_tell_apart_is_asked_of_neither():
    """The finer of two models would be punished for being fine, or the coarser for what it cannot know."""
    same = joint_classes(VISDRONE_NAMES, VISDRONE_NAMES, VISDRONE_NAMES)
    assert (same.word("car"), same.word("van")) == ("car", "van")
    for detector, reader in ((VISDRONE_NAMES, IMAGENET_NAMES), (COCO_NAMES, VISDRONE_NAMES)):
        found = joint_classes(detector, reader, VISDRONE_NAMES)
        assert {found.word(name) for name in ("car", "van")} == {"car"}, detector
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, VISDRONE_NAMES)
    assert found.spoken["minivan"] == found.spoken["van"] == ("car", "van")
    assert (found.word("pedestrian"), found.word("people")) == ("pedestrian", "people")  # ImageNet has none


def test_the_labels_that_are_asked_for_are_the_detectors():
    """The same video would be worth less beside a classifier that knows more."""
    alone = joint_classes(COCO_NAMES, None, VISDRONE_NAMES)
    read = joint_classes(COCO_NAMES, IMAGENET_NAMES, VISDRONE_NAMES)
    assert read.classes == alone.classes
    assert "tricycle" not in read.classes


def test_labels_in_the_classifiers_own_words():
    """With reference labels a still that repeats its classifier's very word would be wrong."""
    found = joint_classes(VISDRONE_NAMES, IMAGENET_NAMES, IMAGENET_NAMES)
    assert found.word("minivan") == found.word("beach wagon") == found.word("van") == "car"


def test_a_classifier_of_other_things():
    """Hours of flights whose stills can say nothing about the labels."""
    with pytest.raises(UserError, match="have nothing in common"):
        joint_classes(VISDRONE_NAMES, ("cat", "dog"), UAVDT)
