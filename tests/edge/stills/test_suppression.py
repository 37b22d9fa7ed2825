"""Temporal suppression and the memory that feeds it."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Tracks, View
from hvt_edge.perception.candidates import (
    BaseLoss,
    Candidate,
    ClassPosterior,
    TrackMemory,
    measure_loss,
    sharpness,
)
from hvt_edge.stills.scheduler import Gate, Suppression
from media.clips import hard_pictures
from rigs.examples import candidate, tracks_of

SECOND = 1_000_000_000
VIEW = View.fitted((1920, 1080), (1280, 720), fit="letterbox")


def car(**changes) -> Candidate:
    return candidate(**{"frame_index": 100, "box_source_px": (150, 150, 225, 210), "born_frame": 0} | changes)


def tracks(frame: int, boxes: dict[int, tuple], *, started=(), seen: int | None = None) -> Tracks:
    return tracks_of(frame, boxes, seen=seen, started=[number in started for number in sorted(boxes)])


BOX = (100.0, 200.0, 180.0, 260.0)


def step(memory: TrackMemory, frame: int, boxes=None, *, now_ns=None, view=VIEW, source=None, **tracked):
    given_tracks = tracks(frame, boxes or {1: BOX}, **tracked)
    now_ns = frame if now_ns is None else now_ns
    return memory.candidates(
        given_tracks, view=view, class_names=("car", "van"), now_ns=now_ns, source_bgr=source
    )


def reason(suppression: Suppression, one: Candidate, now_ns: int) -> str | None:
    return suppression.reason(one, now_ns=now_ns)


SENT = {"sent_count": 1, "last_sent_frame": 10, "last_sent_ns": 10 * SECOND, "last_sent_area_px": 75.0 * 60}


def test_pixels_are_only_looked_at_when_it_matters():
    """Every step would pay for sharpness of every track."""

    def never() -> float:
        raise AssertionError("measured without need")

    rest = Suppression.for_cooldown(2.0)
    assert reason(rest, car(sharpness=never), 0) is None
    assert reason(rest, car(**SENT, last_sent_sharpness=1.0, sharpness=never), 11 * SECOND) == "cooldown"


GOING = SENT | {"touches_border": True, "leaving": True, "border_s": 5.0}
GROWN = {"box_source_px": (150, 150, 225, 150 + 60 * 1.2)}


@pytest.mark.parametrize(
    ("changes", "at_s", "held"),
    [
        # One parked car would take the whole still budget, or never be seen again.
        ({}, 0, None),
        (SENT, 11.999_999_999, "cooldown"),
        (SENT, 12, "no_gain"),
        (SENT, 19.999_999_999, "no_gain"),
        (SENT, 20, None),
        # A car that has come nearer since its still would be shown as it was far away.
        (SENT | GROWN, 13, None),
        (SENT | {"box_source_px": (150, 150, 225, 150 + 60 * 1.19)}, 13, "no_gain"),
        (SENT | {"last_sent_sharpness": 100.0, "sharpness": lambda: 121.0}, 13, None),
        (SENT | {"last_sent_sharpness": 100.0, "sharpness": lambda: 119.0}, 13, "no_gain"),
        # Half a car would be sent although the whole one comes a moment later; or one at the border never.
        ({"touches_border": True, "border_s": 0.0}, 0, "border"),
        ({"touches_border": True, "border_s": 0.99}, 0, "border"),
        ({"touches_border": True, "border_s": 1.0}, 0, None),
        ({"touches_border": True, "leaving": True}, 0, None),  # its last chance
        # A track that leaves would be sent again as a fragment, which a classifier reads wrongly.
        (GOING, 60, "border"),
        (GOING | {"last_sent_at_border": True}, 60, None),
        (SENT | {"last_sent_at_border": True}, 13, None),  # whole at last
        # A track whose base is good would be coded in vain at every step and hold up the others.
        ({"last_refused_ns": 5 * SECOND}, 5.999_999_999, "refused"),
        ({"last_refused_ns": 5 * SECOND}, 6, None),
    ],
)
def test_a_track_rests_after_its_still_until_there_is_more_to_see(changes, at_s, held):
    assert reason(Suppression.for_cooldown(2.0), car(**changes), round(at_s * SECOND)) == held
    if "last_refused_ns" in changes:
        assert reason(Suppression.for_cooldown(0.0), car(**changes), round(at_s * SECOND)) == held


@given(
    sent=st.one_of(st.just({}), st.integers(0, 100).map(lambda at_s: SENT | {"last_sent_ns": at_s * SECOND})),
    touches=st.booleans(),
    leaving=st.booleans(),
    border_s=st.floats(0, 10),
)
def test_cooldown_zero_is_the_paper_s_plain_variant(sent, touches, leaving, border_s):
    """The paper's M1 to M5 could not be run as they are defined."""
    one = car(**sent, touches_border=touches, leaving=leaving, border_s=border_s)
    assert reason(Suppression.for_cooldown(0.0), one, 100 * SECOND) is None


