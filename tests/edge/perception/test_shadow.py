"""How much of what the source shows the ground would miss."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.inference.detect import Detector, open_detector
from hvt_common.inference.store import EMBEDDED_DETECTOR
from hvt_common.tracking.bytetrack import ByteTracker
from hvt_common.tracking.settings import TrackerSettings
from hvt_common.values import Detections, Frame
from hvt_edge.perception.analyzer import AnalyzedFrame, Analyzer
from hvt_edge.perception.shadow import Detected, GroundDifference, Shadow, ShadowGround
from hvt_edge.source.contract import SourceSettings
from hvt_edge.video.encoder import encoder_settings
from hvt_edge.video.x265 import BaseEncoder
from hvt_scene.source import DemoSource
from rigs.examples import detections, tracks_of

FPS = 15
S = 1_000_000_000
PERIOD_NS = S // FPS
CONFIDENCE = 0.4
PICTURE = np.random.default_rng(3).integers(0, 255, (64, 96, 3), np.uint8)


def box(place: int) -> list[float]:
    return [10.0 * place, 0.0, 10.0 * place + 8, 8.0]


def found(*places: int, confidence: float = 0.8, class_id: int = 0) -> Detections:
    return detections([box(place) for place in places], confidence, class_id)


def seen(index: int, confidences: dict[int, float], scene_began: int = -1) -> AnalyzedFrame:
    boxes = {place: box(place) for place in confidences}
    tracks = tracks_of(index, boxes, confidences=[confidences[place] for place in sorted(boxes)])
    frame = Frame(index=index, capture_ns=(index + 1) * PERIOD_NS, source_bgr=PICTURE, base_bgr=PICTURE)
    return AnalyzedFrame(frame, PICTURE, tracks, detected=True, scene_began=scene_began)


def compared(*answers: Detections, confidences: dict[int, float], every: int = 30) -> ShadowGround:
    left = list(answers)
    shadow = ShadowGround(lambda _image: left.pop(0) if left else found(), confidence=CONFIDENCE)
    assert not shadow.compare(seen(0, confidences)), "the first picture is coarser than any other"
    for number in range(len(answers)):
        assert shadow.compare(seen((number + 1) * every, confidences))
    return shadow


def test_the_gain_is_that_of_the_formula():
    """Decisions would be moved by a number that means something else than the docs say."""
    shadow = compared(found(0, 9), confidences={0: 0.9, 1: 0.5, **dict.fromkeys(range(2, 6), 0.7)})
    # Of the two that the base surely shows the source shows one: its silence about the other says nothing yet.
    true = 0.9 + 0.5 + 4 * 0.7 + 0.8
    base = 2 * (0.9 + 0.8) / (1 + 1 + true)
    four, sure = (
        2 * (0.9 + n * 0.7 + 0.8) / (1 + n + 1 + true) for n in (4, 4 - 2)
    )  # at .5 it would not be listed
    assert shadow.now.gain == pytest.approx(four - base, abs=1e-6)
    assert shadow.now.sure_gain == pytest.approx(sure - base, abs=1e-6)
    assert (shadow.now.hidden, shadow.now.false) == (4, 1)


def test_what_the_base_shows_in_error_counts():
    """A ground that is sent tracks lists it no longer, and auto would send none for want of hidden objects."""
    objects = dict.fromkeys(range(18), 0.9)
    boxes = [box(place) for place in (*range(18), *range(30, 34), 40)]
    base = detections(boxes, [0.8] * 18 + [0.5] * 4 + [0.95])
    shadow = compared(base, confidences=objects).now
    recall = min(0.9, (18 + 10 * 18 / (19 + 2)) / (19 + 10))  # see `Recall`
    weak, strong = (c * (1 - recall) / (c * (1 - recall) + 1 - c) for c in (0.5, 0.95))
    assert (shadow.hidden, shadow.false, shadow.suppressed) == (0, 5, 4), "one is surer, the source silent"
    true = 18 * 0.9 + 4 * weak + strong
    for share, gain in ((1, shadow.gain), (1 - 1 / 4**0.5, shadow.sure_gain)):
        base_f1 = 2 * true / (23 + true)
        sent_f1 = 2 * (true - share * 4 * weak) / (23 - share * 4 + true)
        assert gain == pytest.approx(sent_f1 - base_f1, abs=1e-5)
        assert gain > 0.02
    fewer = compared(found(0, 1, *range(30, 34), confidence=0.7), confidences=objects).now
    assert fewer.suppressed == 0, "of an edge that lists other things than the base shows nothing follows"


def test_two_that_are_hidden_tell_less_than_twenty():
    """One object that the detector imagines in a calm scene would bring tracks, and with them more of its kind."""
    few, many = (
        compared(found(*range(shown)), confidences=dict.fromkeys(range(shown + hidden), 0.9)).now.sure_gain
        for shown, hidden in ((4, 1), (40, 10))
    )
    assert few == 0
    assert many > 0.05


def test_what_was_measured_before_the_flight_counts():
    """Else the first comparison in flight alone would move the decisions."""
    before = compared(found(0), found(0), confidences={0: 0.9, 1: 0.9}).now
    assert before.hidden == 1
    shadow = ShadowGround(lambda _image: found(0, 1), confidence=CONFIDENCE, before=before)
    assert not shadow.compare(seen(0, {0: 0.9, 1: 0.9}))
    assert shadow.now == before
    assert shadow.compare(seen(6, {0: 0.9, 1: 0.9}))
    assert shadow.now.comparisons == pytest.approx(before.comparisons + 1, rel=0.05)
    assert shadow.now.hidden == pytest.approx(2 / 3, rel=0.1)


TWENTY = dict.fromkeys(range(20), 0.9)


def reporting(
    shown: int, detected: int, *, objects: dict[int, float] | None = None, seconds: int = 10
) -> ShadowGround:
    objects = TWENTY if objects is None else objects
    shadow = ShadowGround(lambda _image: found(*range(shown)), confidence=CONFIDENCE)
    for index in range(0, 15 * seconds, 5):
        shadow.compare(seen(index, objects))
        shadow.take_detected(Detected(receiver_id=1, frame_index=index, objects=detected))
    return shadow


def test_a_ground_without_a_detector_is_told_what_any_base_would_show():
    """It would show nothing at all on an easy scene: the edge's own detector sees everything on the base."""
    easy = reporting(20, 0)
    assert easy.now.gain == pytest.approx(0)
    assert easy.measured.gain > easy.measured.sure_gain > 0.4
    assert (easy.measured.hidden, easy.measured.reported) == (pytest.approx(20), True)


