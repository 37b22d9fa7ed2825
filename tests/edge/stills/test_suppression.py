"""Temporal suppression and the memory that feeds it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Tracks, View
from hvt_edge.perception.candidates import BaseLoss, Candidate, TrackMemory, measure_loss, sharpness
from hvt_edge.stills.scheduler import Gate, Suppression
from media.clips import hard_pictures
from rigs.examples import candidate, tracks_of

SECOND = 1_000_000_000
VIEW = View.fitted((1920, 1080), (1280, 720), fit="letterbox")


def car(**changes) -> Candidate:
    """An ordinary car, which the source shows finer."""
    return candidate(**{"frame_index": 100, "box_source_px": (150, 150, 225, 210), "born_frame": 0} | changes)


def tracks(frame: int, boxes: dict[int, tuple], *, started=(), seen: int | None = None) -> Tracks:
    """Tracks at one frame."""
    return tracks_of(frame, boxes, seen=seen, started=[number in started for number in sorted(boxes)])


def reason(suppression: Suppression, one: Candidate, now_ns: int) -> str | None:
    """Why it is held; None where it goes on."""
    kept, held = suppression.apply([one], now_ns=now_ns)
    assert len(kept) + len(held) == 1
    return held[0][1] if held else None


SENT = {"sent_count": 1, "last_sent_frame": 10, "last_sent_ns": 10 * SECOND, "last_sent_area_px": 75.0 * 60}


def test_cooldown_then_gain_then_time():
    """One parked car would take the whole still budget, or never be seen again."""
    rest = Suppression.for_cooldown(2.0)
    assert reason(rest, car(), 0) is None
    assert reason(rest, car(**SENT), 10 * SECOND + 1_999_999_999) == "cooldown"
    assert reason(rest, car(**SENT), 12 * SECOND) == "no_gain"
    assert reason(rest, car(**SENT), 20 * SECOND - 1) == "no_gain"
    assert reason(rest, car(**SENT), 20 * SECOND) is None


def test_growth_or_sharpness_is_a_gain():
    """A car that has come nearer since its still would be shown as it was far away."""
    rest, now = Suppression.for_cooldown(2.0), 13 * SECOND
    grown = car(**SENT, box_source_px=(150, 150, 225, 150 + 60 * 1.2))
    assert reason(rest, grown, now) is None
    nearly = car(**SENT, box_source_px=(150, 150, 225, 150 + 60 * 1.19))
    assert reason(rest, nearly, now) == "no_gain"
    assert reason(rest, car(**SENT, last_sent_sharpness=100.0, sharpness=lambda: 121.0), now) is None
    assert reason(rest, car(**SENT, last_sent_sharpness=100.0, sharpness=lambda: 119.0), now) == "no_gain"


def test_pixels_are_only_looked_at_when_it_matters():
    """Every step would pay for sharpness of every track."""

    def never() -> float:
        raise AssertionError("measured without need")

    rest = Suppression.for_cooldown(2.0)
    assert reason(rest, car(sharpness=never), 0) is None
    assert reason(rest, car(**SENT, last_sent_sharpness=1.0, sharpness=never), 11 * SECOND) == "cooldown"


def test_border_waits_are_bounded():
    """Half a car would be sent although the whole one comes a moment later; or one at the border never."""
    rest = Suppression.for_cooldown(2.0)
    touching = car(touches_border=True)
    assert reason(rest, replace(touching, border_s=0.0), 0) == "border"
    assert reason(rest, replace(touching, border_s=0.99), 0) == "border"
    assert reason(rest, replace(touching, border_s=1.0), 0) is None
    assert reason(rest, replace(touching, leaving=True), 0) is None  # its last chance


def test_a_part_does_not_follow_the_whole():
    """A track that leaves would be sent again as a fragment, which a classifier reads wrongly."""
    rest = Suppression.for_cooldown(2.0)
    going = car(**SENT, touches_border=True, leaving=True, border_s=5.0)
    assert reason(rest, going, 60 * SECOND) == "border"
    assert reason(rest, replace(going, last_sent_at_border=True), 60 * SECOND) is None
    inside = car(**SENT, last_sent_at_border=True)
    assert reason(rest, inside, 13 * SECOND) is None  # whole at last


def test_refused_stills_rest_in_every_variant():
    """A track whose base is good would be coded in vain at every step and hold up the others."""
    for rest in (Suppression.for_cooldown(2.0), Suppression.for_cooldown(0.0)):
        refused = car(last_refused_ns=5 * SECOND)
        assert reason(rest, refused, 5 * SECOND + SECOND - 1) == "refused"
        assert reason(rest, refused, 6 * SECOND) is None


@given(
    sent_s=st.one_of(st.none(), st.integers(0, 100)),
    touches=st.booleans(),
    leaving=st.booleans(),
    border_s=st.floats(0, 10),
)
def test_cooldown_zero_is_the_paper_s_plain_variant(sent_s, touches, leaving, border_s):
    """The paper's M1 to M5 could not be run as they are defined."""
    plain = Suppression.for_cooldown(0.0)
    one = car(
        last_sent_ns=None if sent_s is None else sent_s * SECOND,
        last_sent_area_px=None if sent_s is None else 1e9,
        sent_count=0 if sent_s is None else 1,
        touches_border=touches,
        leaving=leaving,
        border_s=border_s,
    )
    assert reason(plain, one, 100 * SECOND) is None


