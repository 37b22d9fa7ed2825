"""Stills that wait for room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Still
from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.crop_job import CropJob
from hvt_edge.stills.outbox import PendingStill, QueueSettings, StillQueue
from hvt_edge.stills.policy.base import Request

DRAFT = Still(0, 0, 0, 1, (0, 0, 4, 4), (0, 0, 4, 4), "car", 0.5, "test", "jpeg", 65, b"")
CUT = CropJob(DRAFT, np.zeros((4, 4, 3), np.uint8), None, None)


def wish(track: int, score: float, *, since_ns: int = 0) -> PendingStill:
    """A wish for a still."""
    candidate = Candidate(
        frame_index=0,
        track_id=track,
        box_base_px=(0, 0, 4, 4),
        box_source_px=(0, 0, 4, 4),
        class_id=0,
        class_name="car",
        confidence=0.5,
        area_share=0.1,
        crop_area_px=16,
        born_frame=0,
    )
    return PendingStill(Request(candidate, "test", score), CUT, since_ns)


def shared(lead: PendingStill, *others: PendingStill) -> PendingStill:
    """One still for several."""
    header = replace(
        lead.cut.header, also=tuple((one.track_id, one.request.candidate.box_source_px) for one in others)
    )
    request = replace(lead.request, also=tuple(one.request.candidate for one in others))
    return replace(lead, request=request, cut=replace(lead.cut, header=header))


def tracks(queue: StillQueue) -> list[int]:
    """Ids in the queue, in order."""
    return sorted(one.request.candidate.track_id for one in queue)


def test_the_most_useful_comes_first_and_ties_go_to_the_older():
    """The budget would go to lesser stills, or to others in each run."""
    queue = StillQueue()
    assert queue.best() is None
    for one in (
        wish(3, 0.5, since_ns=2),
        wish(2, 0.9, since_ns=2),
        wish(1, 0.9, since_ns=1),
        wish(0, 0.9, since_ns=2),
    ):
        assert queue.offer(one) == []
    order = []
    while (best := queue.best()) is not None:
        order.append(best.request.candidate.track_id)
        queue.remove(best)
    assert order == [1, 0, 2, 3]


def test_a_newer_wish_of_a_track_takes_the_place_of_the_older():
    """The operator would get the object as it was, and then once more as it is."""
    queue = StillQueue()
    first, second = wish(1, 0.9), wish(1, 0.1, since_ns=5)
    queue.offer(first)
    assert queue.offer(second) == [(first, "replaced")]
    assert list(queue) == [second]


def test_the_least_useful_leaves_a_full_queue():
    """One busy frame would push the best still out, or fill the memory with source frames."""
    queue = StillQueue(QueueSettings(max_length=2))
    queue.offer(wish(1, 0.5))
    queue.offer(wish(2, 0.2))
    least = wish(3, 0.1)
    assert queue.offer(least) == [(least, "queue_full")]
    (left,) = queue.offer(wish(4, 0.9))
    assert left[0].request.candidate.track_id == 2
    assert tracks(queue) == [1, 4]


def test_what_waited_too_long_leaves():
    """A still of a past that nobody looks at any more would cost its bits."""
    queue = StillQueue(QueueSettings(max_age_ns=10))
    old, young = wish(1, 0.9, since_ns=0), wish(2, 0.1, since_ns=5)
    queue.offer(old)
    queue.offer(young)
    assert queue.expire(10) == []
    assert queue.expire(11) == [(old, "stale")]
    assert tracks(queue) == [2]
    assert queue.clear() == [young]
    assert len(queue) == 0


def test_a_shared_wish_keeps_every_track_to_one_wish():
    """A track would be sent twice, in its own still and in its neighbour's."""
    queue = StillQueue()
    pair = shared(wish(1, 0.9), wish(2, 0.4), wish(3, 0.4))
    assert queue.offer(pair) == []
    assert 3 in queue
    alone = wish(2, 0.5, since_ns=5)
    assert queue.offer(alone) == [], "it only gets off the shared one"
    (kept,) = (one for one in queue if one.track_id == 1)
    assert kept.track_ids == {1, 3}
    assert [track for track, _ in kept.cut.header.also] == [3]
    other = shared(wish(4, 0.2), wish(1, 0.2), wish(3, 0.2))
    assert [(gone.track_id, why) for gone, why in queue.offer(other)] == [(1, "replaced")]
    assert sorted(map(tuple, (sorted(one.track_ids) for one in queue))) == [(1, 3, 4), (2,)]


def test_only_what_would_stay_is_worth_the_cutting():
    """Crops would be taken out of frames for wishes that leave at once, or wishes refused that would have stayed."""
    queue = StillQueue(QueueSettings(max_length=2))
    for one in (wish(1, 0.5), wish(2, 0.3)):
        assert queue.admits(one.request, now_ns=0)
        queue.offer(one)
    for score, track, stays in ((0.2, 3, False), (0.3, 3, False), (0.31, 3, True), (0.1, 2, True)):
        asked = wish(track, score)
        assert queue.admits(asked.request, now_ns=0) == stays
    assert queue.offer(wish(3, 0.31))[0][0].track_id == 2


@given(
    st.lists(st.tuples(st.integers(0, 12), st.floats(0, 1), st.integers(0, 3)), max_size=80),
    st.integers(1, 5),
    st.integers(0, 20),
)
def test_every_wish_leaves_exactly_once(offers, length, age):
    """The ledger would say of a candidate that it was sent and dropped, or nothing at all."""
    queue = StillQueue(QueueSettings(max_length=length, max_age_ns=age))
    offered, left, now = [], [], 0
    for track, score, action in offers:
        now += 3
        one = wish(track, score, since_ns=now)
        offered.append(one)
        left += [gone for gone, _ in queue.offer(one)]
        assert len(queue) <= length
        assert len(set(tracks(queue))) == len(queue)
        if action == 1:
            left += [gone for gone, _ in queue.expire(now)]
        if action == 2 and (best := queue.best()) is not None:
            assert best.request.score == max(each.request.score for each in queue)
            queue.remove(best)
            left.append(best)
    left += queue.clear()
    assert sorted(map(id, left)) == sorted(map(id, offered))
