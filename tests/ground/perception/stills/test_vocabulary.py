"""A classifier of other words says what its words mean for a track, or nothing."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hvt_common.errors import UserError
from hvt_common.inference.class_names import COCO_NAMES, IMAGENET_NAMES, group_of
from hvt_common.inference.classify import open_classifier
from hvt_common.inference.detect import open_detector
from hvt_common.values import Posterior
from hvt_edge.perception.candidates import PADDING
from hvt_ground.perception.fusion.fuse import unified_names
from hvt_ground.perception.stills.refine import Refiner, ViewTilt
from hvt_ground.perception.stills.vocabulary import LEAST_SIDE_PX, Vocabulary, check_common
from rigs.examples import seen, tracks_of

AERIAL = ("car", "van", "truck", "bus", "motor", "pedestrian", "other")
VEHICLES = {"car", "van", "truck", "bus", "motor"}


def says(names, **probabilities):
    """A classifier's answer; what is left of 1 goes to all others alike."""
    p = np.zeros(len(names), np.float32)
    for name, value in probabilities.items():
        p[names.index(name.replace("_", " "))] = value
    p[p == 0] = (1 - p.sum()) / max(1, (p == 0).sum())
    best = int(p.argmax())
    return Posterior(names[best], float(p[best]), 1.0, p)


def test_the_same_words_mean_the_same():
    """The embedded pair would lose what it was trained to say."""
    words = Vocabulary(AERIAL, AERIAL)
    answer = says(AERIAL, van=0.7, other=0.2)
    vote, _ = words.vote(answer, called="car", side_px=30)
    assert words.names == AERIAL
    assert vote is not None
    assert (vote.class_name, vote.confidence) == ("van", pytest.approx(0.7))
    np.testing.assert_allclose(vote.probabilities, answer.probabilities, rtol=1e-5)
    entropy = -sum(p * math.log(p) for p in answer.probabilities.tolist())
    assert vote.entropy_nats == pytest.approx(entropy, rel=1e-4)


def test_a_name_that_a_model_has_twice_moves_no_other():
    """Every truck would be called a bus, and the last class end the session, where two classes are called car."""
    names, edge_ids = unified_names(("car", "car", "truck"), ("Truck", "bus"))
    words = Vocabulary(names, ("car", "car", "truck"))
    assert words.names == ("car", "car", "truck", "bus")
    assert [words.names[place] for place in edge_ids] == ["truck", "bus"]
    vote, _ = words.vote(says(("car", "car", "truck"), truck=0.9), called="truck", side_px=30)
    assert vote is not None
    assert vote.probabilities.argmax() == 2


def test_imagenet_tells_a_vehicle_from_a_person_and_no_more():
    """A network of photographs would rename a car seen from above a moving van."""
    words = Vocabulary(AERIAL, IMAGENET_NAMES)
    vote, _ = words.vote(says(IMAGENET_NAMES, moving_van=0.5, minivan=0.4), called="bus", side_px=40)
    assert vote is not None
    assert (vote.class_name, vote.confidence) == ("bus", pytest.approx(0.905, abs=0.01))
    likely = dict(zip(words.names, vote.probabilities.tolist(), strict=True))
    assert {likely[name] for name in VEHICLES} == {likely["car"]}
    assert likely["pedestrian"] < 0.01
    kinds = Vocabulary(AERIAL, IMAGENET_NAMES, kinds=True)
    paper, _ = kinds.vote(says(IMAGENET_NAMES, moving_van=0.9), called="bus", side_px=40)
    assert paper is not None
    assert paper.class_name == "truck"


def test_what_means_no_class_is_a_note():
    """A car would become a waffle iron."""
    words = Vocabulary(AERIAL, IMAGENET_NAMES)
    for name, text in (("waffle_iron", "waffle iron .31"), ("Japanese_spaniel", "Japanese spaniel .31")):
        vote, note = words.vote(says(IMAGENET_NAMES, **{name: 0.31}), called="car", side_px=40)
        assert (vote, note) == (None, text)
    dogs = Vocabulary(COCO_NAMES, IMAGENET_NAMES)
    vote, note = dogs.vote(says(IMAGENET_NAMES, Japanese_spaniel=0.8), called="cat", side_px=40)
    assert vote is not None, "a detector that knows animals may hear of one"
    assert vote.class_name == "cat"


