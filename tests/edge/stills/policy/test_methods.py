"""The scheduling policies: what each wants, and that each is a pure function."""

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
    plain = {"box_source_px": (150, 150, 225, 210), "confidence": 0.8, "frames_since_start": 100}
    return candidate(track_id, **(plain | changes))


@st.composite
def candidates(draw):
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


@given(given_candidates=candidates(), room=st.floats(0, 50_000), seed=st.integers(0, 9))
@settings(max_examples=40)
def test_every_method_is_a_pure_function_of_its_input(given_candidates, room, seed):
    """The same flight would give other stills each time, and tables that nobody can reproduce."""
    moment = step(allowance_bytes=room)
    shuffled = [given_candidates[i] for i in np.random.default_rng(seed).permutation(len(given_candidates))]
    for name in METHODS:
        policy = method(name)
        wanted = policy.requests(given_candidates, moment)
        assert policy.requests(given_candidates, moment) == wanted
        assert method(name).requests(given_candidates, moment) == wanted
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


NOW_NS = round(300 / FPS * SECOND)
SURE, UNSURE = ClassPosterior("minivan", 0.9, 0.4), ClassPosterior("minivan", 0.2, 3.0)
NEW = {"started": True, "frames_since_start": 0, "born_frame": 300}
FOUND_AGAIN = NEW | {"born_frame": 10, "last_sent_frame": 250, "frames_since_start": 2}
SETTLED = {
    "area_share": 0.02,
    "crop_area_px": 31_000,
    "last_sent_ns": NOW_NS,
    "posterior": ClassPosterior("bus", 0.99, 0.02),
}


@pytest.mark.parametrize(
    ("policy", "cars", "wanted"),
    [
        # The baseline would not be a baseline.
        (method("M0"), [{"confidence": 0.01}], []),
        # Tracks would be forgotten, or sent more often than the paper's interval; the most overdue comes first.
        (method("M1"), [{"last_sent_frame": sent} for sent in (286, 285, 200, 300)], [3, 2]),
        (method("M1"), [{"last_sent_frame": sent} for sent in (280, 100, 285)], [2, 1, 3]),
        (method("M1"), [{"born_frame": 300, "frames_since_start": 0}], [1]),
        (method("M1", every_frames=30), [{"last_sent_frame": 280}], []),
        # A new object would not be looked at, or one object for ever.
        (method("M2"), [NEW], [1]),
        (method("M2"), [NEW | {"last_sent_frame": 300}], []),
        (method("M2"), [FOUND_AGAIN], [1]),
        (method("M2"), [FOUND_AGAIN | {"last_sent_frame": 298}], []),
        # A start without room in the budget would be lost, or haunt the queue for ever.
        (method("M2"), [{"frames_since_start": frames} for frames in (0, 15, 16)], [2, 1]),
        (method("M2", patience_s=0), [{"frames_since_start": 15}], []),
        # Stills would go on for objects that are settled, or not go where the classifier is lost.
        (method("M3"), [{"confidence": 0.49}, {"confidence": 0.5}], [1]),
        (
            method("M3"),
            [{"confidence": 0.1, "posterior": SURE}, {"confidence": 0.95, "posterior": UNSURE}],
            [2],
        ),
        (method("M3"), [{"confidence": 0.4}, {"confidence": 0.2}, {"posterior": UNSURE}], [2, 3, 1]),
        # Stills would go to objects that the base already shows large.
        (method("M4"), [{"area_share": share} for share in (0.015, 0.0149, 0.001)], [3, 2]),
        # Bytes would be spent on an object that is large, certain and just refined.
        (method("M5"), [SETTLED], []),
        (method("M5", min_score=0), [SETTLED], [1]),
    ],
)
def test_a_method_wants_what_it_says_in_its_order(policy, cars, wanted):
    requests = policy.requests([car(number, **one) for number, one in enumerate(cars, 1)], step())
    assert [one.candidate.track_id for one in requests] == wanted