def test_memory_tells_starts_sends_and_feedback():
    """Methods would decide on what was never so."""
    memory = TrackMemory()
    box = (100.0, 200.0, 180.0, 260.0)
    names = ("car", "van")
    (first,) = memory.candidates(
        tracks(5, {7: box}, started=(7,)), view=VIEW, class_names=names, now_ns=5 * SECOND
    )
    assert (first.started, first.frames_since_start, first.detected, first.class_name) == (
        True,
        0,
        True,
        "car",
    )
    assert first.box_source_px == pytest.approx((150, 300, 270, 390))
    assert first.area_share == pytest.approx(80 * 60 / (1280 * 720))
    assert first.crop_area_px == pytest.approx(120 * 1.3 * 90 * 1.3, rel=0.03)
    memory.record_sent(first, frame_index=5, now_ns=5 * SECOND)
    memory.record_feedback(7, class_name="minivan", confidence=0.6, entropy_nats=1.1)
    memory.record_refused(7, now_ns=6 * SECOND)
    memory.record_feedback(8, class_name="ghost", confidence=0.6, entropy_nats=1.1)
    (second,) = memory.candidates(
        tracks(10, {7: box}, seen=9), view=VIEW, class_names=names, now_ns=7 * SECOND
    )
    assert (second.started, second.frames_since_start, second.detected) == (False, 5, False)
    assert (second.sent_count, second.last_sent_frame, second.last_sent_ns) == (1, 5, 5 * SECOND)
    assert second.last_sent_area_px == pytest.approx(120 * 90)
    assert second.posterior is not None
    assert (second.posterior.class_name, second.posterior.confidence) == ("minivan", 0.6)
    assert second.last_refused_ns == 6 * SECOND


def test_a_start_between_two_steps_is_not_missed():
    """M2 would pass over every track that begins or is found again on a frame without a decision."""
    memory = TrackMemory()
    box = (100.0, 200.0, 180.0, 260.0)

    def step(frame, started=()):
        return memory.candidates(
            tracks(frame, {1: box}, started=started), view=VIEW, class_names=(), now_ns=frame
        )

    assert step(0, started=(1,))[0].started
    assert not step(5)[0].started
    memory.observe(tracks(7, {1: box}, started=(1,)), now_ns=7)
    (again,) = step(10)
    assert again.started
    assert again.frames_since_start == 3
    assert not step(15)[0].started