def test_memory_tells_starts_sends_and_feedback():
    """Methods would decide on what was never so."""
    memory = TrackMemory()
    (first,) = step(memory, 5, {7: BOX}, started=(7,), now_ns=5 * SECOND)
    told = (first.started, first.frames_since_start, first.detected, first.class_name)
    assert told == (True, 0, True, "car")
    assert first.box_source_px == pytest.approx((150, 300, 270, 390))
    assert first.area_share == pytest.approx(80 * 60 / (1280 * 720))
    assert first.crop_area_px == pytest.approx(120 * 1.3 * 90 * 1.3, rel=0.03)
    memory.record_sent(first, frame_index=5, now_ns=5 * SECOND)
    memory.record_feedback(7, class_name="minivan", confidence=0.6, entropy_nats=1.1)
    memory.record_refused(7, now_ns=6 * SECOND)
    memory.record_feedback(8, class_name="ghost", confidence=0.6, entropy_nats=1.1)
    (second,) = step(memory, 10, {7: BOX}, seen=9, now_ns=7 * SECOND)
    assert (second.started, second.frames_since_start, second.detected) == (False, 5, False)
    assert (second.sent_count, second.last_sent_frame, second.last_sent_ns) == (1, 5, 5 * SECOND)
    assert second.last_sent_area_px == pytest.approx(120 * 90)
    assert second.posterior == ClassPosterior("minivan", 0.6, 1.1)
    assert second.last_refused_ns == 6 * SECOND


def test_a_start_between_two_steps_is_not_missed():
    """M2 would pass over every track that begins or is found again on a frame without a decision."""
    memory = TrackMemory()
    assert step(memory, 0, started=(1,))[0].started
    assert not step(memory, 5)[0].started
    memory.observe(tracks(7, {1: BOX}, started=(1,)), now_ns=7)
    (again,) = step(memory, 10)
    assert (again.started, again.frames_since_start) == (True, 3)
    assert not step(memory, 15)[0].started


def test_memory_forgets_the_dead():
    """An edge that flies for hours would grow without end."""
    memory = TrackMemory(forget_s=10.0, max_tracks=50)
    gone, *_ = step(memory, 0, dict.fromkeys(range(1, 41), BOX))
    counts = [len(memory)]
    for frame, ids, now_ns in (
        (1, [99], 10 * SECOND),
        (2, [99], 10 * SECOND + 1),
        (3, range(100, 200), 11 * SECOND),
    ):
        memory.observe(tracks(frame, dict.fromkeys(ids, BOX)), now_ns=now_ns)
        counts.append(len(memory))
    memory.record_sent(gone, frame_index=0, now_ns=0)
    assert [*counts, len(memory)] == [40, 41, 1, 50, 50]


def test_border_contact_is_seen_and_timed():
    """Entering, leaving and staying at the border would be told apart wrongly."""
    memory = TrackMemory()

    def look(frame, left, right):
        return step(memory, frame, {1: (left, 200.0, right, 260.0)}, now_ns=frame * SECOND // 10)[0]

    entering = [look(i, -30.0, 10.0 + 8 * i) for i in range(6)]
    assert all(one.touches_border and not one.leaving for one in entering)
    assert entering[-1].border_s == pytest.approx(0.5)
    assert entering[0].box_base_px[0] == 0.0
    inside = look(6, 20.0, 90.0)
    assert (inside.touches_border, inside.border_s) == (False, 0.0)
    leaving = [look(7 + i, 1210.0 + 20 * i, 1290.0 + 20 * i) for i in range(3)]
    assert [one.leaving for one in leaving] == [False, True, True]


def test_letterbox_borders_are_no_picture():
    """With a 4:3 camera, objects cut off at the left and right would count as whole."""
    view = View.fitted((960, 720), (1280, 720), fit="letterbox")
    (one,) = step(TrackMemory(), 0, {1: (150.0, 200.0, 220.0, 260.0)}, view=view)
    assert one.touches_border
    assert one.box_base_px[0] == pytest.approx(160)
    assert one.box_source_px == pytest.approx((0, 200, 60, 260))


def test_sharpness_falls_with_blur_and_distance():
    """A blurred still would count as good as a sharp one."""
    rng = np.random.default_rng(0)
    sharp = cv2.resize(
        rng.integers(0, 256, (40, 40, 3), dtype=np.uint8), (128, 128), interpolation=cv2.INTER_CUBIC
    )
    blurred = cv2.GaussianBlur(sharp, (0, 0), 3)
    far = cv2.resize(sharp, (24, 24), interpolation=cv2.INTER_AREA)
    assert sharpness(sharp) > 1.5 * sharpness(blurred)
    assert sharpness(sharp) > 1.2 * sharpness(far)
    (one,) = step(TrackMemory(), 0, source=np.zeros((1080, 1920, 3), np.uint8))
    assert one.sharpness() == 0.0


CROP = hard_pictures(1, size=(160, 96))[0]


@pytest.mark.parametrize(
    ("gate", "psnr_y_db", "detail_lost", "good"),
    [
        (36, 36.0, 0.0, True),
        (36, 35.9, 0.0, False),
        (36, 60.0, 0.4, True),
        (36, 60.0, 0.41, False),
        (0, 99.0, 0.0, False),  # off, as for the paper's methods
    ],
)
def test_both_conditions_have_to_hold(gate, psnr_y_db, detail_lost, good):
    """An object whose edges are gone, or whose colours are wrong, would never be shown."""
    assert Gate(psnr_y_db=gate).on == (gate > 0)
    assert Gate(psnr_y_db=gate).good_enough(BaseLoss(psnr_y_db, detail_lost)) == good


def test_a_dim_object_without_its_edges_is_not_good():
    """PSNR alone would call every object in the shade good: there is little of anything to lose."""
    gate = Gate(psnr_y_db=36.0)
    dim = (CROP * 0.12).astype(np.uint8)
    loss = measure_loss(dim, cv2.GaussianBlur(dim, (0, 0), 3))
    assert loss.psnr_y_db > 36
    assert not gate.good_enough(loss)
    assert gate.good_enough(measure_loss(dim, dim))
