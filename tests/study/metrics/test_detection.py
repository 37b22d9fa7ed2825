"""Mean average precision, against curves drawn by hand and against a second implementation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hvt_common.inference.class_names import kind_of
from hvt_common.values import iou
from hvt_study.commands.output import decimals
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.judged import FrameView, judged
from hvt_study.metrics.picture_score import picture_score
from studies.metric_frames import labels, square, view

CAR = (square(0), "car")
CURVE = view((square(0), "car", 0, 0.9), (square(500), "car", 1, 0.8), (square(100), "car", 2, 0.7))
PEOPLE = view((square(300), "person", 0, 0.9), (square(0), "car", 1, 0.5))
CROWD = [(50, 0, 60, 10), (50, 5, 90, 90)]
MANY = [(square(20 * column, 20 * row), "car") for row in range(10) for column in range(15)]


@pytest.mark.parametrize(
    ("truth", "shown", "words", "at_50"),
    [
        # COCO's interpolation: precision 1 up to recall 0.5 (51 of 101 points), 2/3 from there on.
        (labels(CAR, (square(100), "car")), CURVE, {}, (51 + 50 * 2 / 3) / 101),
        # A COCO detector on VisDrone labels calls a van a car.
        (labels((square(0), "van")), view(CAR), {}, 0.0),
        (labels((square(0), "van")), view(CAR), {"word": kind_of}, 1.0),
        # UAVDT labels no people: whoever finds them must not pay for it, nor who is not asked for them.
        (labels(CAR), PEOPLE, {}, 1.0),
        (labels(CAR, (square(100), "person")), PEOPLE, {}, 0.5),
        (labels(CAR, (square(100), "person")), PEOPLE, {"classes": {"car"}}, 1.0),
        # VisDrone leaves crowds unlabelled; a box with half of its area there is neither right nor wrong.
        (labels(CAR, ignored=CROWD), view((square(45.0), "car", 0, 0.9), (*CAR, 1, 0.5)), {}, 1.0),
        (labels(CAR, ignored=CROWD), view((square(44.0), "car", 0, 0.9), (*CAR, 1, 0.5)), {}, 0.5),
        # Whoever rightly shows nothing there would be charged with a miss.
        (labels(CAR, (square(52), "car"), ignored=[(50, 0, 90, 90)]), view(CAR), {}, 1.0),
        # COCO's limit of 100 boxes a frame would cap the recall on VisDrone, which has several hundred.
        (labels(*MANY), view(*MANY), {}, 1.0),
        # An empty road, a blind ground and a sequence that is ignored altogether are answers, not crashes.
        (labels(), view(CAR), {}, math.nan),
        (labels(CAR), FrameView(), {}, 0.0),
        (labels(CAR, ignored=[(0, 0, 999, 999)]), view(CAR), {}, math.nan),
    ],
)
def test_the_mean_average_precision_of_a_frame(truth, shown, words, at_50):
    """It would be no figure that a published one can be compared with."""
    score = detection_score(judged([(truth, shown)], **words))
    assert score.mean.at_50 == pytest.approx(at_50, nan_ok=True)
    assert set(score.by_class) <= words.get("classes", {"car", "person", "van"})
    if shown is CURVE:
        assert score.mean.at_50_95 == pytest.approx(at_50)
    if not len(truth):
        assert math.isnan(score.mean.at_50_95)


def test_loose_boxes_count_at_loose_thresholds_only():
    """A method whose boxes drift must lose at the strict thresholds."""
    truth, shown = labels(((0, 0, 100, 10), "car")), view(((0, 0, 62, 10), "car"))  # IoU 0.62
    score = detection_score(judged([(truth, shown)]))
    assert score.mean.at_50 == 1.0
    assert score.mean.at_50_95 == pytest.approx(3 / 10)  # at 0.50, 0.55 and 0.60


def test_classes_are_averaged():
    """One class that is always missed would vanish among many cars."""
    truth = labels((square(0), "car"), (square(100), "car"), (square(200), "bus"))
    shown = view((square(0), "car"), (square(100), "car"), (square(200), "car", 2, 0.3))
    score = detection_score(judged([(truth, shown)]))
    assert score.by_class["car"].at_50 == pytest.approx(1.0)
    assert score.by_class["bus"].at_50 == 0.0
    assert score.mean.at_50 == pytest.approx(0.5)


def test_what_is_in_front_of_an_object_that_is_not_asked_for_counts():
    """A pedestrian before a parked car that nobody asks for would vanish, and every box on him with him."""
    car, other = (0, 0, 300, 200), (400, 0, 440, 40)
    truth = replace(
        labels(((20, 20, 60, 100), "person"), (square(600), "person")),
        beside_xyxy_px=np.array([car, other], np.float32),
    )
    on_him = ((22, 20, 62, 100), "person", 0, 0.5)
    nobody = [((200, 20, 240, 100), "person", 1, 0.8), (car, "person", 2, 0.7), (other, "person", 3, 0.6)]
    score = detection_score(judged([(truth, view(on_him, *nobody))]))
    assert score.mean.at_50 == pytest.approx(51 / 101)  # he is found, and nothing is wrong
    beyond = ((290, 20, 330, 100), "person", 4, 0.95)  # a quarter of it on the car
    score = detection_score(judged([(truth, view(on_him, beyond))]))
    assert score.mean.at_50 == pytest.approx(51 / 101 / 2)


def test_a_distractor_of_motchallenge_takes_its_match_alone():
    """Whatever lay on a crowd's or a poster's half was forgiven: 208 of 215 boxes that TrackEval calls false."""
    truth = replace(
        labels((square(0), "person")), beside_xyxy_px=np.array([(100, 0, 200, 100)], np.float32), paired=True
    )
    shown = view(
        *((box, "person") for box in [square(0), (102, 0, 202, 100), (110, 0, 200, 100), square(120)])
    )
    (frame,) = judged([(truth, shown)])
    assert frame.view.boxes_xyxy_px[:, 0].tolist() == [0, 110, 120]


def test_sizes():
    """The issue's question is about small objects; large ones must not hide them."""
    boxes = [square(0, side=20), square(200, side=50), square(400, side=100)]
    truth = labels(*((box, "car") for box in boxes))
    score = detection_score(judged([(truth, view((boxes[1], "car"), (boxes[2], "car")))]))
    assert score.by_size["small"].at_50 == 0.0
    assert score.by_size["medium"].at_50 == score.by_size["large"].at_50 == 1.0