def test_memory_forgets_the_dead():
    """An edge that flies for hours would grow without end."""
    memory = TrackMemory(forget_s=10.0, max_tracks=50)
    box = (100.0, 200.0, 180.0, 260.0)
    gone, *_ = memory.candidates(
        tracks(0, dict.fromkeys(range(1, 41), box)), view=VIEW, class_names=(), now_ns=0
    )
    assert len(memory) == 40
    memory.observe(tracks(1, {99: box}), now_ns=10 * SECOND)
    assert len(memory) == 41
    memory.observe(tracks(2, {99: box}), now_ns=10 * SECOND + 1)
    assert len(memory) == 1
    memory.observe(tracks(3, dict.fromkeys(range(100, 200), box)), now_ns=11 * SECOND)
    assert len(memory) == 50
    memory.record_sent(gone, frame_index=0, now_ns=0)
    assert len(memory) == 50


def test_border_contact_is_seen_and_timed():
    """Entering, leaving and staying at the border would be told apart wrongly."""
    memory = TrackMemory()

    def look(frame, box):
        now = frame * SECOND // 10
        return memory.candidates(tracks(frame, {1: box}), view=VIEW, class_names=(), now_ns=now)[0]

    entering = [look(i, (-30.0, 200.0, 10.0 + 8 * i, 260.0)) for i in range(6)]
    assert all(one.touches_border and not one.leaving for one in entering)
    assert entering[-1].border_s == pytest.approx(0.5)
    assert entering[0].box_base_px[0] == 0.0
    inside = look(6, (20.0, 200.0, 90.0, 260.0))
    assert (inside.touches_border, inside.border_s) == (False, 0.0)
    leaving = [look(7 + i, (1210.0 + 20 * i, 200.0, 1290.0 + 20 * i, 260.0)) for i in range(3)]
    assert [one.leaving for one in leaving] == [False, True, True]


def test_letterbox_borders_are_no_picture():
    """With a 4:3 camera, objects cut off at the left and right would count as whole."""
    view = View.fitted((960, 720), (1280, 720), fit="letterbox")
    (one,) = TrackMemory().candidates(
        tracks(0, {1: (150.0, 200.0, 220.0, 260.0)}), view=view, class_names=(), now_ns=0
    )
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
    source = np.zeros((1080, 1920, 3), np.uint8)
    (one,) = TrackMemory().candidates(
        tracks(0, {1: (100.0, 200.0, 180.0, 260.0)}), view=VIEW, class_names=(), now_ns=0, source_bgr=source
    )
    assert one.sharpness is not None
    assert one.sharpness() == 0.0


# The gate

CROP = hard_pictures(1, size=(160, 96))[0]


@pytest.mark.parametrize(
    ("psnr_y_db", "detail_lost", "good"),
    [(36.0, 0.0, True), (35.9, 0.0, False), (60.0, 0.4, True), (60.0, 0.41, False)],
)
def test_both_conditions_have_to_hold(psnr_y_db, detail_lost, good):
    """An object whose edges are gone, or whose colours are wrong, would never be shown."""
    assert Gate(psnr_y_db=36.0).good_enough(BaseLoss(psnr_y_db, detail_lost)) == good


def test_off_it_holds_nothing_back():
    """The paper's methods would lose stills."""
    gate = Gate()
    assert not gate.on
    assert not gate.good_enough(BaseLoss(99.0, 0.0))


def test_a_dim_object_without_its_edges_is_not_good():
    """PSNR alone would call every object in the shade good: there is little of anything to lose."""
    gate = Gate(psnr_y_db=36.0)
    dim = (CROP * 0.12).astype(np.uint8)
    loss = measure_loss(dim, cv2.GaussianBlur(dim, (0, 0), 3))
    assert loss.psnr_y_db > 36
    assert not gate.good_enough(loss)
    assert gate.good_enough(measure_loss(dim, dim))
