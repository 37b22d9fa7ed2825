"""What grounds report, and when the edge takes it in."""

import threading
from dataclasses import replace

import pytest

from hvt_common.protocol.messages import Feedback, StillResult
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.perception.shadow import Detected
from rigs.footprint import footprint_bytes
from rigs.messages import RESULT, counted, feedback

U32 = 2**32 - 1


def result(sequence: int, *, track: int = 1, name: str = "car", again: bool = False) -> StillResult:
    return replace(RESULT, still_sequence=sequence, track_id=track, class_name=name, again=again)


def report(*stills: StillResult, base: int = 0, roi: int = 0, **more: int) -> Feedback:
    counts = {"base_messages": base, "roi_messages": roi}
    return feedback(**counts, base_sequence=base - 1, still_sequence=roi - 1, stills=stills, **more)


def told(*reports: Feedback, now_ns: int = 1, inbox: FeedbackInbox | None = None) -> FeedbackInbox:
    inbox = inbox or FeedbackInbox()
    for one in reports:
        inbox.on_report(counted(one, now_ns=now_ns))
    return inbox


def test_results_are_taken_once_as_they_come():
    """A class would count twice for M3 and M5, or never."""
    inbox = FeedbackInbox()
    assert inbox.received_ns is None
    told(report(result(1), result(0)), report(result(1, name="bus"), receiver_id=2), now_ns=6, inbox=inbox)
    assert [one.still_sequence for one in inbox.take()] == [1, 0], "another ground says it too"
    assert inbox.take() == []
    assert inbox.received_ns == 6
    assert told(report(result(1)), now_ns=7, inbox=inbox).take() == []


def test_lockstep_takes_exactly_the_stills_it_waited_for_in_their_order():
    """What a ground says early would count early in one run and late in the next: other stills each time."""
    inbox = told(report(result(3), result(1), result(2), last_frame_index=4))
    for up_to, waited, taken in ((2, {1, 2}, [1, 2]), (3, {3}, [3])):
        assert inbox.wait_for(frame_index=4, stills=waited, timeout_s=0)
        assert [one.still_sequence for one in inbox.take_up_to(up_to)] == taken
    told(report(result(2, name="bus"), result(3), result(4)), inbox=inbox)  # a second ground, later
    assert [one.still_sequence for one in inbox.take_up_to(10)] == [4]


def test_a_shared_still_has_an_answer_for_each_of_its_tracks():
    """Of neighbours in one still only one would ever get a class."""
    inbox = told(report(result(0, track=5), result(0, track=3), result(0, track=5, name="bus")))
    assert [(one.track_id, one.class_name) for one in inbox.take_up_to(0)] == [(3, "car"), (5, "car")]


def test_a_request_for_a_still_is_heard_beside_the_opinion_of_another_ground():
    """Of two grounds the one that missed a picture would never see the object."""
    again = report(result(4, name="", again=True), receiver_id=2)
    inbox = told(report(result(4)), again, again)
    assert [one.again for one in inbox.take()] == [False, True]
    told(report(result(5, name="", again=True)), inbox=inbox)
    assert inbox.wait_for(frame_index=-1, stills={5}, timeout_s=0), "it is an answer too"


def test_waiting_ends_when_frame_and_stills_are_there_or_the_time_is_up():
    """A lockstep edge would run ahead of its ground, or wait for ever for one that is gone."""
    inbox = FeedbackInbox()
    assert not inbox.wait_for(frame_index=0, stills=set(), timeout_s=0.01)
    inbox.on_report(counted(report(last_frame_index=3), now_ns=1))
    assert inbox.wait_for(frame_index=3, stills=set(), timeout_s=0)
    assert not inbox.wait_for(frame_index=3, stills={0}, timeout_s=0.01)
    later = threading.Timer(
        0.05, lambda: inbox.on_report(counted(report(result(0), last_frame_index=4), now_ns=2))
    )
    later.start()
    assert inbox.wait_for(frame_index=4, stills={0}, timeout_s=60)
    later.join()


@pytest.mark.parametrize(
    ("reports", "base", "roi", "frame", "still", "ends"),
    [
        # The last pictures and stills would be lost with the session.
        ([report(base=10, roi=2)], 10, 2, 10**6, -1, True),
        ([report(base=10, roi=2)], 11, 2, 10**6, -1, False),
        ([report(base=10, roi=2)], 10, 3, 10**6, -1, False),
        (
            [report(base=10, roi=2), report(base=3, roi=3)],
            10,
            3,
            10**6,
            -1,
            True,
        ),  # an older one, or another's
        # A ground that joined late never gets the first messages; Ctrl-C must not wait for them.
        ([report(result(7), base=10, roi=1, last_frame_index=90)], 90, 8, 90, 7, True),
        ([report(result(7), base=10, roi=1, last_frame_index=90)], 90, 9, 90, 8, False),
        ([report(result(7), base=10, roi=1, last_frame_index=90)], 90, 8, 91, 7, False),
    ],
)
def test_the_goodbye_waits_for_all_that_a_ground_can_have(reports, base, roi, frame, still, ends):
    waited = {"base": base, "roi": roi, "frame_index": frame, "still_sequence": still}
    assert told(*reports).wait_for_end(**waited, timeout_s=0 if ends else 0.01) is ends


def detected(count: int, *, frame: int) -> Feedback:
    return feedback(last_frame_index=frame, objects_detected=count)


def test_what_the_ground_detects_is_taken_once_and_in_lockstep_by_its_frame():
    """The decisions would move at another frame in each run, or by what was said long ago."""
    inbox = FeedbackInbox()
    assert inbox.take_detected() is None
    # In lockstep a ground may be hundreds of frames ahead of what the edge takes in.
    told(*(detected(frame + 3, frame=frame) for frame in range(4, 304)), inbox=inbox)
    assert inbox.take_detected(up_to=3) is None
    assert inbox.take_detected(up_to=5) == Detected(receiver_id=1, frame_index=5, objects=8)
    assert inbox.take_detected(up_to=5) is None
    assert inbox.take_detected() == Detected(receiver_id=1, frame_index=303, objects=306)
    assert told(detected(-1, frame=400), inbox=inbox).take_detected() is None, "it has seen nothing yet"
    inbox.on_report(replace(counted(detected(65_535, frame=401), now_ns=1), primary=False))
    assert inbox.take_detected() is None, "another ground steers"


def test_hostile_reports_take_no_memory_and_do_not_hide_true_ones():
    """Anybody on the link could fill a drone's memory, or make its methods deaf."""
    inbox = FeedbackInbox()
    sizes = []
    for number in range(0, 100_000, 32):
        never_asked = tuple(result(U32 - number - one) for one in range(32))
        never_sent = report(*never_asked, last_frame_index=U32, base=2**53 - 1)
        told(never_sent, detected(number % 60_000, frame=number), inbox=inbox)
        if number in (48_000, 96_000):
            sizes.append(footprint_bytes(inbox))
    assert sizes[1] < 1.1 * sizes[0]
    told(report(result(5)), inbox=inbox)
    assert inbox.wait_for(frame_index=9, stills={5}, timeout_s=0)
    assert [one.still_sequence for one in inbox.take_up_to(5)] == [5]
    assert len(inbox.take()) <= 1024
