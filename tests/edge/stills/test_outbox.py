"""The whole life of a still: pending, sent, acknowledged, lost, stored, expired."""

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
BOX = (0.0, 0.0, 10.0, 10.0)


def crop(track: int = 1, *also: int, side: int = 10) -> Still:
    shown = tuple(AlsoShown(track_id=one, box_source_px=BOX) for one in also)
    crop_bgr = np.zeros((side, side, 3), np.uint8)
    return replace(still_of(track_id=track, also=shown), crop_bgr=crop_bgr)


def request_of(track: int, score: float, *also: int) -> Request:
    lead, *others = (Candidate(0, one, BOX, BOX, 0, "car", 0.5, 0.1, 100.0, 0) for one in (track, *also))
    return Request(lead, "test", score, tuple(others))


def pending(track: int, utility: float, *also: int, since_ns: int = 0) -> OutboxStill:
    return OutboxStill(crop(track, *also), request_of(track, utility, *also), utility, since_ns)


def tracks(outbox: Outbox) -> list[int]:
    return sorted(one.track_id for one in outbox.pending)


def sent(outbox: Outbox, sequence: int, *, at_ns: int = 0, size: int = 400, resend: int = 0) -> OutboxStill:
    one = pending(100 + sequence, float(sequence), since_ns=at_ns)
    job = crop(100 + sequence, side=resend) if resend else None
    still = still_of(bytes(size), track_id=one.track_id, sequence=sequence)
    outbox.sent(one, still, now_ns=at_ns, resend=job)
    return one


def flown(count: int = 4) -> Outbox:
    outbox = Outbox()
    for sequence in range(count):
        sent(outbox, sequence, at_ns=sequence * 100 * MS)
    return outbox


def overdue(outbox: Outbox, at_s: float) -> list[int]:
    return [one.still.header.sequence for one in outbox.overdue(round(at_s * S))]


def lost(outbox: Outbox) -> list[int]:
    return [one.still.header.sequence for one in outbox.lose()]


def test_the_most_useful_comes_first_and_ties_go_to_the_older():
    """The budget would go to lesser stills, or to others in each run."""
    outbox, order = Outbox(), []
    assert outbox.best() is None
    for track, utility, since_ns in ((3, 0.5, 2), (2, 0.9, 2), (1, 0.9, 1), (0, 0.9, 2)):
        assert outbox.offer(pending(track, utility, since_ns=since_ns)) == []
    while (best := outbox.best()) is not None:
        order.append(best.track_id)
        outbox.give_up(best)
        assert best.state is StillState.EXPIRED
    assert order == [1, 0, 2, 3]


def test_a_newer_still_the_least_useful_and_what_waits_too_long_make_room():
    """An object would be sent as it was, and then as it is; or one busy frame push out the best still."""
    outbox = Outbox(OutboxSettings(max_pending=2, max_pending_ns=10))
    first, second, least = pending(1, 0.9), pending(1, 0.1, since_ns=5), pending(3, 0.05, since_ns=5)
    outbox.offer(first)
    assert outbox.offer(second) == [(first, "replaced")]
    assert (outbox.pending, first.state, second.state) == ((second,), StillState.EXPIRED, StillState.PENDING)
    assert outbox.offer(pending(2, 0.2)) == []
    assert outbox.offer(least) == [(least, "queue_full")]
    ((left, _),) = outbox.offer(pending(4, 0.9, since_ns=4))
    assert (left.track_id, tracks(outbox)) == (1, [2, 4])
    assert outbox.expire(10) == []
    assert [(one.track_id, why) for one, why in outbox.expire(11)] == [(2, "stale")]
    assert [(one.track_id, why) for one, why in outbox.clear()] == [(4, "ended")]
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


def test_what_a_report_names_is_acknowledged_and_an_outage_takes_the_rest_the_most_useful_first():
    """After an outage the edge would store what the ground has, or lose what it has not."""
    assert lost(flown()) == [3, 2, 1, 0]
    outbox = flown()
    assert outbox.on_report(3, (1,), now_ns=S)
    assert not outbox.on_report(3, (1,), now_ns=S), "it is no news"
    assert (outbox.unacknowledged, outbox.sent_bytes) == (1, 400)
    (one,) = outbox.lose()
    assert (one.still.header.sequence, one.state) == (1, StillState.LOST)
    assert (outbox.unacknowledged, outbox.sent_bytes, lost(outbox)) == (0, 0, [])
    outbox.stored(one, one.still)
    assert one.state is StillState.STORED


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