def test_a_ground_that_sees_more_than_the_edge_needs_no_tracks():
    """They would take bits to tell it what it knows."""
    hidden = reporting(6, 20)
    assert hidden.now.sure_gain > 0.3
    assert hidden.measured.sure_gain < 0.5 * hidden.now.sure_gain
    assert not hidden.measured.reported
    assert reporting(6, 200).measured.hidden == 0


def test_a_count_that_differs_by_chance_changes_nothing():
    """The lists of two detectors never have the same length."""
    for detected in (17, 19, 23):
        shadow = reporting(20, detected)
        assert shadow.measured.sure_gain == shadow.now.sure_gain
        assert shadow.measured.gain < 0.1
    ghosts = reporting(4, 0, objects={})
    assert (ghosts.now.false, ghosts.measured.gain) == (pytest.approx(4), 0), "who shows none shows no error"
    silent = compared(found(0), confidences=TWENTY)
    assert silent.measured == replace(silent.now.measured, moved=silent.measured.moved), "it has not reported"


def test_the_only_object_there_is_counts():
    """Of one object no count is sure; a ground that does not show it shows nothing."""
    shadow = reporting(1, 0, objects={0: 0.9})
    assert shadow.measured.sure_gain == 0
    assert shadow.measured.gain > 0.5
    assert (shadow.measured.hidden, shadow.measured.reported) == (pytest.approx(1), True)


