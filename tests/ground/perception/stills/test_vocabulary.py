"""A classifier of other words says what its words mean for a track, or nothing."""

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
from hvt_ground.perception.history import History
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


PLAIN = ("automobile", "lorry", "person", "tree")
TWICE = ("car", "car", "truck")


@pytest.mark.parametrize(
    ("detectors", "reader", "answer", "called", "side_px", "said"),
    [
        # The embedded pair would lose what it was trained to say, on small objects too.
        (AERIAL, AERIAL, {"van": 0.7, "other": 0.2}, "car", 30, "van"),
        (AERIAL, AERIAL, {"car": 0.9}, "car", 10, "car"),
        # A network of photographs would rename a car seen from above a moving van; the paper's rule takes its kinds.
        (AERIAL, IMAGENET_NAMES, {"moving_van": 0.5, "minivan": 0.4}, "bus", 40, "bus"),
        (None, IMAGENET_NAMES, {"moving_van": 0.9}, "bus", 40, "truck"),
        # A car would become a waffle iron; a detector that knows animals may hear of one.
        (AERIAL, IMAGENET_NAMES, {"waffle_iron": 0.31}, "car", 40, "note: waffle iron .31"),
        (AERIAL, IMAGENET_NAMES, {"Japanese_spaniel": 0.31}, "car", 40, "note: Japanese spaniel .31"),
        (COCO_NAMES, IMAGENET_NAMES, {"Japanese_spaniel": 0.8}, "cat", 40, "cat"),
        # Ten pixels blown up to 224 look like anything.
        (AERIAL, IMAGENET_NAMES, {"minivan": 0.9}, "car", LEAST_SIDE_PX - 0.1, "note: minivan .90"),
        (AERIAL, IMAGENET_NAMES, {"minivan": 0.9}, "car", LEAST_SIDE_PX, "car"),
        # A user's classifier would have to be trained on our words.
        (AERIAL, PLAIN, {"automobile": 0.9}, "x", 9, "car"),
        (AERIAL, PLAIN, {"lorry": 0.9}, "x", 9, "truck"),
        (AERIAL, PLAIN, {"person": 0.9}, "x", 9, "pedestrian"),
        (AERIAL, PLAIN, {"tree": 0.9}, "car", 9, "note: tree .90"),
        # Every truck would be called a bus, where a model has two classes called car.
        ((*TWICE, "bus"), TWICE, {"truck": 0.9}, "truck", 30, "truck"),
        # With the motion detector every track would stay "moving".
        (("moving",), AERIAL, {"van": 0.9}, "moving", 30, "van"),
        (("moving",), IMAGENET_NAMES, {"minivan": 0.9}, "moving", 30, "vehicle"),
    ],
)
def test_what_a_classifier_says_means_a_class_of_a_track_or_is_a_note(
    detectors, reader, answer, called, side_px, said
):
    """See each case."""
    words = Vocabulary(detectors or AERIAL, reader, kinds=detectors is None)
    vote, note = words.vote(says(reader, **answer), called=called, side_px=side_px)
    assert said == (f"note: {note}" if vote is None else vote.class_name)
    if vote is not None and detectors == ("moving",):
        assert flown(words, vote, base=0, confidence=0.9).classes == (said,)


def test_the_probabilities_of_a_vote():
    """A class would be as likely as its neighbour; an answer over other classes rename everything, plausibly."""
    words, answer = Vocabulary(AERIAL, AERIAL), says(AERIAL, van=0.7, other=0.2)
    vote, _ = words.vote(answer, called="car", side_px=30)
    assert (words.names, vote.confidence) == (AERIAL, pytest.approx(0.7))
    np.testing.assert_allclose(vote.probabilities, answer.probabilities, rtol=1e-5)
    entropy = -sum(p * math.log(p) for p in answer.probabilities.tolist())
    assert vote.entropy_nats == pytest.approx(entropy, rel=1e-4)
    with pytest.raises(ValueError, match="7 classes"):
        words.vote(says(PLAIN, tree=0.9), called="car", side_px=30)
    photos = Vocabulary(AERIAL, IMAGENET_NAMES)
    vote, _ = photos.vote(says(IMAGENET_NAMES, moving_van=0.5, minivan=0.4), called="bus", side_px=40)
    likely = dict(zip(photos.names, vote.probabilities.tolist(), strict=True))
    assert vote.confidence == pytest.approx(0.905, abs=0.01)
    assert {likely[name] for name in VEHICLES} == {likely["car"]}
    assert likely["pedestrian"] < 0.01


