"""What a whole flight records for the metrics, on small drawn pictures with a detector of red things."""

import pickle

import numpy as np
import pytest

from hvt_common.values import Posterior
from hvt_study.datasets.labels import NO_ID
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.flights.flight import fly
from hvt_study.flights.flight_ground import SharedModels
from hvt_study.metrics import observed
from hvt_study.metrics.bits import line_rates, still_counts
from hvt_study.metrics.classes import class_score, first_correct
from hvt_study.metrics.detection import detection_score
from hvt_study.metrics.judged import judged
from hvt_study.metrics.tracking import tracking_score
from media.clips import smooth_pictures
from rigs.flight import SIZE, RedSquares, square_box
from studies.metric_frames import clip_of, flight_plan, labels

FRAMES = 40
TRUTH = [labels((square_box(frame_index), "bus", 1)) for frame_index in range(FRAMES)]


class Buses:
    """Reads every crop as a bus, the surer the more red there is in it."""

    class_names = ("car", "bus")

    def classify(self, crops_bgr):
        sure = [0.5 + float(crop[..., 2].mean()) / 512 for crop in crops_bgr]
        likely = [np.array([1 - one, one], np.float32) for one in sure]
        return [
            Posterior("bus", one, -one * np.log(one), both) for one, both in zip(sure, likely, strict=True)
        ]


def pictures():
    """A red square over a smooth ground, with detail of its own in every picture: a thin base cannot follow."""
    rng = np.random.default_rng(2)
    drawn = np.stack(smooth_pictures(FRAMES, size=SIZE))
    for frame_index, picture in enumerate(drawn):
        grain = rng.integers(0, 90, (32, 32, 2), dtype=np.uint8)
        left, top = (round(edge) for edge in square_box(frame_index)[:2])
        picture[top : top + 32, left : left + 32, :2] = grain
        picture[top : top + 32, left : left + 32, 2] = 255 - grain[..., 0] // 2
    return drawn


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return clip_of(pictures(), tmp_path_factory.mktemp("clip"))


def flown(clip, *flags, classifier=None):
    usual = ("--budget", "400kbps", "--video-share", "0.15", "--still-codec", "residual")
    plan = flight_plan(clip, "--detector", "motion", *usual, *flags, link_bps=400_000)
    return fly(plan, detector=RedSquares(), models=SharedModels(RedSquares(), classifier))


@pytest.fixture(scope="module")
def flight(clip):
    """Stills of the square, which the base calls a car and the classifier a bus."""
    return flown(clip, "--method", "M1", "--tune", "every_frames=5", "--cooldown", "0s", classifier=Buses())


def test_classes_before_and_after_refinement(flight):
    """The study's main figure: the same tracks, with and without what the stills say."""
    frames = observed.refined_frames(flight.lists, TRUTH)
    after, before = class_score(judged(frames)), class_score(judged(frames), refined=False)
    assert before.counts.found == after.counts.found > 30
    assert before.counts.right == 0
    assert after.counts.right > 20
    shown_s = [one.shown_s for one in flight.lists]
    assert all(
        frame_index / NOMINAL_FPS < at_s < frame_index / NOMINAL_FPS + 1
        for frame_index, at_s in enumerate(shown_s)
    )
    waits = first_correct(judged(frames), fps=NOMINAL_FPS, shown_s=shown_s)
    assert 0 < waits.median_s < 1.2
    first = observed.refined_objects(flight.lists)[0]
    # It is shown from the next list on.
    assert first.at_s <= waits.median_s + 1 / NOMINAL_FPS


def test_the_base_alone(flight):
    """Confidences and names as the base stream gives them, for the very same tracks."""
    base = [(truth, one.base_view()) for truth, one in zip(TRUTH, flight.lists, strict=True)]
    shown = observed.refined_frames(flight.lists, TRUTH)
    for (_, alone), (_, both) in zip(base, shown, strict=True):
        assert np.array_equal(alone.ids, both.ids)
        assert set(alone.class_names) <= {"car"}
        np.testing.assert_allclose(alone.confidences, 0.9)
        assert set(both.confidences[np.array(both.class_names) == "bus"].tolist()) != {0.9}
    assert tracking_score(judged(base)).mota > 0.9
    assert tracking_score(judged(base)).switches == 0


