"""The whole life of a still: pending, sent, acknowledged, lost, stored, expired."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.protocol.messages import AlsoShown
from hvt_edge.backlog.entry import FIRST_STORED
from hvt_edge.link.stills import Still
from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.outbox import AGAIN, Outbox, OutboxSettings, OutboxStill, StillState
from hvt_edge.stills.policy.base import Request
from rigs.messages import still_of

MS, S = 1_000_000, 1_000_000_000
RTT = 80 * MS
BOX = (0.0, 0.0, 10.0, 10.0)


def crop(track: int = 1, *also: int, side: int = 10) -> Still:
    """A crop of ``3 * side * side`` bytes."""
    shown = tuple(AlsoShown(track_id=one, box_source_px=BOX) for one in also)
    crop_bgr = np.zeros((side, side, 3), np.uint8)
    return replace(still_of(track_id=track, also=shown), crop_bgr=crop_bgr)


def request_of(track: int, score: float, *also: int) -> Request:
    """Of one candidate, or of several."""
    lead, *others = (Candidate(0, one, BOX, BOX, 0, "car", 0.5, 0.1, 100.0, 0) for one in (track, *also))
    return Request(lead, "test", score, tuple(others))


def pending(track: int, utility: float, *also: int, since_ns: int = 0) -> OutboxStill:
    """One that waits."""
    return OutboxStill(crop(track, *also), request_of(track, utility, *also), utility, since_ns)


def tracks(outbox: Outbox) -> list[int]:
    """Ids of the tracks that lead, in order."""
    return sorted(one.track_id for one in outbox.pending)


def sent(outbox: Outbox, sequence: int, *, at_ns: int = 0, size: int = 400, resend: int = 0) -> OutboxStill:
    """One that goes out, of a track and a utility of its own; ``resend``: the side of its crop."""
    one = pending(100 + sequence, float(sequence), since_ns=at_ns)
    job = crop(100 + sequence, side=resend) if resend else None
    still = still_of(bytes(size), track_id=one.track_id, sequence=sequence)
    outbox.sent(one, still, now_ns=at_ns, resend=job)
    return one


def flown(count: int = 4) -> Outbox:
    """So many sent, 100 ms apart; the utility of a still is its number."""
    outbox = Outbox()
    for sequence in range(count):
        sent(outbox, sequence, at_ns=sequence * 100 * MS)
    return outbox


def overdue(outbox: Outbox, at_s: float) -> list[int]:
    """The sequences that are to be sent again."""
    return [one.still.header.sequence for one in outbox.overdue(round(at_s * S))]


def lost(outbox: Outbox) -> list[int]:
    """What an outage takes, by sequence."""
    return [one.still.header.sequence for one in outbox.lose()]


# Pending


def test_the_most_useful_comes_first_and_ties_go_to_the_older():
    """The budget would go to lesser stills, or to others in each run."""
    outbox = Outbox()
    assert outbox.best() is None
    for one in (
        pending(3, 0.5, since_ns=2),
        pending(2, 0.9, since_ns=2),
        pending(1, 0.9, since_ns=1),
        pending(0, 0.9, since_ns=2),
    ):
        assert outbox.offer(one) == []
    order = []
    while (best := outbox.best()) is not None:
        order.append(best.track_id)
        outbox.give_up(best)
        assert best.state is StillState.EXPIRED
    assert order == [1, 0, 2, 3]


def test_a_newer_still_of_a_track_takes_the_place_of_the_older():
    """The operator would get the object as it was, and then once more as it is."""
    outbox = Outbox()
    first, second = pending(1, 0.9), pending(1, 0.1, since_ns=5)
    outbox.offer(first)
    assert outbox.offer(second) == [(first, "replaced")]
    assert outbox.pending == (second,)
    assert (first.state, second.state) == (StillState.EXPIRED, StillState.PENDING)


def test_the_least_useful_leaves_a_full_outbox():
    """One busy frame would push the best still out, or fill the memory with source frames."""
    outbox = Outbox(OutboxSettings(max_pending=2))
    outbox.offer(pending(1, 0.5))
    outbox.offer(pending(2, 0.2))
    least = pending(3, 0.1)
    assert outbox.offer(least) == [(least, "queue_full")]
    (left,) = outbox.offer(pending(4, 0.9))
    assert left[0].track_id == 2
    assert tracks(outbox) == [1, 4]


def test_what_was_pending_for_too_long_leaves():
    """A still of a past that nobody looks at any more would cost its bits."""
    outbox = Outbox(OutboxSettings(max_pending_ns=10))
    old, young = pending(1, 0.9, since_ns=0), pending(2, 0.1, since_ns=5)
    outbox.offer(old)
    outbox.offer(young)
    assert outbox.expire(10) == []
    assert outbox.expire(11) == [(old, "stale")]
    assert tracks(outbox) == [2]
    assert outbox.clear() == [(young, "ended")]
    assert len(outbox) == 0


def test_a_still_of_several_keeps_every_track_to_one_still():
    """A track would be sent twice, in its own still and in its neighbour's."""
    outbox = Outbox()
    assert outbox.offer(pending(1, 0.9, 2, 3)) == []
    assert 3 in outbox
    assert outbox.offer(pending(2, 0.5, since_ns=5)) == [], "it is only taken off the shared one"
    (shared,) = (one for one in outbox.pending if one.track_id == 1)
    assert shared.track_ids == {1, 3}
    assert [one.track_id for one in shared.request.also] == [3]
    left = outbox.offer(pending(4, 0.2, 1, 3))
    assert [(gone.track_id, why) for gone, why in left] == [(1, "replaced")]
    assert sorted(tuple(sorted(one.track_ids)) for one in outbox.pending) == [(1, 3, 4), (2,)]


