"""M6: the expected gain a byte, term by term."""

from dataclasses import replace
from math import exp

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_edge.perception.candidates import BaseLoss, Candidate, ClassPosterior
from hvt_edge.stills.policy.base import CostEstimate, Step
from hvt_edge.stills.policy.m6 import ExpectedGain
from hvt_edge.stills.policy.registry import METHODS, method
from rigs.examples import candidate, decision_step

NOW = 20_000_000_000
M6 = ExpectedGain()


def step(**changes) -> Step:
    plain = {"cost": CostEstimate(500, 0, 500), "still_overhead_bytes": 180}
    return decision_step(**(plain | changes))


def car(track_id: int = 1, *, lost: float = 0.5, sharp: float = 500.0, **changes) -> Candidate:
    box = (100.0, 100.0, 132.0, 132.0)
    plain = {"box_source_px": (200, 200, 264, 264), "area_share": 0.001, "loss": lambda: BaseLoss(28.0, lost)}
    return candidate(track_id, box, **(plain | {"sharpness": lambda: sharp} | changes))


def sent(one: Candidate, *, seconds: float, **changes) -> Candidate:
    plain = {"sent_count": 1, "last_sent_ns": round(NOW - seconds * 1e9), "last_sent_area_px": one.area_px}
    return replace(one, **(plain | {"posterior": ClassPosterior("car", 0.95, 0.1)} | changes))


def test_known_answer():
    """The score would not be what the documentation says."""
    (request,) = M6.requests([car()], step())
    wrong = 1 / (1 + exp(-(0.5 - 6.0 * 0.6 + 2.3 * 0.5)))
    use = 64 / 68 * 500 / 520
    assert request.score == pytest.approx(1000 * wrong * use / 680)
    assert request.reason == "gain"
    (unseen,) = M6.requests([car()], step(from_source=True))
    wrong = 1 / (1 + exp(-(0.5 - 6.0 * 0.6 + 6.5 * 0.5)))
    assert unseen.score == pytest.approx(1000 * wrong * use * (1 - exp(-0.6 / 0.22)) / 680)


def test_details_count_where_they_are_wanted():
    """A code on a roof would stay unread: the class of its vehicle is certain, so no still of it is worth a bit."""
    van = car(box_source_px=(200, 200, 296, 248), confidence=0.97, lost=0.9)
    reads = ExpectedGain(detail_weight=0.5)
    plain, wanted = M6.gain(van, step()), reads.gain(van, step())
    area = 96 * 48
    assert wanted - plain == pytest.approx(0.5 * 0.9 * area / (area + 48**2) * M6.use(van, from_source=False))
    assert reads.requests([van], step())[0].score > 3 * M6.requests([van], step())[0].score
    # The base shows it all, or a still has just done so: nothing is to be gained.
    assert reads.gain(replace(van, loss=lambda: BaseLoss(40.0, 0.0)), step()) < 0.02
    assert reads.gain(sent(van, seconds=1.0), step()) < 0.25 * wanted
    # More pixels on target, more to read.
    small = replace(van, box_source_px=(200, 200, 216, 208))
    assert reads.hidden_detail(small) < 0.1 * reads.hidden_detail(van)


def test_an_object_that_the_base_does_not_show_comes_first():
    """What only the edge sees would stay unseen at the ground."""
    invisible, visible = car(1, lost=0.97, confidence=0.7), car(2, lost=0.1, confidence=0.7)
    for source in (False, True):
        wanted = M6.requests([visible, invisible], step(from_source=source))
        assert wanted[0].candidate.track_id == 1
    gains = [M6.gain(one, step(from_source=True)) for one in (invisible, visible)]
    assert gains[0] > 0.8
    assert gains[1] < 0.05


