"""When the link is away, and which frames it took with it."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from hvt_common.values import AccessUnit
from hvt_edge.backlog.stage import Outage
from hvt_edge.link.pacer import BaseInFlight

S = 1_000_000_000


def states(outage: Outage, *, first: float, last: float, linked: bool, reports: float = 0) -> list[bool]:
    """Asked fifteen times a second; a ground reports each ``reports`` seconds."""
    answers, next_report = [], first
    for index in range(round(first * 15), round(last * 15)):
        now = index / 15
        if reports and now >= next_report:
            outage.reported(round(now * S))
            next_report += reports
        answers.append(outage.offline(round(now * S), linked=linked))
    return answers


def test_a_clip_that_nobody_has_heard_yet_is_not_kept():
    """Each run of a clip without a ground would fill the disk."""
    assert not any(states(Outage(live=False), first=0, last=30, linked=False))


def test_a_camera_is_kept_from_its_first_frame():
    """What a drone saw before the ground was switched on would be lost."""
    assert all(states(Outage(live=True), first=0, last=5, linked=False))


def test_a_ground_that_falls_silent_is_noticed_long_before_zenoh_does():
    """Seconds of the flight would go into a dead connection."""
    outage = Outage(live=False)
    assert not any(states(outage, first=0, last=10, linked=True, reports=0.5))
    after = states(outage, first=10, last=14, linked=True)
    assert 1.0 <= after.index(True) / 15 <= 1.6
    assert all(after[after.index(True) :])
    assert not any(states(outage, first=14, last=16, linked=True, reports=0.5)), "one report ends it"


def test_a_link_that_passes_small_messages_alone_is_an_outage():
    """In a black hole of large packets, or on a line of one direction, the flight was neither seen nor kept."""
    outage = Outage(live=False)
    for named in range(20):
        outage.reported(named * S // 2, named=named, sent=named + 2)
        assert not outage.offline(named * S // 2, linked=True)
    away = []
    for number in range(20, 60):
        outage.reported(number * S // 2, named=19, sent=number)
        away.append(outage.offline(number * S // 2, linked=True))
    assert away == [False] * 10 + [True] * 30
    outage.reported(30 * S, named=50, sent=60)
    assert not outage.offline(30 * S, linked=True), "one that came ends it"
    outage.reported(40 * S, named=60, sent=60)
    assert not outage.offline(40 * S, linked=True), "a camera that gives nothing has no news"


def test_a_pause_of_the_camera_is_no_outage_whatever_was_lost_before_it():
    """After a pause the first frames would be stored, not seen: the last one before it was lost."""
    outage = Outage(live=True)
    for number in range(60):
        sent = number if number < 20 or number > 40 else 20
        outage.reported(number * S // 2, named=min(sent, 19) if number < 41 else sent, sent=sent)
        assert not outage.offline(number * S // 2, linked=True)


@pytest.mark.parametrize("each_s", [1, 3, 5, 8, 10])
def test_few_frames_are_no_pause(each_s):
    """At a frame in 8 s an outage of the video was noticed after 18 s."""
    outage = Outage(live=True)
    for number in range(160):
        if number % (2 * each_s) == 0 and outage.offline(number * S // 2, linked=True):
            break
        sent = number // (2 * each_s)
        outage.reported(number * S // 2, named=min(sent, 3), sent=sent)
    assert number // 2 - 4 * each_s == next(late for late in range(each_s, 100, each_s) if late >= 5)


def test_a_ground_without_video_hides_no_outage_of_the_one_that_has_it():
    """A program that takes tracks alone would keep an edge sending into a dead link, and nothing would be stored."""
    outage, away = Outage(live=True), []
    for number in range(40):
        outage.reported(number * S // 2, named=min(number, 19), sent=number)
        outage.reported(number * S // 2, sent=number)
        away.append(outage.offline(number * S // 2, linked=True))
    assert away == [False] * 30 + [True] * 10
    alone = Outage(live=True)
    assert not any(states(alone, first=0, last=30, linked=True, reports=0.5)), "alone it has no outage"


def test_a_ground_with_video_that_leaves_is_no_outage_for_a_program_that_stays():
    """The program would get no still for 13 s."""
    outage = Outage(live=True)
    for number in range(80):
        if number < 20:
            outage.reported(number * S // 2, named=number, sent=number)
        outage.reported(number * S // 2, sent=number)
        assert not any(outage.offline(number * S // 2 + late, linked=True) for late in (0, S // 3))


def test_a_ground_that_is_gone_is_an_outage_and_its_return_ends_it():
    """Keeping would go on with somebody there, or not begin."""
    outage = Outage(live=False)
    states(outage, first=0, last=3, linked=True, reports=0.5)
    assert all(states(outage, first=3, last=20, linked=False))
    # Back, and not heard of yet: the silence of before is not held against it.
    assert not any(states(outage, first=20, last=30, linked=True))


def test_who_listens_and_never_reports_gets_everything():
    """Another program that shows the video would get a frame a second."""
    assert not any(states(Outage(live=True), first=0, last=30, linked=True))


def test_a_ground_that_left_does_not_keep_the_others_from_seeing():
    """After 15 s of silence on a living link it was the ground that went."""
    outage = Outage(live=False)
    states(outage, first=0, last=3, linked=True, reports=0.5)
    after = states(outage, first=3, last=30, linked=True)
    assert after[-1] is False
    assert 13 <= sum(after) / 15 <= 14.5


def unit(index: int, size: int = 1_000) -> AccessUnit:
    """An access unit."""
    return AccessUnit(index, index * S // 15, bytes(size), keyframe=index == 0)


def flown(count: int, *, each_ns: int = S // 10, **bounds: int) -> BaseInFlight:
    """So many access units sent."""
    in_flight = BaseInFlight(**bounds)
    for index in range(count):
        in_flight.sent(index, unit(index), now_ns=index * each_ns)
    return in_flight


def lost(in_flight: BaseInFlight) -> list[int]:
    """What an outage takes."""
    return [one.frame_index for one in in_flight.take()]


def test_frames_that_no_report_has_named_are_taken_in_order():
    """The store would hold a video that cannot be decoded, or what the ground has."""
    in_flight = flown(4)
    assert in_flight.on_report(1)
    assert not in_flight.on_report(1), "it is no news"
    assert (len(in_flight), in_flight.size_bytes) == (2, 2_000)
    assert lost(in_flight) == [2, 3]
    assert (len(in_flight), in_flight.size_bytes, lost(in_flight)) == (0, 0, [])


def test_frames_in_flight_are_bounded_in_bytes_and_age():
    """A ground that never reports would let the edge grow; or what was lost long ago would count for this outage."""
    in_flight = flown(60, each_ns=S // 100, max_bytes=10_000)
    assert in_flight.size_bytes <= 10_000
    assert lost(in_flight) == list(range(50, 60))
    assert lost(flown(10, each_ns=S)) == [5, 6, 7, 8, 9]


def test_frame_loop_and_link_may_act_at_once():
    """The edge would crash in flight, once in a thousand."""
    in_flight = BaseInFlight()

    def run(work) -> None:
        for index in range(800):
            work(index)

    works = (
        lambda index: in_flight.sent(index, unit(index, 10), now_ns=index),
        lambda index: in_flight.on_report(index - 5),
        lambda index: in_flight.take() if index % 50 == 0 else None,
    )
    with ThreadPoolExecutor(len(works)) as threads:
        list(threads.map(run, works))
    in_flight.take()
    assert in_flight.size_bytes == 0