def test_a_small_object_gets_no_vote_of_imagenet():
    """Ten pixels blown up to 224 look like anything; the embedded classifier was trained on them."""
    answer = says(IMAGENET_NAMES, minivan=0.9)
    words = Vocabulary(AERIAL, IMAGENET_NAMES)
    assert words.vote(answer, called="car", side_px=LEAST_SIDE_PX - 0.1)[0] is None
    assert words.vote(answer, called="car", side_px=LEAST_SIDE_PX)[0] is not None
    small, _ = Vocabulary(AERIAL, AERIAL).vote(says(AERIAL, car=0.9), called="car", side_px=10)
    assert small is not None


def test_other_names_of_a_kind_are_understood():
    """A user's classifier would have to be trained on our words."""
    words = Vocabulary(AERIAL, ("automobile", "lorry", "person", "tree"))
    for said, meant in (("automobile", "car"), ("lorry", "truck"), ("person", "pedestrian")):
        vote, _ = words.vote(
            says(("automobile", "lorry", "person", "tree"), **{said: 0.9}), called="x", side_px=9
        )
        assert vote is not None
        assert vote.class_name == meant
    tree = words.vote(says(("automobile", "lorry", "person", "tree"), tree=0.9), called="car", side_px=9)
    assert tree == (None, "tree .90")


def test_a_class_that_the_classifier_cannot_say_is_left_alone():
    """A dog would be doubted because a classifier of vehicles knows none."""
    words = Vocabulary(COCO_NAMES, AERIAL)
    vote, _ = words.vote(says(AERIAL, other=0.95), called="dog", side_px=30)
    assert vote is not None
    likely = dict(zip(words.names, vote.probabilities.tolist(), strict=True))
    assert likely["dog"] == pytest.approx(0.95, abs=0.01)
    assert likely["car"] < 0.05
    shown = flown(words, vote, base=COCO_NAMES.index("dog"), confidence=0.8)
    assert (shown.classes, shown.doubted.tolist()) == (("dog",), [False])


def flown(words, *posteriors, **how):
    """What is shown of a track after these stills."""
    return told(words, *posteriors, **how)[0]


def told(words, *posteriors, base, confidence, side_px=30.0, calibrated=True, mode="fuse", aslant=False):
    """The same, and the events of the stills."""
    from hvt_ground.perception.history import History

    tracks = tracks_of(0, [(10, 10, 50, 40)], confidences=confidence, classes=base)
    history = History(track_frames=10)
    history.add_tracks(tracks)
    refiner = Refiner(mode, fps=15, vocabulary=words, calibrated=calibrated, tilt=tilt_of(aslant))
    events = []
    for sequence, posterior in enumerate(posteriors):
        still = seen(sequence, 0, posterior, (10, 10, 50, 40), edge=1, side_px=side_px)
        refiner.offer(still, now_frame=0)
        events += [done.event for done in refiner.settle(history, now_frame=0)]
    return refiner.shown(tracks), events


def tilt_of(aslant):
    """That of a view where no kind of vehicle but a car is known."""
    tilt = ViewTilt(vague_kinds=True)
    tilt.aslant = aslant
    return tilt


def votes(words, *answers):
    """The votes of these answers over `AERIAL`."""
    found = [words.vote(says(AERIAL, **answer), called="car", side_px=30)[0] for answer in answers]
    assert all(found)
    return found


@pytest.mark.parametrize("mode", ["fuse", "replace"])
def test_nothing_of_mine_takes_confidence_until_the_track_is_doubted(mode):
    """A shrub would be a pedestrian with a check mark."""
    words = Vocabulary(AERIAL, AERIAL)
    shrub = AERIAL.index("pedestrian")
    before = flown(words, *votes(words, {"pedestrian": 0.6}), base=shrub, confidence=0.5, mode=mode)
    assert (before.classes, before.doubted.tolist()) == (("pedestrian",), [False])
    if mode == "fuse":
        weak = votes(words, {"pedestrian": 0.6}, {"pedestrian": 0.3, "other": 0.65})
        shown = flown(words, *weak, base=shrub, confidence=0.5)
        assert shown.classes == ("pedestrian",)
        assert shown.confidences[0] < before.confidences[0]
    strong = votes(words, {"pedestrian": 0.6}, {"other": 0.97})
    shown = flown(words, *strong, base=shrub, confidence=0.5, mode=mode)
    assert (shown.classes, shown.doubted.tolist(), shown.sure.tolist()) == (("other",), [True], [False])