@given(
    lost=st.floats(0, 1),
    confidence=st.floats(0.1, 1),
    area=st.floats(0, 1),
    covered=st.floats(0, 1),
    source=st.booleans(),
    since=st.floats(0, 200),
)
def test_gain_is_a_chance_and_monotone_in_every_term(lost, confidence, area, covered, source, since):
    """More loss, more doubt, a better view or a longer silence would make an object less wanted."""
    moment = step(from_source=source)
    one = car(lost=lost, confidence=confidence, covered_share=covered)
    gain = M6.gain(one, moment)
    assert 0 <= gain <= 1
    slack = 1e-12
    more = [{"loss": lambda: BaseLoss(28.0, min(1, lost + 0.1))}, {"covered_share": covered * area}]
    if not source:  # there, a detection that is unsure on the source itself will not be sure on its still
        more.append({"confidence": confidence * 0.9})
    assert all(M6.gain(replace(one, **changes), moment) >= gain - slack for changes in more)
    for changes in ({"touches_border": True}, {"sharpness": lambda: 20.0}):
        assert M6.gain(replace(one, **changes), moment) <= gain + slack
    known = sent(one, seconds=since)
    assert M6.gain(known, moment) <= max(gain, M6.again) + slack
    if gain > 0.1:
        assert M6.gain(known, moment) <= M6.gain(sent(one, seconds=since + 20), moment) + slack
    doubtful = replace(known, posterior=ClassPosterior("car", 0.3, 3.0))
    assert M6.gain(doubtful, moment) >= M6.gain(known, moment) - slack


def test_the_ground_s_answer_decides_whether_another_still_is_worth_it():
    """The same settled cars would be sent again and again, or one that the ground could not name never again."""
    one = car(lost=0.8)
    assert M6.requests([sent(one, seconds=2)], step()) == []
    unsure = sent(one, seconds=2, posterior=ClassPosterior("car", 0.2, 3.0))
    assert M6.gain(unsure, step()) > 3 * M6.gain(sent(one, seconds=2), step())
    odd, even = (
        sent(one, seconds=2, posterior=ClassPosterior(name, 0.95, 0.1)) for name in ("bus", "minivan")
    )
    assert M6.gain(odd, step()) > M6.gain(even, step())
    moving = sent(replace(one, class_name="moving"), seconds=2)
    assert M6.gain(moving, step()) == M6.gain(sent(one, seconds=2), step())
    whole = replace(unsure, last_sent_at_border=True)
    nearer = replace(unsure, last_sent_area_px=unsure.area_px / 4)
    assert M6.gain(whole, step()) == M6.gain(nearer, step()) > 5 * M6.gain(unsure, step())


def test_a_byte_has_to_earn_its_gain():
    """Large crops would take the room of many small ones that help as much."""
    cost = CostEstimate(100, 0.1, 500)
    large, small = car(1, crop_area_px=40_000), car(2, crop_area_px=2_000)
    wanted = M6.requests([large, small], step(cost=cost))
    assert [one.candidate.track_id for one in wanted] == [2, 1]
    assert wanted[0].score / wanted[1].score == pytest.approx((100 + 4000 + 180) / (100 + 200 + 180))


def test_it_asks_for_some_more_than_fits_and_always_for_the_best():
    """Neighbours would find nobody to share with, or a needed still would never wait for its room."""
    some = [car(number, confidence=0.1 * number) for number in range(1, 7)]
    for room, count in ((0, 1), (226, 1), (680, 3), (1e9, 6)):
        wanted = M6.requests(some, step(allowance_bytes=room))
        assert [one.candidate.track_id for one in wanted] == list(range(1, count + 1))


def test_settled_and_well_shown_objects_are_left_alone_and_their_pixels_unread():
    """Every step would measure the sharpness of every track, for nothing."""
    asked = []
    clear = car(lost=0.05, confidence=0.95, sharpness=lambda: asked.append(1) or 500.0)
    assert M6.requests([clear], step()) == []
    assert asked == []


def test_any_weight_a_user_may_give_is_survived():
    """A slip of the keyboard would end the flight in an overflow."""
    for name, default in METHODS["M6"].parameters.items():
        assert isinstance(default, float)
        for value in (0.0, 1.0, 1e300):
            policy = method("M6", **{name: value})
            assert isinstance(policy, ExpectedGain)
            for one in (car(), sent(car(), seconds=1), car(loss=None, sharpness=None)):
                assert 0 <= policy.gain(one, step()) <= 1 + min(1000.0, policy.detail_weight)
                policy.requests([one], step())
