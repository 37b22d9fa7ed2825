"""The tracks channel's coding: small, exact enough, whole after a loss, and safe from any bytes."""

import contextlib
import pickle
import random
from dataclasses import replace

import numpy as np
import pytest

from hvt_common.protocol.messages import TrackStep, TrackStepDecoder, TrackStepEncoder, WireError
from hvt_common.protocol.messages.track_boxes import MOST_BOXES
from hvt_common.values import iou
from rigs.examples import tracks_of

SECOND_NS = 1_000_000_000
START_NS = 1_790_000_000 * SECOND_NS


def car_tracks(frame, boxes, *, classes=3, confidences=0.7, **more):
    return tracks_of(frame, boxes, classes=classes, confidences=confidences, **more)


def flight(steps, *, count=50, side_px=40, seed=0):
    """Cars that drive and a camera that pans, seen with a detector's noise, three times a second."""
    rng = np.random.default_rng(seed)
    place = rng.uniform((0, 0), (1200, 680), (count, 2))
    side = rng.uniform(0.7, 1.4, (count, 2)) * side_px
    speed = rng.normal((2.0, 0.5), 1.0, (count, 2))
    found = []
    for step in range(steps):
        centre = place + speed * 5 * step + rng.normal(0, 0.02, (count, 2)) * side
        sides = side * rng.normal(1, 0.03, (count, 2))
        here = rng.random(count) > 0.05
        boxes = np.concatenate((centre - sides / 2, centre + sides / 2), axis=1)[here]
        found.append(
            car_tracks(
                5 * step,
                boxes,
                ids=1 + 3 * np.flatnonzero(here),
                classes=np.flatnonzero(here) % 4,
                confidences=np.clip(rng.normal(0.7, 0.06, here.sum()), 0, 1),
            )
        )
    return found


