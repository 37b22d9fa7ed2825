"""What grounds report, and when the edge takes it in."""

from __future__ import annotations

import threading
from dataclasses import replace

from hvt_common.protocol.messages import Feedback, StillResult
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.perception.shadow import Detected
from rigs.footprint import footprint_bytes
from rigs.messages import RESULT, counted, feedback

U32 = 2**32 - 1


def result(sequence: int, *, track: int = 1, name: str = "car", again: bool = False) -> StillResult:
    """One still's class."""
    return replace(RESULT, still_sequence=sequence, track_id=track, class_name=name, again=again)


def report(*stills: StillResult, frame: int = -1, base: int = 0, roi: int = 0, receiver: int = 1) -> Feedback:
    """A receiver report."""
    return feedback(
        receiver_id=receiver,
        last_frame_index=frame,
        base_messages=base,
        roi_messages=roi,
        base_sequence=base - 1,
        still_sequence=roi - 1,
        stills=stills,
    )


def test_results_are_taken_once_as_they_come():
    """A class would count twice for M3 and M5, or never."""
    inbox = FeedbackInbox()
    assert inbox.received_ns is None
    inbox.on_report(counted(report(result(1), result(0)), now_ns=5))
    inbox.on_report(
        counted(report(result(1, name="bus"), receiver=2), now_ns=6)
    )  # another ground says it too
    assert [one.still_sequence for one in inbox.take()] == [1, 0]
    assert inbox.take() == []
    assert inbox.received_ns == 6
    inbox.on_report(counted(report(result(1)), now_ns=7))
    assert inbox.take() == []


def test_lockstep_takes_exactly_the_stills_it_waited_for_in_their_order():
    """What a ground says early would count early in one run and late in the next: other stills each time."""
    inbox = FeedbackInbox()
    inbox.on_report(counted(report(result(3), result(1), result(2), frame=4), now_ns=1))
    assert inbox.wait_for(frame_index=4, stills={1, 2}, timeout_s=0)
    assert [one.still_sequence for one in inbox.take_up_to(2)] == [1, 2]
    assert inbox.wait_for(frame_index=4, stills={3}, timeout_s=0)
    assert [one.still_sequence for one in inbox.take_up_to(3)] == [3]
    inbox.on_report(
        counted(report(result(2, name="bus"), result(3), result(4)), now_ns=2)
    )  # a second ground, later
    assert [one.still_sequence for one in inbox.take_up_to(10)] == [4]


def test_a_shared_still_has_an_answer_for_each_of_its_tracks():
    """Of neighbours in one still only one would ever get a class."""
    inbox = FeedbackInbox()
    inbox.on_report(
        counted(report(result(0, track=5), result(0, track=3), result(0, track=5, name="bus")), now_ns=1)
    )
    assert [(one.track_id, one.class_name) for one in inbox.take_up_to(0)] == [(3, "car"), (5, "car")]


def test_a_request_for_a_still_is_heard_beside_the_opinion_of_another_ground():
    """Of two grounds the one that missed a picture would never see the object."""
    inbox = FeedbackInbox()
    inbox.on_report(counted(report(result(4)), now_ns=1))
    for _ in range(2):
        inbox.on_report(counted(report(result(4, name="", again=True), receiver=2), now_ns=2))
    assert [one.again for one in inbox.take()] == [False, True]
    inbox.on_report(counted(report(result(5, name="", again=True)), now_ns=3))
    assert inbox.wait_for(frame_index=-1, stills={5}, timeout_s=0), "it is an answer too"


def test_waiting_ends_when_frame_and_stills_are_there_or_the_time_is_up():
    """A lockstep edge would run ahead of its ground, or wait for ever for one that is gone."""
    inbox = FeedbackInbox()
    assert not inbox.wait_for(frame_index=0, stills=set(), timeout_s=0.01)
    inbox.on_report(counted(report(frame=3), now_ns=1))
    assert inbox.wait_for(frame_index=3, stills=set(), timeout_s=0)
    assert not inbox.wait_for(frame_index=3, stills={0}, timeout_s=0.01)
    later = threading.Timer(0.05, lambda: inbox.on_report(counted(report(result(0), frame=4), now_ns=2)))
    later.start()
    assert inbox.wait_for(frame_index=4, stills={0}, timeout_s=60)
    later.join()