def test_detections_on_base_frames(clip, flight):
    """The mAP is of what the detector says of decoded frames, not of the tracks at every frame."""
    frames = observed.detected_frames(flight.lists, TRUTH)
    assert len(frames) == FRAMES
    assert all((found.ids == NO_ID).all() for _, found in frames)
    assert detection_score(judged(frames)).mean.at_50 == 0.0  # it says car
    assert detection_score(judged(frames, word=lambda _: "vehicle")).mean.at_50 > 0.9
    slow = flown(clip, "--method", "M0", "--fps", "5")
    assert len(observed.detected_frames(slow.lists, TRUTH)) == slow.messages["base"] < FRAMES / 2


def test_stills_bits_and_delay(flight):
    """Counted at the ground, they must be what the edge's own ledger says."""
    stills = observed.arrivals(flight.lists)
    assert len(stills) == flight.messages["roi"] > 3
    assert sum(one.line_bytes for one in stills) == flight.line_bytes["roi"]
    assert all(0 <= one.capture_s <= one.sent_s < one.arrived_s for one in stills)
    assert [one.arrived_s for one in stills] == sorted(one.arrived_s for one in stills)
    split = line_rates(flight.line_bytes, seconds=flight.duration_s)
    assert round(split["total_bps"]) == flight.account.total_bps
    assert round(split["roi_bps"]) == flight.account.roi_bps
    counts = still_counts(stills, observed.refined_objects(flight.lists), seconds=flight.duration_s)
    assert counts["tracks_refined"] == 1
    assert counts["mean_still_bytes"] == pytest.approx(flight.account.roi_bytes / len(stills))
    assert observed.still_delays_ms(stills)[0] > 0


def test_what_stills_did_to_a_track(flight):
    """Which still made it a bus, and when."""
    objects = [one for one in observed.refined_objects(flight.lists) if one.track_id == 1]
    assert len(objects) > 3
    names = [(one.name_before, one.name_after) for one in objects]
    turned = names.index(("car", "bus"))
    assert set(names[:turned]) <= {("car", "car")}, "until then it is weighed"
    assert {before for before, _ in names[turned + 1 :]} == {"bus"}
    assert {one.still_sequence for one in objects} <= {
        one.sequence for one in observed.arrivals(flight.lists)
    }
    assert all(one.area_share == pytest.approx(32 * 32 / (SIZE[0] * SIZE[1]), rel=0.2) for one in objects)


def test_proxies(clip, flight):
    """A classifier is asked of the base crop as well as of the still; a detector has said something of both."""
    score = observed.proxies(observed.refined_objects(flight.lists))
    assert score["proxy_pairs"] == len(observed.refined_objects(flight.lists)) > 3
    assert 0.5 < score["confidence_base"] < 1
    assert abs(score["confidence_gain"]) < 0.1  # the same crop, once over the base
    assert score["change_rate"] == 0.0
    report = flown(clip, "--method", "M1", "--tune", "every_frames=5", "--cooldown", "0s")
    score = observed.proxies(observed.refined_objects(report.lists))
    assert score["proxy_pairs"] > 3
    assert (score["confidence_base"], score["confidence_refined"]) == pytest.approx((0.9, 0.9))
    assert score["entropy_gain_nats"] == pytest.approx(0.0, abs=1e-3)


def test_recording_changes_nothing_and_goes_to_another_process(flight):
    """Runs are flown in processes of their own; what they record has to come back whole."""
    again = pickle.loads(pickle.dumps(flight))
    for one, other in zip(again.lists, flight.lists, strict=True):
        assert np.array_equal(one.boxes_xyxy_px, other.boxes_xyxy_px)
        assert (one.class_names, one.stills, one.refined) == (other.class_names, other.stills, other.refined)