def encoded(steps, *, refresh_ns=SECOND_NS):
    encoder = TrackStepEncoder(session_id=2**63 + 1, refresh_ns=refresh_ns)
    return [
        encoder.encode(one, capture_ns=START_NS + one.frame_index * SECOND_NS // 15, send_delay_ns=9_000_000)
        for one in steps
    ]


@pytest.mark.parametrize("side_px", [10, 40, 150])
def test_the_ground_has_the_edges_boxes(side_px):
    """Boxes would lie beside the objects, or classes and ids be mixed up."""
    sent = flight(20, side_px=side_px)
    decoder = TrackStepDecoder()
    for one, step in zip(sent, encoded(sent), strict=True):
        got = decoder.decode(TrackStep.parse(step.pack()))
        assert got.frame_index == one.frame_index
        assert got.ids.tolist() == one.ids.tolist()
        assert got.class_ids.tolist() == one.class_ids.tolist()
        assert np.abs(got.confidences - one.confidences).max() < 0.14
        overlap = np.diag(iou(got.boxes_xyxy_px, one.boxes_xyxy_px))
        assert overlap.mean() > 0.94
        assert overlap.min() > 0.85


def test_a_step_is_a_few_bytes_a_box():
    """The channel would eat what stills need: at three steps a second, 50 boxes in 8 kbps."""
    sent = flight(30)
    steps = encoded(sent)
    boxes = sum(map(len, sent))
    assert sum(len(step.pack()) for step in steps) / boxes < 6
    assert sum(step.reference < 0 for step in steps) == 10
    standing = [replace(one, frame_index=5 * index) for index, one in enumerate([sent[0]] * 30)]
    assert sum(len(step.pack()) for step in encoded(standing)) / (30 * len(sent[0])) < 3.2


@pytest.mark.parametrize("lost", [{0}, {1}, {2}, {4, 5}, {3}, {7, 8, 9}])
def test_a_lost_step_hurts_for_a_second_at_most(lost):
    """One message lost on a bad link would cost the tracks until the edge starts anew."""
    sent = flight(15)
    decoder, missed = TrackStepDecoder(), []
    for index, (one, step) in enumerate(zip(sent, encoded(sent), strict=True)):
        if index in lost:
            continue
        got = decoder.decode(step)
        if got is None:
            missed.append(index)
            continue
        assert got.ids.tolist() == one.ids.tolist()
        assert np.diag(iou(got.boxes_xyxy_px, one.boxes_xyxy_px)).min() > 0.85
    last = max(lost)
    assert missed == list(range(last + 1, last + 3 - last % 3)), "up to the next step that stands by itself"


def test_repetitions_and_old_steps_are_passed_over():
    """A duplicate would move the tracks back, or twice."""
    steps = encoded(flight(4))
    decoder = TrackStepDecoder()
    first = decoder.decode(steps[0])
    assert decoder.decode(steps[0]) is None
    decoder.decode(steps[1])
    assert decoder.decode(steps[0]) is None
    assert decoder.decode(steps[2]) is not None
    assert first.started.all()


def test_births_deaths_returns_and_changes_arrive():
    """Tracks would stay on the map after they end, or come back as others."""
    box, far = [100, 100, 140, 130], [600.0, 300, 650, 340]
    sent = [
        car_tracks(0, [box, far], ids=[4, 9]),
        car_tracks(2, [box], ids=[4]),
        car_tracks(4, [box, far], ids=[4, 9], classes=[5, 3], confidences=[0.2, 0.7]),
        car_tracks(6, [], ids=[]),
        car_tracks(8, [far, box], ids=[9, 2**32 - 1]),
    ]
    decoder = TrackStepDecoder()
    got = [decoder.decode(step) for step in encoded(sent)]
    assert [one.ids.tolist() for one in got] == [[4, 9], [4], [4, 9], [], [9, 2**32 - 1]]
    assert (got[2].class_ids.tolist(), got[2].started.tolist()) == ([5, 3], [False, True])
    np.testing.assert_allclose(got[2].confidences, [0.2, 0.7], atol=0.07)
    assert (got[4].born_frames.tolist(), got[3].boxes_xyxy_px.shape) == ([0, 8], (0, 4))


def test_between_steps_the_tracks_move_on():
    """At three steps a second, boxes would jump."""
    sent = [car_tracks(5 * step, [[10 + 20 * step, 50, 50 + 20 * step, 80]]) for step in range(6)]
    decoder = TrackStepDecoder()
    assert decoder.predicted(frame_index=3) is None
    for step in encoded(sent):
        decoder.decode(step)
    ahead = decoder.predicted(frame_index=28)
    assert ahead.frame_index == 28
    np.testing.assert_allclose(ahead.boxes_xyxy_px, [[122, 50, 162, 80]], atol=3)
    assert ahead.seen_frames.tolist() == [25]
    assert not ahead.started.any()


def test_a_crowd_is_cut_to_the_most_confident():
    """A detector gone wild would stop the channel, or the process."""
    rng = np.random.default_rng(1)
    corner = rng.uniform(-1e5, 1e5, (3000, 2))
    boxes = np.concatenate((corner, corner + rng.uniform(0, 3e4, (3000, 2))), axis=1)
    sure = rng.random(3000).astype(np.float32)
    sent = car_tracks(0, boxes, confidences=sure, classes=rng.integers(0, 2048, 3000))
    step = encoded([sent])[0]
    got = TrackStepDecoder().decode(TrackStep.parse(step.pack()))
    assert MOST_BOXES / 2 <= len(got) <= MOST_BOXES
    best = np.sort(np.argsort(-sure, kind="stable")[: len(got)])
    assert got.ids.tolist() == sent.ids[best].tolist()


def test_frames_must_rise_at_the_edge():
    """A wrong order is a bug there, and would be one of many unread steps at the ground."""
    encoder = TrackStepEncoder(session_id=1)
    encoder.encode(car_tracks(5, []), capture_ns=5)
    with pytest.raises(ValueError, match="frame_index is 5, must be above 5"):
        encoder.encode(car_tracks(5, []), capture_ns=6)


def test_long_hostile_sessions_stay_bounded():
    """A stranger's steps would take all memory."""
    rng, decoder, last = random.Random(5), TrackStepDecoder(), -1
    (usual,) = encoded(flight(1))
    for sequence in range(300):
        boxes, numbers = (
            rng.randbytes(rng.choice((3, 30, 300))),
            {"sequence": sequence, "frame_index": sequence},
        )
        with contextlib.suppress(WireError):
            decoder.decode(replace(usual, **numbers, reference=last, boxes=boxes))
            last = sequence
    assert last > 100
    assert len(pickle.dumps(decoder)) < 8 * MOST_BOXES * 60