def test_the_goodbye_waits_for_all_messages():
    """The last pictures and stills would be lost with the session."""
    inbox = FeedbackInbox()
    inbox.on_report(counted(report(base=10, roi=2), now_ns=1))
    assert inbox.wait_for_end(base=10, roi=2, frame_index=10**6, still_sequence=-1, timeout_s=0)
    assert not inbox.wait_for_end(base=11, roi=2, frame_index=10**6, still_sequence=-1, timeout_s=0.01)
    assert not inbox.wait_for_end(base=10, roi=3, frame_index=10**6, still_sequence=-1, timeout_s=0.01)
    inbox.on_report(counted(report(base=3, roi=3), now_ns=2))  # an older report, or another ground's
    assert inbox.wait_for_end(base=10, roi=3, frame_index=10**6, still_sequence=-1, timeout_s=0)


def test_the_goodbye_to_a_ground_that_joined_late_is_short():
    """It never gets the first messages; Ctrl-C must not wait for them."""
    inbox = FeedbackInbox()
    inbox.on_report(counted(report(result(7), base=10, roi=1, frame=90), now_ns=1))
    assert inbox.wait_for_end(base=90, roi=8, frame_index=90, still_sequence=7, timeout_s=0)
    assert not inbox.wait_for_end(base=90, roi=9, frame_index=90, still_sequence=8, timeout_s=0.01)
    assert not inbox.wait_for_end(base=90, roi=8, frame_index=91, still_sequence=7, timeout_s=0.01)


def detected(count: int, *, frame: int) -> Feedback:
    """A report of how many objects the ground's own detector shows by that frame."""
    return feedback(receiver_id=1, last_frame_index=frame, objects_detected=count)


def test_what_the_ground_detects_is_taken_once_and_in_lockstep_by_its_frame():
    """The decisions would move at another frame in each run, or by what was said long ago."""
    inbox = FeedbackInbox()
    assert inbox.take_detected() is None
    for frame in range(
        4, 304
    ):  # in lockstep a ground may be hundreds of frames ahead of what the edge takes in
        inbox.on_report(counted(detected(frame + 3, frame=frame), now_ns=1))
    assert inbox.take_detected(up_to=3) is None
    assert inbox.take_detected(up_to=5) == Detected(receiver_id=1, frame_index=5, objects=8)
    assert inbox.take_detected(up_to=5) is None
    assert inbox.take_detected() == Detected(receiver_id=1, frame_index=303, objects=306)
    inbox.on_report(counted(detected(-1, frame=400), now_ns=1))
    assert inbox.take_detected() is None, "this ground has seen nothing yet"
    inbox.on_report(replace(counted(detected(65_535, frame=401), now_ns=1), primary=False))
    assert inbox.take_detected() is None, "another ground steers"


def test_hostile_reports_take_no_memory_and_do_not_hide_true_ones():
    """Anybody on the link could fill a drone's memory, or make its methods deaf."""
    inbox = FeedbackInbox()
    sizes = []
    for number in range(0, 100_000, 32):
        never_asked = tuple(result(U32 - number - one) for one in range(32))
        inbox.on_report(counted(report(*never_asked, frame=U32, base=2**53 - 1), now_ns=1))
        inbox.on_report(counted(detected(number % 60_000, frame=number), now_ns=1))
        if number in (48_000, 96_000):
            sizes.append(footprint_bytes(inbox))
    assert sizes[1] < 1.1 * sizes[0]
    inbox.on_report(counted(report(result(5)), now_ns=2))
    assert inbox.wait_for(frame_index=9, stills={5}, timeout_s=0)
    assert [one.still_sequence for one in inbox.take_up_to(5)] == [5]
    taken = inbox.take()
    assert len(taken) <= 1024