@pytest.mark.parametrize(
    ("own", "edge", "names", "places"),
    [
        (TWICE, ("Truck", "bus"), (*TWICE, "bus"), [2, 3]),
        # A class of the edge's detector would be shown under the name of another.
        (("car", "bus"), ("Bus ", "truck", "car", "truck"), ("car", "bus", "truck"), [1, 2, 0, 2]),
    ],
)
def test_the_classes_of_both_detectors_are_one_list(own, edge, names, places):
    """A name that a model has twice would move all others, and the last class end the session."""
    unified, found = unified_names(own, edge)
    assert (unified, found.tolist()) == (names, places)
    assert Vocabulary(unified, own).names == names


def test_a_class_that_the_classifier_cannot_say_is_left_alone():
    """A dog would be doubted because a classifier of vehicles knows none."""
    words = Vocabulary(COCO_NAMES, AERIAL)
    vote, _ = words.vote(says(AERIAL, other=0.95), called="dog", side_px=30)
    likely = dict(zip(words.names, vote.probabilities.tolist(), strict=True))
    assert likely["dog"] == pytest.approx(0.95, abs=0.01)
    assert likely["car"] < 0.05
    shown = flown(words, vote, base=COCO_NAMES.index("dog"), confidence=0.8)
    assert (shown.classes, shown.doubted.tolist()) == (("dog",), [False])


def flown(words, *posteriors, **how):
    """What is shown of a track after these stills."""
    return told(words, *posteriors, **how)[0]


def told(words, *posteriors, base, confidence, side_px=30.0, calibrated=True, mode="fuse", aslant=False):
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


WORDS = Vocabulary(AERIAL, AERIAL)


def votes(*answers):
    """The votes of these answers over `AERIAL`."""
    found = [WORDS.vote(says(AERIAL, **answer), called="car", side_px=30)[0] for answer in answers]
    assert all(found)
    return found


