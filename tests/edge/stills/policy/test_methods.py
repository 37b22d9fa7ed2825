"""The scheduling policies: what each wants, and that each is a pure function."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace
from math import exp

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_edge.perception.candidates import Candidate, ClassPosterior
from hvt_edge.stills.policy.base import CostEstimate, CostModel
from hvt_edge.stills.policy.paper import Small, Utility
from hvt_edge.stills.policy.registry import METHODS, method, tuning
from rigs.examples import candidate
from rigs.examples import decision_step as step

SECOND = 1_000_000_000
FPS = 15.0
NAMES = st.sampled_from(["car", "van", "truck", "pedestrian", "tricycle", "moving"])


def car(track_id: int = 1, **changes) -> Candidate:
    """An ordinary one."""
    plain = {"box_source_px": (150, 150, 225, 210), "confidence": 0.8, "frames_since_start": 100}
    return candidate(track_id, **(plain | changes))


@st.composite
def candidates(draw):
    """Any set of tracks."""
    result = []
    for track_id in draw(st.lists(st.integers(1, 500), unique=True, max_size=25)):
        x, y = draw(st.floats(0, 1200)), draw(st.floats(0, 640))
        w, h = draw(st.floats(1, 400)), draw(st.floats(1, 400))
        sent = draw(st.one_of(st.none(), st.integers(200, 300)))
        waiting = draw(st.integers(0, 100))
        result.append(
            car(
                track_id,
                box_base_px=(x, y, x + w, y + h),
                area_share=w * h / (1280 * 720),
                crop_area_px=1.69 * w * h,
                class_name=draw(NAMES),
                confidence=draw(st.sampled_from([0.1, 0.3, 0.5, 0.7, 0.9])),
                detected=draw(st.booleans()),
                started=waiting < 5,
                frames_since_start=waiting,
                sent_count=0 if sent is None else 1,
                last_sent_frame=sent,
                last_sent_ns=None if sent is None else round(sent / FPS * SECOND),
                posterior=draw(
                    st.one_of(st.none(), st.builds(ClassPosterior, NAMES, st.floats(0, 1), st.floats(0, 7)))
                ),
            )
        )
    return result


@pytest.mark.parametrize("name", METHODS)
@given(given_candidates=candidates(), room=st.floats(0, 50_000), seed=st.integers(0, 9))
@settings(max_examples=40, deadline=None)
def test_every_method_is_a_pure_function_of_its_input(name, given_candidates, room, seed):
    """The same flight would give other stills each time, and tables that nobody can reproduce."""
    policy, moment = method(name), step(allowance_bytes=room)
    wanted = policy.requests(given_candidates, moment)
    assert policy.requests(given_candidates, moment) == wanted
    assert method(name).requests(given_candidates, moment) == wanted
    shuffled = [given_candidates[i] for i in np.random.default_rng(seed).permutation(len(given_candidates))]
    assert policy.requests(shuffled, moment) == wanted
    ids = [request.candidate.track_id for request in wanted]
    assert len(set(ids)) == len(ids)
    assert all(request.candidate in given_candidates for request in wanted)
    scores = [request.score for request in wanted]
    assert scores == sorted(scores, reverse=True)
    assert all(np.isfinite(scores))
    assert all(request.reason for request in wanted)
    assert policy.name == name
    assert not (policy.video_only and wanted)


def test_m0_sends_nothing():
    """The baseline would not be a baseline."""
    assert method("M0").video_only
    assert method("M0").requests([car(confidence=0.01)], step()) == []
    assert [name for name in METHODS if method(name).video_only] == ["M0", "R0"]


def test_m1_is_due_every_15_frames_most_overdue_first():
    """Tracks would be forgotten, or sent more often than the paper's interval."""
    policy = method("M1")
    for sent, due in ((286, False), (285, True), (200, True), (300, False)):
        assert bool(policy.requests([car(last_sent_frame=sent)], step())) == due
    order = [
        car(1, last_sent_frame=280),
        car(2, last_sent_frame=100),
        car(3, last_sent_frame=285),
    ]
    assert [one.candidate.track_id for one in policy.requests(order, step())] == [2, 1, 3]
    assert policy.requests([car(born_frame=300, frames_since_start=0)], step())[0].score == 0


def test_m1_serves_each_track_once_a_second():
    """Over a run, a track would get more or fewer stills than one in 15 frames."""
    policy, last = method("M1"), {}
    sends = dict.fromkeys((1, 2, 3), 0)
    for frame in range(0, 151, 5):
        now = [car(i, frame_index=frame, born_frame=0, last_sent_frame=last.get(i)) for i in sends]
        for request in policy.requests(now, step(frame)):
            last[request.candidate.track_id] = frame
            sends[request.candidate.track_id] += 1
    assert sends == dict.fromkeys((1, 2, 3), 11)