def test_only_what_would_stay_is_worth_a_crop():
    """Crops would be taken for requests that leave at once, or requests refused that would have stayed."""
    outbox = Outbox(OutboxSettings(max_pending=2))
    for one in (pending(1, 0.5), pending(2, 0.3)):
        assert outbox.admits(one.request, now_ns=0)
        outbox.offer(one)
    for score, track, stays in ((0.2, 3, False), (0.3, 3, False), (0.31, 3, True), (0.1, 2, True)):
        assert outbox.admits(request_of(track, score), now_ns=0) == stays
    assert outbox.offer(pending(3, 0.31))[0][0].track_id == 2


def test_what_grounds_request_waits_in_its_own_queue_in_order():
    """A busy scene would push out what the operator waits for; or it would wait for ever."""
    outbox = Outbox(OutboxSettings(max_pending=1))
    first, second = (OutboxStill(crop(-1), None, float("inf"), None) for _ in range(2))
    outbox.offer_on_demand(first)
    outbox.offer_on_demand(second)
    other = pending(1, 9.0)
    outbox.offer(other)
    assert (outbox.on_demand, outbox.on_demand_pending, len(outbox)) == (first, 2, 1)
    assert outbox.expire_on_demand(5 * S) == [], "their own time begins when they are met"
    assert outbox.expire(5 * S) == [(other, "stale")]
    outbox.sent(first, still_of(b"x"), now_ns=6 * S)
    assert outbox.on_demand is second
    assert outbox.expire_on_demand(16 * S) == [(second, "stale")]
    assert not outbox.any_pending


@given(
    st.lists(st.tuples(st.integers(0, 12), st.floats(0, 1), st.integers(0, 3)), max_size=80),
    st.integers(1, 5),
    st.integers(0, 20),
)
def test_every_pending_still_leaves_exactly_once(offers, length, age):
    """The ledger would say of a candidate that it was sent and dropped, or nothing at all."""
    outbox = Outbox(OutboxSettings(max_pending=length, max_pending_ns=age))
    offered, left, now = [], [], 0
    for track, score, action in offers:
        now += 3
        one = pending(track, score, since_ns=now)
        offered.append(one)
        left += [gone for gone, _ in outbox.offer(one)]
        assert len(outbox) <= length
        assert len(set(tracks(outbox))) == len(outbox)
        if action == 1:
            left += [gone for gone, _ in outbox.expire(now)]
        if action == 2 and (best := outbox.best()) is not None:
            assert best.utility == max(each.utility for each in outbox.pending)
            outbox.give_up(best)
            left.append(best)
    left += [gone for gone, _ in outbox.clear()]
    assert sorted(map(id, left)) == sorted(map(id, offered))
    assert {one.state for one in left} <= {StillState.EXPIRED}


# Sent, and what reports say of it


