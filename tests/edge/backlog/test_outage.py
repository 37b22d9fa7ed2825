"""When the link is away, and which frames it took with it."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import pytest

from hvt_common.values import AccessUnit
from hvt_edge.backlog.stage import Outage
from hvt_edge.link.pacer import BaseInFlight

S = 1_000_000_000


def states(outage: Outage, *, first: float, last: float, linked: bool, reports: float = 0) -> list[bool]:
    answers, next_report = [], first
    for index in range(round(first * 15), round(last * 15)):
        now = index / 15
        if reports and now >= next_report:
            outage.reported(round(now * S))
            next_report += reports
        answers.append(outage.offline(round(now * S), linked=linked))
    return answers


@pytest.mark.parametrize(
    ("live", "stretches"),
    [
        # Each run of a clip without a ground would fill the disk; what a drone saw before its ground would be lost.
        (False, [(30, False, 0, 0, 0)]),
        (True, [(5, False, 0, 5, 5)]),
        # Another program that shows the video, and never reports, would get a frame a second.
        (True, [(30, True, 0, 0, 0)]),
        # Seconds of the flight would go into a dead connection; one report ends it.
        (False, [(10, True, 0.5, 0, 0), (4, True, 0, 2.4, 3), (2, True, 0.5, 0, 0)]),
        # Keeping would go on with somebody there: the silence of before is not held against who is not heard of yet.
        (False, [(3, True, 0.5, 0, 0), (17, False, 0, 17, 17), (10, True, 0, 0, 0)]),
        # After 15 s of silence on a living link it was the ground that went.
        (False, [(3, True, 0.5, 0, 0), (27, True, 0, 13, 14.5)]),
    ],
    ids=["clip", "camera", "listener", "silent", "gone", "left"],
)
def test_what_is_an_outage_and_how_long_it_lasts(live, stretches):
    outage, first = Outage(live=live), 0
    for lasts_s, linked, reports_s, least_s, most_s in stretches:
        away = states(outage, first=first, last=first + lasts_s, linked=linked, reports=reports_s)
        first += lasts_s
        assert least_s <= sum(away) / 15 <= most_s
        assert sum(one != other for one, other in pairwise(away)) <= 2, "it is not away by turns"


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


def test_a_ground_that_never_saw_a_picture_is_told_from_one_that_takes_none():
    """In a black hole of large packets from the start the whole flight was sent in vain, and nothing was kept."""
    outage, away = Outage(live=True), []
    for number in range(20):
        outage.reported(number * S // 2, sent=number, misses_video=number >= 8)
        outage.reported(number * S // 2, sent=number)  # a program that takes tracks alone
        away.append(outage.offline(number * S // 2, linked=True))
    assert not any(away[:8])
    assert all(away[8 + 10 :])
    outage.reported(10 * S, named=20, sent=20)
    outage.reported(10 * S, sent=20, misses_video=True)
    assert not outage.offline(10 * S, linked=True), "another ground has the video"


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


def unit(index: int, size: int = 1_000) -> AccessUnit:
    return AccessUnit(index, index * S // 15, bytes(size), keyframe=index == 0)


def flown(count: int, *, each_ns: int = S // 10, **bounds: int) -> BaseInFlight:
    in_flight = BaseInFlight(**bounds)
    for index in range(count):
        in_flight.sent(index, unit(index), now_ns=index * each_ns)
    return in_flight


def lost(in_flight: BaseInFlight) -> list[int]:
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
    works = (
        lambda index: in_flight.sent(index, unit(index, 10), now_ns=index),
        lambda index: in_flight.on_report(index - 5),
        lambda index: in_flight.take() if index % 50 == 0 else None,
    )
    with ThreadPoolExecutor(len(works)) as threads:
        list(threads.map(lambda work: [work(index) for index in range(800)], works))
    in_flight.take()
    assert in_flight.size_bytes == 0