def test_m2_wants_one_still_a_start():
    """A new object would not be looked at, or one object for ever."""
    policy = method("M2")
    new = car(started=True, frames_since_start=0, born_frame=300)
    assert [one.reason for one in policy.requests([new], step())] == ["new"]
    answered = replace(new, last_sent_frame=300)
    assert policy.requests([answered], step()) == []
    found_again = replace(new, born_frame=10, last_sent_frame=250, frames_since_start=2)
    assert len(policy.requests([found_again], step())) == 1
    assert policy.requests([replace(found_again, last_sent_frame=298)], step()) == []


def test_m2_waits_a_second_and_no_longer():
    """A start without room in the budget would be lost, or haunt the queue for ever."""
    policy = method("M2")
    waiting = [car(frames_since_start=frames) for frames in (0, 15, 16)]
    assert [bool(policy.requests([one], step())) for one in waiting] == [True, True, False]
    assert method("M2", patience_s=0).requests([waiting[1]], step()) == []


def test_m3_follows_the_classifier_once_it_has_spoken():
    """Stills would go on for objects that are settled, or not go where the classifier is lost."""
    policy = method("M3")
    assert len(policy.requests([car(confidence=0.49)], step())) == 1
    assert policy.requests([car(confidence=0.5)], step()) == []
    sure, unsure = ClassPosterior("minivan", 0.9, 0.4), ClassPosterior("minivan", 0.2, 3.0)
    assert policy.requests([car(confidence=0.1, posterior=sure)], step()) == []
    assert len(policy.requests([car(confidence=0.95, posterior=unsure)], step())) == 1
    order = [car(1, confidence=0.4), car(2, confidence=0.2), car(3, posterior=unsure)]
    assert [one.candidate.track_id for one in policy.requests(order, step())] == [2, 3, 1]


def test_m4_wants_the_small_smallest_first():
    """Stills would go to objects that the base already shows large."""
    policy = method("M4")
    some = [car(i, area_share=share) for i, share in ((1, 0.015), (2, 0.0149), (3, 0.001))]
    assert [one.candidate.track_id for one in policy.requests(some, step())] == [3, 2]


def test_m5_known_answer():
    """The score would not be the paper's."""
    one = car(
        confidence=0.6,
        area_share=0.006,
        crop_area_px=8000,
        last_sent_ns=round(300 / FPS * SECOND) - 5 * SECOND,
    )
    moment = step(cost=CostEstimate(fixed_bytes=1000, bytes_per_px=0.25, mean_bytes=1500))
    expected = (0.5 * 0.4 + 0.3 * 0.6 + 0.2 * (1 - exp(-1))) / (3000 / 1500)
    (request,) = method("M5").requests([one], moment)
    assert request.score == pytest.approx(expected)
    known = replace(one, posterior=ClassPosterior("minivan", 0.5, 1.0), last_sent_ns=None)
    expected = (0.5 * (1 - exp(-1)) + 0.3 * 0.6 + 0.2) / 2
    assert method("M5").requests([known], moment)[0].score == pytest.approx(expected)


@given(candidates(), st.integers(0, 24), st.data())
@settings(max_examples=60, deadline=None)
def test_m5_score_is_monotone_in_every_term(some, index, draw):
    """More doubt, less area, longer silence or lower cost would make an object less wanted."""
    if not some:
        return
    one, policy, moment = some[index % len(some)], method("M5"), step()
    assert isinstance(policy, Utility)
    before = policy.score(one, moment)
    share = draw.draw(st.floats(0, 1))
    better = [
        replace(one, area_share=one.area_share * share),
        replace(one, crop_area_px=one.crop_area_px * share),
        replace(one, last_sent_ns=None),
    ]
    if one.last_sent_ns is not None:
        better.append(replace(one, last_sent_ns=round(one.last_sent_ns * share)))
    if one.posterior is None:
        better.append(replace(one, confidence=one.confidence * share))
    else:
        better.append(replace(one, posterior=replace(one.posterior, entropy_nats=8.0)))
    for changed in better:
        assert policy.score(changed, moment) >= before - 1e-12
    assert 0 <= before <= 1 / 0.25


def test_m5_asks_for_what_fits_and_always_for_the_best():
    """The queue would fill with stills that never find room, or small ones would starve a needed large one."""
    cost = CostEstimate(fixed_bytes=1000, bytes_per_px=0, mean_bytes=1000)
    some = [car(i, confidence=0.1 * i) for i in range(1, 9)]
    for room, count in ((0, 1), (999, 1), (1000, 1), (3500, 3), (8000, 8), (1e9, 8)):
        wanted = method("M5").requests(some, step(cost=cost, allowance_bytes=room))
        assert [one.candidate.track_id for one in wanted] == list(range(1, count + 1))