def test_a_check_mark_needs_a_calibrated_probability_on_enough_pixels():
    """A network that was never calibrated, or saw nine pixels, would be taken at its word."""
    words = Vocabulary(AERIAL, AERIAL)
    (car,) = votes(words, {"car": 0.97})
    assert flown(words, car, base=0, confidence=0.8).sure.tolist() == [True]
    assert flown(words, car, base=0, confidence=0.8, calibrated=False).sure.tolist() == [False]
    assert flown(words, car, base=0, confidence=0.8, side_px=9).sure.tolist() == [False]
    unsure = votes(words, *({"car": 0.8},) * 5)
    shown = flown(words, *unsure, base=0, confidence=0.8)
    assert shown.confidences[0] > 0.99
    assert shown.sure.tolist() == [False], "five answers of .8 on one object are not one of .99"


@pytest.mark.parametrize("aslant", [True, None])
def test_unless_seen_from_above_no_kind_of_vehicle_has_a_check_mark(aslant):
    """Of kinds aslant every second one is wrong; beside a road with few cars a hydrant was a truck, with a mark."""
    words = Vocabulary(AERIAL, AERIAL)
    (car,), (walker,) = votes(words, {"car": 0.97}), votes(words, {"pedestrian": 0.97})
    assert flown(words, car, base=0, confidence=0.8, aslant=aslant).sure.tolist() == [False]
    person = AERIAL.index("pedestrian")
    assert flown(words, walker, base=person, confidence=0.8, aslant=aslant).sure.tolist() == [True]
    shown, (event,) = told(words, car, base=person, confidence=0.3, aslant=aslant)
    assert (shown.words, event.doubted) == (("something",), True)
    refiner = Refiner("fuse", fps=15, vocabulary=words, calibrated=True, tilt=tilt_of(aslant))
    alone = seen(0, 0, car, (10, 10, 50, 40), edge=1, side_px=30.0)
    alone = replace(alone, event=replace(alone.event, class_before="pedestrian", class_after="car"))
    refiner.offer(alone, now_frame=0)
    assert [done.event.doubted for done in refiner.end()] == [True], "nor in a still of no track"


@pytest.mark.parametrize(
    ("name", "said", "vague"),
    [
        ("bus", {}, True),
        ("bus", {"bus": 0.7}, True),
        ("bus", {"bus": 0.97}, False),
        ("car", {"car": 0.97}, False),
        ("pedestrian", {}, False),
    ],
)
def test_a_kind_of_vehicle_that_stills_are_unsure_of_is_left_to_the_detections(name, said, vague):
    """A still of an SUV that was a truck by .6 made it one for the whole flight."""
    words = Vocabulary(AERIAL, AERIAL)
    stills = votes(words, said) if said else []
    shown, events = told(words, *stills, base=AERIAL.index(name), confidence=0.8)
    assert (shown.classes, shown.vague.tolist()) == ((name,), [vague])
    assert [one.words[1] for one in events] == ["vehicle" if vague else name] * len(stills)


@pytest.mark.parametrize(("share", "doubted"), [(0.8, True), (0.99, False)])
def test_stills_that_are_unsure_make_no_vehicle_of_a_person(share, doubted):
    """Who crossed the road was a truck by .41."""
    words = Vocabulary(AERIAL, AERIAL)
    stills = votes(words, {"truck": share})
    shown = flown(words, *stills, base=AERIAL.index("pedestrian"), confidence=0.3)
    assert (shown.classes, shown.doubted.tolist()) == (("truck",), [doubted])
    assert flown(words, *stills, base=AERIAL.index("car"), confidence=0.3).doubted.tolist() == [False]


def test_what_the_detector_calls_other_has_no_name():
    """A roof was "other 67", as firm as the cars beside it."""
    words = Vocabulary(AERIAL, AERIAL)
    other = AERIAL.index("other")
    assert flown(words, base=other, confidence=0.8).words == ("something",)
    assert flown(words, *votes(words, {"car": 0.97}), base=other, confidence=0.3).words == ("car",)