def test_a_share_is_rounded_once():
    """177 right of 220 are .80454: a table had .804."""
    boxes = [(square(20 * number), "car") for number in range(220)]
    frames = judged([(labels(*boxes[:177]), view(*boxes))])
    assert decimals(picture_score(frames, detection_score(frames))["precision"]) == "0.805"


def average_precision(frames, threshold):
    """Of one class: greedy matching by confidence within each frame, precision at 101 recalls."""
    hits, total = [], 0
    for truth, shown in frames:
        free = set(range(len(truth.class_names)))
        total += len(free)
        overlap = iou(shown.boxes_xyxy_px, truth.boxes_xyxy_px)
        for row in np.argsort(-shown.confidences, kind="stable"):
            best = max(free, key=lambda column: overlap[row, column], default=None)
            hit = best is not None and overlap[row, best] >= threshold
            if hit:
                free.remove(best)
            hits.append((shown.confidences[row], hit))
    hits.sort(key=lambda one: -one[0])
    right = np.cumsum([hit for _, hit in hits])
    precision = np.maximum.accumulate((right / np.arange(1, len(hits) + 1))[::-1])[::-1]
    places = np.searchsorted(right / total, np.linspace(0, 1, 101))
    return float(np.mean([precision[place] if place < len(hits) else 0.0 for place in places]))


def test_a_second_implementation_agrees():
    """The library, or what we hand it, would be wrong on real crowds of overlapping boxes."""
    rng = np.random.default_rng(6)
    frames = []
    for _ in range(20):
        corners = rng.uniform(0, 120, (8, 2))
        boxes = np.hstack((corners, corners + rng.uniform(10, 40, (8, 2))))
        moved = (boxes + rng.normal(0, 2.5, boxes.shape))[: rng.integers(0, 9)]
        stray = square(300)
        shown = [(box, "car", 0, float(rng.uniform())) for box in [*moved.tolist(), stray]]
        frames.append((labels(*((box, "car") for box in boxes.tolist())), view(*shown)))
    score = detection_score(judged(frames))
    expected = [average_precision(frames, threshold) for threshold in np.linspace(0.5, 0.95, 10)]
    assert 0.2 < score.mean.at_50 < 0.9
    assert score.mean.at_50 == pytest.approx(expected[0], abs=1e-9)
    assert score.mean.at_50_95 == pytest.approx(np.mean(expected), abs=1e-9)
