"""Mean average precision, against curves drawn by hand and against a second implementation."""

from __future__ import annotations

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


def test_a_curve_drawn_by_hand():
    """Another interpolation than COCO's would give figures that no published one can be compared with."""
    truth = labels((square(0), "car"), (square(100), "car"))
    shown = view((square(0), "car", 0, 0.9), (square(500), "car", 1, 0.8), (square(100), "car", 2, 0.7))
    score = detection_score(judged([(truth, shown)]))
    # Precision 1 up to recall 0.5 (51 of 101 points), 2/3 from there on.
    assert score.mean.at_50 == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert score.mean.at_50_95 == pytest.approx(score.mean.at_50)


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


def test_words_are_brought_into_one_vocabulary():
    """A COCO detector on VisDrone labels calls a van a car."""
    frame_index = (labels((square(0), "van")), view((square(0), "car")))
    assert detection_score(judged([frame_index])).mean.at_50 == 0.0
    assert detection_score(judged([frame_index], word=kind_of)).mean.at_50 == 1.0


def test_classes_that_labels_do_not_know_are_left_out():
    """UAVDT labels no people: whoever finds them must not pay for it, nor who is not asked for them."""
    shown = view((square(300), "person", 0, 0.9), (square(0), "car", 1, 0.5))
    assert detection_score(judged([(labels((square(0), "car")), shown)])).mean.at_50 == 1.0
    both = labels((square(0), "car"), (square(100), "person"))
    assert detection_score(judged([(both, shown)])).mean.at_50 == pytest.approx(0.5)
    score = detection_score(judged([(both, shown)], classes={"car"}))
    assert (score.mean.at_50, set(score.by_class)) == (1.0, {"car"})


@pytest.mark.parametrize(("left", "counts"), [(45.0, False), (44.0, True)])
def test_ignored_regions_go_by_half_the_box(left, counts):
    """VisDrone leaves crowds unlabelled; a box with half of its area there is neither right nor wrong."""
    truth = labels((square(0), "car"), ignored=[(50, 0, 60, 10), (50, 5, 90, 90)])
    shown = view((square(left), "car", 0, 0.9), (square(0), "car", 1, 0.5))
    score = detection_score(judged([(truth, shown)]))
    assert score.mean.at_50 == (pytest.approx(0.5) if counts else 1.0)


def test_labels_in_ignored_regions_do_not_count_either():
    """Whoever rightly shows nothing there would be charged with a miss."""
    truth = labels((square(0), "car"), (square(52), "car"), ignored=[(50, 0, 90, 90)])
    score = detection_score(judged([(truth, view((square(0), "car")))]))
    assert score.mean.at_50 == 1.0


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


def test_crowded_frames_count_whole():
    """COCO's limit of 100 boxes a frame would cap the recall on VisDrone, which has several hundred."""
    boxes = [square(20 * column, 20 * row) for row in range(10) for column in range(15)]
    frame_index = labels(*((box, "car") for box in boxes)), view(*((box, "car") for box in boxes))
    assert detection_score(judged([frame_index])).mean.at_50 == pytest.approx(1.0)


def test_a_share_is_rounded_once():
    """177 right of 220 are .80454: a table had .804."""
    boxes = [(square(20 * number), "car") for number in range(220)]
    frames = judged([(labels(*boxes[:177]), view(*boxes))])
    assert decimals(picture_score(frames, detection_score(frames))["precision"]) == "0.805"


def test_nothing():
    """An empty road, a blind ground and a sequence that is ignored altogether are answers, not crashes."""
    assert math.isnan(detection_score(judged([])).mean.at_50)
    assert math.isnan(detection_score(judged([(labels(), view((square(0), "car")))])).mean.at_50_95)
    blind = detection_score(judged([(labels((square(0), "car")), FrameView())]))
    assert blind.mean.at_50 == 0.0
    everything = labels((square(0), "car"), ignored=[(0, 0, 999, 999)])
    score = detection_score(judged([(everything, view((square(0), "car")))]))
    assert math.isnan(score.mean.at_50)


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