def test_a_toss_up_leaves_the_class_as_it_is():
    """A class would flip with every still."""
    words = Vocabulary(AERIAL, AERIAL)
    even = flown(words, *votes(words, {"truck": 0.55, "car": 0.4}), base=0, confidence=1 / 7)
    assert even.classes == ("car",)
    clear = flown(words, *votes(words, {"truck": 0.75, "car": 0.2}), base=0, confidence=1 / 7)
    assert clear.classes == ("truck",)


def test_a_classifier_with_no_class_in_common_is_refused():
    """It would fly, and never say a word."""
    check_common("d", AERIAL, "c", IMAGENET_NAMES)
    check_common("motion", ("moving",), "c", ("apple", "pear"))
    with pytest.raises(
        UserError, match=r"--classifier c\.onnx has no class in common with --detector d"
    ) as error:
        check_common("d", AERIAL, "c.onnx", ("apple", "pear", "other"))
    assert "apple, pear, other; tracks are car, van" in str(error.value)


def test_what_only_moves_is_named_by_the_classifier():
    """With the motion detector every track would stay "moving"."""
    words = Vocabulary(("moving",), AERIAL)
    assert words.names == ("moving", *AERIAL)
    vote, _ = words.vote(says(AERIAL, van=0.9), called="moving", side_px=30)
    assert vote is not None
    assert flown(words, vote, base=0, confidence=0.9).classes == ("van",)
    groups = Vocabulary(("moving",), IMAGENET_NAMES)
    assert set(groups.names) == {"moving", "vehicle", "person", "boat", "animal"}
    vote, _ = groups.vote(says(IMAGENET_NAMES, minivan=0.9), called="moving", side_px=30)
    assert vote is not None
    assert flown(groups, vote, base=0, confidence=0.9).classes == ("vehicle",)


@pytest.mark.realdata
def test_a_network_of_photographs_renames_no_car_of_a_car_park(data):
    """Half the car park would be revolvers and waffle irons, as the first user saw it."""
    detector = open_detector("aerial-nano", threads=1)
    classifier = open_classifier(
        str(data / "models/mobilenet_v2_imagenet.onnx"), labels=data / "models/imagenet_labels_1001.txt"
    )
    words = Vocabulary(detector.class_names, classifier.class_names)
    clip = cv2.VideoCapture(str(data / "clips/drone_carpark.mp4"))
    shown: Counter[tuple[str, str]] = Counter()
    noted = 0
    for _ in range(5):
        for _ in range(40):
            clip.grab()
        picture = clip.retrieve()[1]
        found = detector.detect(picture)
        for row, box in enumerate(found.boxes_xyxy_px.astype(int).tolist()):
            x1, y1, x2, y2 = box
            name = detector.class_names[found.class_ids[row]]
            if name not in VEHICLES:
                continue
            aside, above = int(PADDING * (x2 - x1)), int(PADDING * (y2 - y1))
            cut = picture[max(y1 - above, 0) : y2 + above, max(x1 - aside, 0) : x2 + aside]
            (answer,) = classifier.classify([cut])
            vote, note = words.vote(answer, called=name, side_px=min(x2 - x1, y2 - y1))
            noted += bool(note)
            if vote is None:
                continue
            after = flown(
                words,
                *[vote] * 4,  # again and again the same
                base=int(found.class_ids[row]),
                confidence=float(found.confidences[row]),
            )
            shown[name, after.classes[0]] += 1
    clip.release()
    assert noted > 50, "most of what it says is no class of a track"
    assert shown
    assert {after for _, after in shown} <= VEHICLES
    assert all(before == after for before, after in shown)


def test_every_synset_of_the_table_is_a_class_of_imagenet():
    """A slip in the table would be a class that never speaks."""
    groups = Counter(group_of(name) for name in IMAGENET_NAMES)
    assert groups == {"animal": 397, "vehicle": 46, "boat": 14, "person": 3, None: 540}
    assert group_of("crane") is None, "a bird and a machine"
    assert group_of("Cardigan") is None, "a dog and a garment"