@pytest.mark.parametrize(
    ("report", "overdue_at"),
    [
        ((1, (0,), 1.25, 0.08), {1.25: [2, 0], 2.0: [2, 0]}),  # 3 was sent too shortly before the last report
        ((1, (0,), 1.25, 0.4), {1.25: [0]}),
        ((1, (0,), 1.25, 0.42), {1.25: []}),
        (None, {3.0: []}),  # into an outage, or to a receiver that never reports, each would be sent twice
        ((-1, (), 0.3, 0.08), {3.0: []}),
    ],
)
def test_a_still_is_overdue_when_a_report_ought_to_have_named_it(report, overdue_at):
    """Stills would be sent twice while they are on their way, or not at all; the most useful first."""
    outbox = flown()
    if report is not None:
        named, missing, at_s, round_trip_s = report
        outbox.on_report(named, missing, now_ns=round(at_s * S), round_trip_ns=round(round_trip_s * S))
    assert {at_s: overdue(outbox, at_s) for at_s in overdue_at} == overdue_at


def test_each_is_sent_again_once_and_only_while_it_is_young():
    """A still that cannot get through would take the budget of all others."""
    outbox = flown()
    for at_ms in range(500, 5_000, 500):
        outbox.on_report(-1, (), now_ns=at_ms * MS)
    assert overdue(outbox, 3.9) == [3, 2, 1, 0]
    outbox.sent_again(outbox.overdue(3_900 * MS)[1])
    assert overdue(outbox, 4.1) == [3, 1]
    assert overdue(outbox, 4.5) == []
    again = outbox.overdue(3_900 * MS)[2]
    outbox.on_report(2, (), now_ns=4_500 * MS)
    outbox.sent_again(again)
    assert lost(outbox) == [3], "what never arrived can still be stored, and what has come meanwhile is not"


@pytest.mark.parametrize("reported", [True, False], ids=["acknowledged", "unnamed"])
def test_what_the_ground_cannot_decode_is_pending_once_more_and_only_once(reported):
    """Stills would be sent twice, or none at all."""
    outbox = Outbox()
    one, _ = (sent(outbox, sequence, resend=10) for sequence in (3, 4))
    one.job = one.crop.with_header(parameters={"utility": 0.5})
    if reported:
        outbox.on_report(4, (), now_ns=1)
    for sequence in (4, 3, 4, 99, -1):
        outbox.on_undecodable(sequence)
    assert outbox.offer_undecodable(1) == []
    headers = [one.crop.header for one in outbox.pending]
    assert [one.reason for one in headers] == [AGAIN, AGAIN]
    assert [one.parameters for one in headers] == [{"utility": 0.5, AGAIN: 3}, {AGAIN: 4}], "the method's too"
    assert all(one.again for one in outbox.pending)
    outbox.clear()
    for sequence in (3, 4):
        outbox.on_undecodable(sequence)
    outbox.offer_undecodable(2)
    assert len(outbox) == 0
    assert outbox.crop_bytes == 0
    assert outbox.unacknowledged == (0 if reported else 2)


def test_a_crop_that_is_too_old_or_that_a_newer_one_follows_is_not_coded_again():
    """The operator would get an object as it was long ago, while its present picture waits."""
    outbox = Outbox()
    old, young, followed = (sent(outbox, n, at_ns=min(n, 1) * S, resend=10) for n in range(3))
    outbox.on_report(2, (), now_ns=S)
    outbox.offer(pending(102, 0.5))
    for sequence in range(3):
        outbox.on_undecodable(sequence)
    outbox.offer_undecodable(5 * S)
    assert [(one.track_id, one.again) for one in outbox.pending] == [(102, False), (101, True)]
    assert {old.state, young.state, followed.state} == {StillState.EXPIRED}


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
        list(threads.map(lambda work: [work(index) for index in range(800)], works))
    outbox.lose()
    assert outbox.sent_bytes == 0