def test_m5_leaves_the_settled_alone():
    """Bytes would be spent on an object that is large, certain and just refined."""
    now = round(300 / FPS * SECOND)
    settled = car(
        area_share=0.02, crop_area_px=31_000, last_sent_ns=now, posterior=ClassPosterior("bus", 0.99, 0.02)
    )
    assert method("M5").requests([settled], step()) == []
    assert len(method("M5", min_score=0).requests([settled], step())) == 1


def test_cost_model_learns_the_line():
    """M5 would weigh stills by a price that is not theirs."""
    model, rng = CostModel(), np.random.default_rng(1)
    before = model.estimate()
    assert before.of(car(crop_area_px=10_000)) == pytest.approx(640 + 1200)
    for _ in range(150):
        area = float(rng.uniform(1_000, 40_000))
        model.observe(area_px=area, size_bytes=round((300 + 0.3 * area) * rng.uniform(0.95, 1.05)))
    line = model.estimate()
    for area in (2_000, 10_000, 40_000):
        assert line.of(car(crop_area_px=area)) == pytest.approx(300 + 0.3 * area, rel=0.12)
    assert line.mean_bytes == pytest.approx(300 + 0.3 * 20_500, rel=0.3)


@given(st.lists(st.tuples(st.floats(64, 262_144), st.integers(1, 200_000)), max_size=60))
def test_cost_is_always_positive_and_never_falls_with_area(observed):
    """A strange run of stills would make a cost of zero or less, and a score without bounds."""
    model = CostModel()
    for area, size in observed:
        model.observe(area_px=area, size_bytes=size)
    line = model.estimate()
    small, large = (line.of(car(crop_area_px=area)) for area in (64, 262_144))
    assert 1 <= small <= large
    assert np.isfinite(large)
    assert line.mean_bytes > 0


def test_each_codec_starts_at_its_own_cost():
    """The first stills of a session would be held back, or joined, by the price of another codec."""
    assert CostModel.of_codec("jpeg").estimate() == CostModel().estimate()
    assert CostModel.of_codec("my-codec").estimate() == CostModel().estimate()
    residual = CostModel.of_codec("residual").estimate()
    assert residual.of_px(6_000) == pytest.approx(460)
    assert residual.mean_bytes == pytest.approx(520)
    assert CostModel.of_codec("h264-intra").estimate().of_px(6_000) == pytest.approx(660)


def test_same_areas_do_not_upset_the_cost():
    """All stills of one size would make the estimate blow up."""
    model = CostModel()
    for _ in range(200):
        model.observe(area_px=5_000.0, size_bytes=2_000)
    assert model.estimate().of(car(crop_area_px=5_000)) == pytest.approx(2_000, rel=0.05)


def test_registry_names_all_and_says_what_is_accepted():
    """A typing error would end in a traceback, or in another method than the one asked for."""
    assert [*METHODS][:7] == ["M0", "M1", "M2", "M3", "M4", "M5", "M6"]
    assert {*METHODS} >= {"permissive", "conf_size_top1", "strict_small_only", "balanced_top2"}
    assert method("m5").name == "M5"
    assert method("M1", every_frames=30).requests([car(last_sent_frame=280)], step()) == []
    with pytest.raises(UserError, match="method 'M9' is not known: choose one of M0, M1,"):
        method("M9")
    with pytest.raises(UserError, match="method M4 has no parameter 'every_frames': it has area_share"):
        method("M4", every_frames=3)
    for bad in (-1, float("nan"), float("inf")):
        with pytest.raises(UserError, match="area_share of method M4"):
            method("M4", area_share=bad)
    small = method("M4")
    assert isinstance(small, Small)
    with pytest.raises(FrozenInstanceError):
        small.area_share = 1.0


def test_tuning_reads_what_a_user_writes():
    """A weight would be ignored, or a slip end in a traceback."""
    assert tuning(["min_gain=0.05, lookahead=2", "min_gain=0.1"]) == {"min_gain": 0.1, "lookahead": 2.0}
    assert tuning([]) == {}
    assert method("M6", **tuning(["min_gain=0.5"])).requests([car()], step()) == []
    for bad in ("min_gain", "min_gain=", "=3", "min gain=3", "min_gain=much", ""):
        with pytest.raises(UserError, match=r"--tune .* is not accepted: write KEY=VALUE"):
            tuning([bad])
    with pytest.raises(UserError, match="method M6 has no parameter 'weight'"):
        method("M6", **tuning(["weight=1"]))