def test_what_a_report_names_is_acknowledged_and_what_is_missing_is_not():
    """After an outage the edge would store what the ground has, or lose what it has not."""
    outbox = flown()
    assert outbox.on_report(3, (1,), now_ns=S)
    assert not outbox.on_report(3, (1,), now_ns=S), "it is no news"
    assert (outbox.unacknowledged, outbox.sent_bytes) == (1, 400)
    (one,) = outbox.lose()
    assert (one.still.header.sequence, one.state) == (1, StillState.LOST)
    assert (outbox.unacknowledged, outbox.sent_bytes, lost(outbox)) == (0, 0, [])
    outbox.stored(one, one.still)
    assert one.state is StillState.STORED


def test_an_outage_takes_the_most_useful_first():
    """The store would keep the least useful."""
    assert lost(flown()) == [3, 2, 1, 0]


def test_numbers_of_stored_stills_leave_no_hole_in_those_that_are_sent():
    """The ground would ask for numbers that never come."""
    outbox = Outbox()
    one = pending(1, 1.0)
    outbox.stored(one, still_of(b"x", sequence=outbox.sequence(store=True)))
    assert (outbox.sequence(store=True), outbox.sequence(store=False)) == (FIRST_STORED + 1, 0)
    outbox.stored(sent(outbox, 0), still_of())
    assert (outbox.sequence(store=True), outbox.sequence(store=False)) == (FIRST_STORED + 1, 1)


def test_memory_is_bounded_and_the_oldest_leaves_first():
    """A ground that never reports would let the edge grow for the whole flight."""
    outbox = Outbox(OutboxSettings(max_sent=5, max_sent_bytes=1_500))
    stills = [sent(outbox, sequence, at_ns=sequence * 10 * MS) for sequence in range(60)]
    assert outbox.sent_bytes <= 1_500
    assert lost(outbox) == [59, 58, 57]
    assert {one.state for one in stills[:57]} == {StillState.EXPIRED}


def test_in_lockstep_no_report_decides_anything():
    """The same input would give other stills, depending on when a report came."""
    outbox = Outbox(reports=False)
    sent(outbox, 0)
    assert not outbox.on_report(0, (), now_ns=S)
    assert (outbox.unacknowledged, outbox.overdue(2 * S), outbox.lose()) == (0, [], [])


# What is sent again


def test_a_still_is_overdue_when_a_report_ought_to_have_named_it():
    """Stills would be sent twice while they are on their way, or not at all; the most useful first."""
    for round_trip_ns, expected in ((RTT, [2, 0]), (400 * MS, [0]), (420 * MS, [])):
        outbox = flown()
        outbox.on_report(1, (0,), now_ns=1_250 * MS, round_trip_ns=round_trip_ns)
        assert overdue(outbox, 1.25) == expected
        if round_trip_ns == RTT:
            assert overdue(outbox, 2.0) == [2, 0], "3 was sent too shortly before the last report"


def test_in_silence_nothing_is_overdue():
    """Into an outage, or to a receiver that never reports, every still would be sent twice."""
    outbox = flown()
    assert overdue(outbox, 3.0) == []
    outbox.on_report(-1, (), now_ns=300 * MS)
    assert overdue(outbox, 3.0) == []


def test_each_is_sent_again_once_and_only_while_it_is_young():
    """A still that cannot get through would take the budget of all others."""
    outbox = flown()
    for at_ms in range(500, 5_000, 500):
        outbox.on_report(-1, (), now_ns=at_ms * MS)
    assert overdue(outbox, 3.9) == [3, 2, 1, 0]
    outbox.sent_again(outbox.overdue(3_900 * MS)[1])
    assert overdue(outbox, 4.1) == [3, 1]
    assert overdue(outbox, 4.5) == []
    assert lost(outbox) == [3, 2, 1, 0], "what never arrived can still be stored"


def test_a_second_copy_of_what_has_arrived_meanwhile_is_not_kept():
    """It would be stored, and shown once more, after the next outage."""
    outbox = flown()
    outbox.on_report(-1, (), now_ns=2 * S)
    again = outbox.overdue(2 * S)
    outbox.on_report(3, (), now_ns=2 * S)
    outbox.sent_again(again[0])
    assert lost(outbox) == []


# What the ground cannot decode


