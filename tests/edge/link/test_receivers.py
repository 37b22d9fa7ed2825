"""Which ground's reports count."""

from __future__ import annotations

from hvt_edge.link.receivers import PrimaryReceiver
from rigs.messages import feedback

S = 1_000_000_000
SENT = (100, 100)


def judged(
    primary: PrimaryReceiver, receiver: int, number: int, *, now_ns: int, base: int = -1, still: int = -1
) -> str:
    """What is decided on one report, in a word."""
    said = feedback(receiver_id=receiver, sequence=number, base_sequence=base, still_sequence=still)
    report = primary.judge(said, sent=SENT, now_ns=now_ns)
    assert (report.feedback, report.now_ns) == (said, now_ns)
    return "first" if report.first else "next" if report.primary else "ignored"


def test_the_newest_of_the_first_receiver_counts():
    """Reports that overtake each other would take back what was acknowledged."""
    primary = PrimaryReceiver()
    assert judged(primary, 1, 4, now_ns=0) == "first"
    assert judged(primary, 1, 5, now_ns=S // 10) == "next"
    assert judged(primary, 1, 5, now_ns=S // 5) == "ignored"
    assert judged(primary, 1, 3, now_ns=S // 5) == "ignored"
    assert judged(primary, 2, 9, now_ns=S // 5) == "ignored"


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


def test_who_names_what_was_never_sent_does_not_count():
    """One invented number would let the edge forget what no ground has, or steer its rate."""
    primary = PrimaryReceiver()
    assert judged(primary, 1, 0, now_ns=0, base=101) == "ignored"
    assert judged(primary, 1, 1, now_ns=0, still=101) == "ignored"
    assert judged(primary, 2, 0, now_ns=1, base=100, still=100) == "first", "the liar does not steer"


def test_a_number_that_was_forged_is_believed_for_a_second():
    """One message would end acknowledgements, and the pace, for the rest of the flight."""
    primary = PrimaryReceiver()
    judged(primary, 1, 7, now_ns=0)
    assert judged(primary, 1, 2**32 - 1, now_ns=1) == "next"
    assert judged(primary, 1, 8, now_ns=S // 2) == "ignored"
    assert judged(primary, 1, 15, now_ns=S + 1) == "first"
    assert judged(primary, 1, 16, now_ns=S + 2) == "next"


def test_after_an_outage_anybody_may_begin_anew():
    """After an outage the first report would be taken for an old one."""
    primary = PrimaryReceiver()
    judged(primary, 1, 7, now_ns=0)
    primary.forget()
    assert judged(primary, 1, 1, now_ns=1) == "first"