@pytest.mark.parametrize(
    ("answers", "base", "confidence", "how", "shown"),
    [
        # A shrub would be a pedestrian with a check mark.
        ([{"pedestrian": 0.6}], "pedestrian", 0.5, {"mode": "replace"}, "pedestrian"),
        ([{"pedestrian": 0.6}], "pedestrian", 0.5, {}, "pedestrian"),
        ([{"pedestrian": 0.6}, {"pedestrian": 0.3, "other": 0.65}], "pedestrian", 0.5, {}, "pedestrian"),
        ([{"pedestrian": 0.6}, {"other": 0.97}], "pedestrian", 0.5, {"mode": "replace"}, "other doubted"),
        ([{"pedestrian": 0.6}, {"other": 0.97}], "pedestrian", 0.5, {}, "other doubted"),
        # A network that was never calibrated, or saw nine pixels, would be taken at its word.
        ([{"car": 0.97}], "car", 0.8, {}, "car sure"),
        ([{"car": 0.97}], "car", 0.8, {"calibrated": False}, "car"),
        ([{"car": 0.97}], "car", 0.8, {"side_px": 9}, "car vague"),
        # Five answers of .8 on one object are not one of .99.
        ([{"car": 0.8}] * 5, "car", 0.8, {}, "car vague"),
        # Of kinds aslant every second one is wrong; beside a road with few cars a hydrant was a truck, with a mark.
        *(([{"car": 0.97}], "car", 0.8, {"aslant": one}, "car") for one in (True, None)),
        *(
            ([{"pedestrian": 0.97}], "pedestrian", 0.8, {"aslant": one}, "pedestrian sure")
            for one in (True, None)
        ),
        *(([{"car": 0.97}], "pedestrian", 0.3, {"aslant": one}, "car doubted") for one in (True, None)),
        # A still of an SUV that was a truck by .6 made it one for the whole flight.
        ([], "bus", 0.8, {}, "bus vague"),
        ([{"bus": 0.7}], "bus", 0.8, {}, "bus vague"),
        ([{"bus": 0.97}], "bus", 0.8, {}, "bus sure"),
        ([], "pedestrian", 0.8, {}, "pedestrian"),
        # Who crossed the road was a truck by .41.
        ([{"truck": 0.8}], "pedestrian", 0.3, {}, "truck vague doubted"),
        ([{"truck": 0.99}], "pedestrian", 0.3, {}, "truck sure"),
        ([{"truck": 0.8}], "car", 0.3, {}, "truck vague"),
        # A roof was "other 67", as firm as the cars beside it.
        ([], "other", 0.8, {}, "other doubted"),
        ([{"car": 0.97}], "other", 0.3, {}, "car sure"),
        # A class would flip with every still.
        ([{"truck": 0.55, "car": 0.4}], "car", 1 / 7, {}, "car vague"),
        ([{"truck": 0.75, "car": 0.2}], "car", 1 / 7, {}, "truck vague"),
    ],
)
def test_what_is_shown_of_a_track(answers, base, confidence, how, shown):
    """Its class, and whether it is sure, a guess or doubted: what each wrong one would cost is beside it."""
    after, events = told(WORDS, *votes(*answers), base=AERIAL.index(base), confidence=confidence, **how)
    said = {"vague": after.vague, "sure": after.sure, "doubted": after.doubted}
    assert " ".join([after.classes[0], *(word for word, those in said.items() if those[0])]) == shown
    assert [one.doubted for one in events[-1:]] == ["doubted" in shown][: len(events)]


def test_doubt_takes_confidence_before_it_takes_the_name():
    """An operator would see nothing of it until the track is nameless."""
    shrub = {"base": AERIAL.index("pedestrian"), "confidence": 0.5}
    first, second = votes({"pedestrian": 0.6}, {"pedestrian": 0.3, "other": 0.65})
    before, after = flown(WORDS, first, **shrub), flown(WORDS, first, second, **shrub)
    assert after.confidences[0] < before.confidences[0]
    assert flown(WORDS, *votes(*[{"car": 0.8}] * 5), base=0, confidence=0.8).confidences[0] > 0.99


def test_a_still_of_no_track_is_doubted_alike():
    """Aslant it would make a car of a pedestrian where the track's own would not."""
    (car,) = votes({"car": 0.97})
    refiner = Refiner("fuse", fps=15, vocabulary=WORDS, calibrated=True, tilt=tilt_of(True))
    alone = seen(0, 0, car, (10, 10, 50, 40), edge=1, side_px=30.0)
    alone = replace(alone, event=replace(alone.event, class_before="pedestrian", class_after="car"))
    refiner.offer(alone, now_frame=0)
    assert [done.event.doubted for done in refiner.end()] == [True]


def test_a_classifier_with_no_class_in_common_is_refused():
    """It would fly, and never say a word."""
    check_common("d", AERIAL, "c", IMAGENET_NAMES)
    check_common("motion", ("moving",), "c", ("apple", "pear"))
    with pytest.raises(
        UserError, match=r"--classifier c\.onnx has no class in common with --detector d"
    ) as error:
        check_common("d", AERIAL, "c.onnx", ("apple", "pear", "other"))
    assert "apple, pear, other; tracks are car, van" in str(error.value)


def test_what_only_moves_may_be_all_that_the_classifier_says():
    """A network of photographs tells groups alone."""
    assert Vocabulary(("moving",), AERIAL).names == ("moving", *AERIAL)
    groups = Vocabulary(("moving",), IMAGENET_NAMES)
    assert set(groups.names) == {"moving", "vehicle", "person", "boat", "animal"}


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
            base, confidence = int(found.class_ids[row]), float(found.confidences[row])
            shown[name, flown(words, *[vote] * 4, base=base, confidence=confidence).classes[0]] += 1
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