@pytest.mark.parametrize("reported", [True, False], ids=["acknowledged", "unnamed"])
def test_what_the_ground_cannot_decode_is_pending_once_more_and_only_once(reported):
    """Stills would be sent twice, or none at all."""
    outbox = Outbox()
    for sequence in (3, 4):
        sent(outbox, sequence, resend=10)
    if reported:
        outbox.on_report(4, (), now_ns=1)
    for sequence in (4, 3, 4, 99, -1):
        outbox.on_undecodable(sequence)
    assert outbox.offer_undecodable(1) == []
    headers = [one.crop.header for one in outbox.pending]
    assert [(one.reason, one.parameters) for one in headers] == [(AGAIN, {AGAIN: 3}), (AGAIN, {AGAIN: 4})]
    assert all(one.again for one in outbox.pending)
    outbox.clear()
    for sequence in (3, 4):
        outbox.on_undecodable(sequence)
    outbox.offer_undecodable(2)
    assert len(outbox) == 0
    assert outbox.crop_bytes == 0
    assert outbox.unacknowledged == (0 if reported else 2)


def test_a_still_that_is_coded_again_keeps_the_parameters_of_its_method():
    """The ground would not know any more by what the method chose it."""
    outbox = Outbox()
    one = sent(outbox, 3, resend=10)
    assert one.job is not None
    one.job = one.job.with_header(parameters={"utility": 0.5})
    outbox.on_undecodable(3)
    outbox.offer_undecodable(1)
    assert [again.crop.header.parameters for again in outbox.pending] == [{"utility": 0.5, AGAIN: 3}]


def test_a_newer_still_of_the_track_makes_it_needless():
    """Bits would go to the object as it was, while its present picture waits."""
    outbox = Outbox()
    sent(outbox, 0, resend=10)
    outbox.offer(pending(100, 0.5))
    outbox.on_undecodable(0)
    assert outbox.offer_undecodable(1) == []
    assert not any(one.again for one in outbox.pending)


def test_a_crop_that_is_too_old_is_forgotten():
    """The operator would get an object as it was long ago."""
    outbox = Outbox()
    old, young = sent(outbox, 0, resend=10), sent(outbox, 1, at_ns=S, resend=10)
    outbox.on_report(1, (), now_ns=S)
    outbox.on_undecodable(0)
    outbox.on_undecodable(1)
    outbox.offer_undecodable(5 * S)
    assert tracks(outbox) == [101]
    assert (old.state, young.state) == (StillState.EXPIRED, StillState.EXPIRED)


@given(
    st.lists(st.tuples(st.integers(1, 40), st.lists(st.integers(-3, 80), max_size=30)), max_size=60),
    st.integers(1, 8),
    st.integers(300, 9_000),
    st.booleans(),
)
def test_whatever_grounds_request_the_memory_is_bounded(stills, count, size_bytes, reports):
    """A hostile or broken ground would fill the drone's memory, or crash the edge."""
    settings = OutboxSettings(max_sent=count, max_crop_bytes=size_bytes, max_sent_ns=5)
    outbox = Outbox(settings, reports=reports)
    again: list[int] = []
    for sequence, (side, undecodable) in enumerate(stills):
        sent(outbox, sequence, at_ns=sequence, resend=side)
        for one in undecodable:
            outbox.on_undecodable(one)
        assert outbox.crop_bytes <= size_bytes
        assert outbox.unacknowledged <= count
        if sequence % 3 == 0:
            outbox.offer_undecodable(sequence)
            again += [one.crop.header.parameters[AGAIN] for one in outbox.pending]
            outbox.clear()
    assert len(set(again)) == len(again)


def test_stills_thread_and_link_may_act_at_once():
    """The edge would crash in flight, once in a thousand."""
    outbox = Outbox(OutboxSettings(max_sent=8))

    def run(work) -> None:
        for index in range(800):
            work(index)

    works = (
        lambda index: sent(outbox, index, at_ns=index * MS, size=10, resend=4),
        lambda index: outbox.on_report(index - 5, (), now_ns=index * MS),
        lambda index: outbox.on_undecodable(index - 3),
        lambda index: outbox.overdue(index * MS),
        lambda index: outbox.lose() if index % 50 == 0 else None,
        lambda index: outbox.offer_on_demand(OutboxStill(crop(-1), None, 1.0, None)),
        lambda index: outbox.expire(index * S),
        lambda index: outbox.expire_on_demand(index * S),
    )
    with ThreadPoolExecutor(len(works)) as threads:
        list(threads.map(run, works))
    outbox.lose()
    assert outbox.sent_bytes == 0