def test_a_crowd_that_leaves_is_hidden_from_nobody():
    """The mean of what was there falls slowly, and the ground's count at once: tracks would be sent of nothing."""
    objects, shown = dict(TWENTY), list(range(20))
    shadow = ShadowGround(lambda _image: found(*shown), confidence=CONFIDENCE)
    gains = []
    for index in range(0, 15 * 40, 5):
        if index == 150:
            objects.clear()
            shown.clear()
        shadow.compare(seen(index, objects))
        shadow.take_detected(
            Detected(1, max(0, index - 10), len(shown) if index < 150 or index >= 160 else 20)
        )
        gains.append(shadow.measured.gain)
    assert max(gains) < 0.02


def test_reports_of_the_scene_before_say_nothing_of_this_one():
    """Two seconds late they would tell of a ground that sees nothing of the new scene."""
    shadow = ShadowGround(lambda _image: found(*range(20)), confidence=CONFIDENCE)
    for index in range(0, 300, 5):
        shadow.compare(seen(index, TWENTY, -1 if index < 150 else 150))
        shadow.take_detected(Detected(1, index - 30, 20 if index - 30 >= 150 else 2))
        if index >= 150:
            assert shadow.measured.gain < 0.02
    assert shadow.scene_began == 150


COUNT, SHARE = st.floats(0, 300), st.floats(0, 1)


@given(COUNT, COUNT, COUNT, st.floats(-70_000, 70_000), st.floats(0.01, 1), SHARE, SHARE, st.booleans())
def test_whatever_a_ground_reports_no_object_is_made_up(
    shown, hidden, false, more, p, misnamed, suppressed, sure
):
    """A ground that lies may have tracks sent or not; it can put nothing into the account that is not there."""
    counts = {
        "shown": shown,
        "hidden": hidden,
        "misnamed": misnamed * shown,
        "false": false,
        "suppressed": suppressed * false,
    }
    sums = {f"{name}_p": p * count for name, count in counts.items()}
    before = Shadow(comparisons=3, source_p=p * (shown + hidden), **counts, **sums)
    after = before.corrected(more, sure=sure)
    assert after.shown + after.hidden == pytest.approx(shown + hidden)
    assert after.shown_p + after.hidden_p == pytest.approx(before.source_p)
    assert min(after.shown, after.hidden, after.shown_p, after.hidden_p, after.misnamed) >= -1e-9
    assert after.misnamed <= after.shown + 1e-9
    assert 0 <= after.suppressed <= after.false + 1e-9
    assert after.gain <= 1 + 1e-9


def test_a_box_that_is_hardly_real_gains_nothing():
    """The ground would be sent of everything that the detector half believes."""
    gains = [
        compared(found(0, 1), confidences={0: 0.95, 1: 0.95, **dict.fromkeys(range(2, 6), doubt)}).now.gain
        for doubt in (0.95, 0.6, 0.2)
    ]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] > 0 == gains[-1]


def test_a_name_that_the_base_gets_wrong_counts():
    """A pickup that the base shows as a car is found and not named."""
    four = dict.fromkeys(range(4), 0.9)
    right = compared(found(0, 1, 2, 3), confidences=four).now
    wrong = compared(found(0, 1, 2, 3, class_id=1), confidences=four).now
    assert right.gain == pytest.approx(0)
    assert (wrong.misnamed_share, wrong.gain) == (1.0, pytest.approx(2 * 3.6 / 3 / (4 + 3.6), abs=1e-6))


def test_a_weak_detection_shows_what_a_strong_one_has_shown():
    """The ground's tracker lists nothing that never was sure, and goes on with what was."""
    weak = found(0, confidence=0.2)
    assert compared(weak, weak, confidences={0: 0.9}).now.hidden == 1
    assert compared(found(0), weak, weak, confidences={0: 0.9}).now.hidden == 0
    assert compared(found(0), found(), weak, confidences={0: 0.9}).now.hidden > 0.5


def test_another_scene_forgets():
    """Decisions would be held for seconds by what a scene before the cut needed."""
    shadow = compared(found(), found(), found(), confidences={0: 0.9})
    assert shadow.now.comparisons > 1
    shadow.stable = True
    shadow.compare(seen(100, {0: 0.9}, scene_began=98))
    assert (shadow.scene_began, shadow.now.comparisons, shadow.stable) == (98, 0, False)