def test_a_new_object_is_called_so_and_is_no_overdue_one():
    """Summary and recording give the reason, and long-known objects would wait behind each newcomer."""
    (of_m1,), (of_m2,) = (method(name).requests([car(1, **NEW)], step()) for name in ("M1", "M2"))
    assert (of_m1.score, of_m2.reason) == (0, "new")


def test_m0_and_r0_leave_the_whole_budget_to_the_video():
    assert [name for name in METHODS if method(name).video_only] == ["M0", "R0"]


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


@pytest.mark.parametrize(
    ("changes", "doubt", "new"),
    [
        ({"last_sent_ns": NOW_NS - 5 * SECOND}, 0.4, 1 - exp(-1)),
        ({"posterior": ClassPosterior("minivan", 0.5, 1.0)}, 1 - exp(-1), 1),
    ],
)
def test_m5_known_answer(changes, doubt, new):
    """The score would not be the paper's."""
    one = car(confidence=0.6, area_share=0.006, crop_area_px=8000, **changes)
    moment = step(cost=CostEstimate(fixed_bytes=1000, bytes_per_px=0.25, mean_bytes=1500))
    (request,) = method("M5").requests([one], moment)
    assert request.score == pytest.approx((0.5 * doubt + 0.3 * 0.6 + 0.2 * new) / (3000 / 1500))


@given(candidates(), st.integers(0, 24), st.data())
@settings(max_examples=60)
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
    for _ in range(200):  # all of one size: the slope is undetermined
        model.observe(area_px=5_000.0, size_bytes=2_000)
    assert model.estimate().of(car(crop_area_px=5_000)) == pytest.approx(2_000, rel=0.05)


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


@pytest.mark.parametrize(
    ("codec", "expected"), [("jpeg", 1360), ("my-codec", 1360), ("residual", 460), ("h264-intra", 660)]
)
def test_each_codec_starts_at_its_own_cost(codec, expected):
    """The first stills of a session would be held back, or joined, by the price of another codec."""
    line = CostModel.of_codec(codec).estimate()
    assert line.of_px(6_000) == pytest.approx(expected)
    assert line.mean_bytes == pytest.approx({"jpeg": 1500, "my-codec": 1500}.get(codec, line.of_px(7_000)))


def test_registry_names_all_and_is_frozen():
    """A typing error would end in another method than the one asked for."""
    selectors = ["permissive", "conf_size_top1", "strict_small_only", "balanced_top2"]
    assert [*METHODS] == ["M0", "M1", "M2", "M3", "M4", "M5", "M6", "R0", *selectors]
    assert method("m5").name == "M5"
    small = method("M4")
    assert isinstance(small, Small)
    with pytest.raises(FrozenInstanceError):
        small.area_share = 1.0


@pytest.mark.parametrize(
    ("name", "parameters", "words"),
    [
        ("M9", {}, "method 'M9' is not known: choose one of M0, M1,"),
        ("M4", {"every_frames": 3}, "method M4 has no parameter 'every_frames': it has area_share"),
        ("M6", {"weight": 1}, "method M6 has no parameter 'weight'"),
        *(("M4", {"area_share": bad}, "area_share of method M4") for bad in (-1, float("nan"), float("inf"))),
    ],
)
def test_what_a_method_does_not_accept_is_a_sentence(name, parameters, words):
    with pytest.raises(UserError, match=words):
        method(name, **parameters)


def test_tuning_reads_what_a_user_writes():
    """A weight would be ignored, or a slip end in a traceback."""
    assert tuning(["min_gain=0.05, lookahead=2", "min_gain=0.1"]) == {"min_gain": 0.1, "lookahead": 2.0}
    assert tuning([]) == {}
    assert method("M6", **tuning(["min_gain=0.5"])).requests([car()], step()) == []
    for bad in ("min_gain", "min_gain=", "=3", "min gain=3", "min_gain=much", ""):
        with pytest.raises(UserError, match=r"--tune .* is not accepted: write KEY=VALUE"):
            tuning([bad])
