"""Which ground's reports count."""

import random
from collections import Counter
from dataclasses import replace

import pytest

from hvt_edge.link.feedback import PrimaryReceiver
from rigs.messages import feedback

S = 1_000_000_000
SENT = (100, 100)


def judged(
    primary: PrimaryReceiver, receiver: int, number: int, *, now_ns: int, base: int = -1, still: int = -1
) -> str:
    said = feedback(receiver_id=receiver, sequence=number, base_sequence=base, still_sequence=still)
    report = primary.judge(said, sent=SENT, now_ns=now_ns)
    assert (report.feedback, report.now_ns) == (said, now_ns)
    return "first" if report.first else "next" if report.primary else "ignored"


def test_another_takes_over_when_the_first_is_silent_or_has_no_news():
    """A ground that was closed, or that reports and receives nothing, would leave all others without a say."""
    for talks in (False, True):
        primary = PrimaryReceiver()
        for tenth in range(9):
            if talks or not tenth:
                judged(primary, 1, tenth, now_ns=tenth * S // 10)
        assert judged(primary, 2, 0, now_ns=9 * S // 10) == "ignored"
        assert judged(primary, 2, 0, now_ns=S) == "first"
        assert judged(primary, 1, 9, now_ns=S) == "ignored"
    primary = PrimaryReceiver()
    for tenth in range(31):
        named = {"base": tenth} if tenth % 2 else {"base": tenth - 1, "still": tenth}
        judged(primary, 1, tenth, now_ns=tenth * S // 10, **named)
        assert judged(primary, 2, tenth, now_ns=tenth * S // 10) == "ignored"


@pytest.mark.parametrize(
    "fps", [1.0, 15.0, *(pytest.param(fps, marks=pytest.mark.nightly) for fps in (0.5, 2.0, 3.0))]
)
@pytest.mark.parametrize(("held", "lost"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.03)])
@pytest.mark.parametrize("delay_s", [0.03, pytest.param(0.4, marks=pytest.mark.nightly), 1.3])
def test_of_two_healthy_grounds_one_steers(fps, held, lost, delay_s):
    """At a frame a second they took turns, and each turn threw away what was known of the path."""
    rng, primary, changes = random.Random(1), PrimaryReceiver(), 0
    sent, came, named, reported, numbers = -1, [], {1: -1, 2: -1}, {1: -1.0, 2: -1.0}, Counter[int]()
    next_s = 0.5
    for step in range(60_000):
        now_s = step / 200
        if now_s >= next_s:
            next_s += 1 / fps + rng.uniform(-0.01, 0.01)
            if rng.random() >= held:
                sent += 1
                came += [
                    (now_s + delay_s + rng.uniform(0, 0.02), one, sent)
                    for one in (1, 2)
                    if rng.random() >= lost
                ]
        for one in (1, 2):
            newest = max((number for at_s, who, number in came if who == one and at_s <= now_s), default=-1)
            if now_s - reported[one] >= (0.1 if newest > named[one] else 0.5):
                named[one], reported[one] = max(named[one], newest), now_s
                numbers[one] += 1
                said = feedback(receiver_id=one, sequence=numbers[one], base_sequence=named[one])
                report = primary.judge(said, sent=(sent, -1), now_ns=round((now_s + 1) * S))
                changes += report.first and now_s > 10  # at the start nothing is known yet
        came = [one for one in came if one[0] > now_s - 0.6]
    assert changes == 0


def test_two_grounds_that_see_nothing_do_not_take_turns():
    """At each turn the edge forgot what it knew of the path: it never held back, nor asked for a keyframe."""
    primary, now_ns = PrimaryReceiver(), 0
    for number in range(20):
        for one in (1, 2):
            said = feedback(receiver_id=one, sequence=number, base_sequence=-1, still_sequence=-1, lost=9)
            now_ns += S // 4
            assert primary.judge(said, sent=SENT, now_ns=now_ns).primary == (one == 1)
    assert judged(primary, 3, 0, now_ns=now_ns, base=20) == "first", "one that has the video takes over"


def test_who_reports_and_receives_nothing_makes_way_at_any_frame_rate():
    """A ground whose picture has stopped would steer for all the others."""
    for fps in (1, 5, 15):
        primary, now_ns = PrimaryReceiver(), 0
        judged(primary, 1, 0, now_ns=0, base=0)
        for number in range(1, 8 * fps):
            now_ns = number * S // fps
            judged(primary, 1, number, now_ns=now_ns, base=0)
            if judged(primary, 2, number, now_ns=now_ns, base=number) == "first":
                break
        assert now_ns <= max(S, 3 * S // fps)


def test_a_still_that_was_never_sent_ends_no_video():
    """A ground names a forged still for long: taken for silent, it would be stored for in place of live video."""
    forged = feedback(base_sequence=100, still_sequence=101, missing_stills=(99,))
    report = PrimaryReceiver().judge(forged, sent=SENT, now_ns=0)
    assert report.primary
    assert report.feedback == replace(forged, still_sequence=-1, missing_stills=())


@pytest.mark.parametrize(
    "reports",
    [
        # Reports that overtake each other would take back what was acknowledged.
        [
            (1, 4, 0, "first"),
            (1, 5, 0.1, "next"),
            *((one, n, 0.2, "ignored") for one, n in ((1, 5), (1, 3), (2, 9))),
        ],
        # One invented number would let the edge forget what no ground has, or steer its rate.
        [(1, 0, 0, "ignored", 101, -1), (2, 0, 0, "first", 100, 100)],
        # One forged message would end acknowledgements, and the pace, for the rest of the flight.
        [
            *((1, 7, 0, "first"), (1, 2**32 - 1, 0, "next"), (1, 8, 0.5, "ignored")),
            *((1, 15, 1.1, "first"), (1, 16, 1.2, "next")),
        ],
        # After an outage the first report would be taken for an old one.
        [(1, 7, 0, "first"), None, (1, 1, 0.1, "first")],
    ],
    ids=["newest", "never sent", "forged", "outage"],
)
def test_the_newest_of_the_first_receiver_counts(reports):
    primary = PrimaryReceiver()
    for one in reports:
        if one is None:
            primary.forget()
            continue
        receiver, number, at_s, expected, *named = one
        names = dict(zip(("base", "still"), named, strict=False))
        assert judged(primary, receiver, number, now_ns=round(at_s * S), **names) == expected