def test_while_nothing_would_follow_it_looks_half_as_often():
    """A core of a small board would go for what is known; a view that changes is not known."""
    shadow = compared(*[found(*range(20))] * 3, confidences=TWENTY)
    assert [shadow.compare(seen(index, TWENTY)) for index in (105, 120)] == [True, True]
    shadow.stable = True
    looks = [index for index in range(121, 200) if shadow.compare(seen(index, TWENTY))]
    assert looks == [151, 182]
    others = {place + 6: p for place, p in TWENTY.items()}
    assert shadow.compare(seen(200, others)) is True
    shadow.stable = False
    assert shadow.compare(seen(216, others)) is True


def test_a_thin_base_hides_what_a_rich_one_shows():
    """On real x265, the real detector and the drawn scene: else the decisions would follow noise."""
    detector = open_detector(EMBEDDED_DETECTOR, threads=2, confidence=0.1)
    with DemoSource("demo", SourceSettings(size=(320, 180), fps=FPS, max_frames=12), seed=0) as source:
        frames = list(source.frames(start_ns=0))
    gains = {kbps: _measured(detector, source, frames, kbps) for kbps in (40, 1_500)}
    assert gains[40] > gains[1_500] + 0.05, gains


def _measured(detector: Detector, source: DemoSource, frames: list[Frame], kbps: int) -> float:
    rates = {"total_bps": 1000 * kbps, "base_bps": 1000 * kbps, "edge_id": "edge-1"}
    settings = encoder_settings(size=source.view.base_size, fps=FPS, preset="veryfast", **rates)
    shadow, encoder = ShadowGround(detector.detect, confidence=CONFIDENCE), BaseEncoder(settings)
    tracker = ByteTracker(TrackerSettings.starting_at(0.4, camera_motion="off"), fps=FPS)
    analyzer = Analyzer(detector, tracker, view=source.view, candidates="source")
    for frame in frames:
        shadow.compare(analyzer.analyze(frame, encoder.encode(frame)))
    assert shadow.now.comparisons > 1
    assert shadow.now.source_p > 5, "there is something to see"
    return shadow.now.gain


def told(one: GroundDifference, *counts: int, at_s: int = 0, receiver_id: int = 1) -> GroundDifference:
    # Ten are found here once a second, a report of each at once.
    for second, count in enumerate(counts, at_s):
        one.expect(second * FPS, 10, capture_ns=second * S)
        one.take(Detected(receiver_id, second * FPS + 2, count))
    return one


@pytest.mark.parametrize(("counts", "mean"), [((2,), None), ((2, 12), 2), ((2, 12, 14), 3.06)])
def test_the_mean_of_what_was_reported_after_the_first_second(counts, mean):
    """The first picture of a stream is coarse: each flight would begin as if the ground saw little."""
    assert told(GroundDifference(), *counts).mean == (mean and pytest.approx(mean, abs=0.01))


def test_a_report_counts_for_the_picture_that_it_covers():
    """A scene that fills or empties would be a difference between two detectors."""
    one = told(GroundDifference(), 10, 10)
    one.expect(40, 30, capture_ns=3 * S)
    for frame, count in (
        (39, 10),
        (41, 30),
        (41, 0),
    ):  # before that picture; of it; again, as of one that hangs
        one.take(Detected(1, frame, count))
        assert one.mean == 0


def test_a_ground_that_says_no_more_or_is_another_is_forgotten():
    """One that has left, or that has no detector, would speak for one that has it."""
    quiet, other = (told(GroundDifference(), *[0] * 20) for _ in range(2))
    assert quiet.mean == pytest.approx(-10)
    for second in range(20, 60):
        quiet.expect(second * FPS, 10, capture_ns=second * S)
    assert quiet.mean is None
    assert told(other, 10, at_s=20, receiver_id=2).mean is None
    assert told(other, 10, at_s=21, receiver_id=2).mean == 0
