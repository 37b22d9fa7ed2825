"""Which ground's reports count."""

from __future__ import annotations

from hvt_edge.link.receivers import PrimaryReceiver

S = 1_000_000_000


def test_the_newest_of_the_first_receiver_counts():
    """Reports that overtake each other would take back what was acknowledged."""
    primary = PrimaryReceiver()
    assert primary.receiver_id is None
    assert primary.take(1, 4, now_ns=0) == "first"
    assert primary.take(1, 5, now_ns=S // 10) == "next"
    assert primary.take(1, 5, now_ns=S // 5) is None
    assert primary.take(1, 3, now_ns=S // 5) is None
    assert primary.take(2, 9, now_ns=S // 5) is None
    assert (primary.receiver_id, primary.heard_ns) == (1, S // 10)


def test_another_is_followed_when_the_first_is_silent_or_has_no_news():
    """A ground that was closed, or that reports and receives nothing, would leave all others without a say."""
    for talks in (False, True):
        primary = PrimaryReceiver()
        for tenth in range(9):
            if talks or not tenth:
                primary.take(1, tenth, now_ns=tenth * S // 10)
        assert primary.take(2, 0, now_ns=9 * S // 10) is None
        assert primary.take(2, 0, now_ns=S) == "first"
        assert primary.receiver_id == 2
    primary = PrimaryReceiver()
    for tenth in range(31):
        primary.take(1, tenth, now_ns=tenth * S // 10)
        primary.note_progress(tenth * S // 10)
        assert primary.take(2, tenth, now_ns=tenth * S // 10) is None


def test_a_number_that_was_forged_is_believed_for_a_second():
    """One message would end acknowledgements, and the pace, for the rest of the flight."""
    primary = PrimaryReceiver()
    primary.take(1, 7, now_ns=0)
    assert primary.take(1, 2**32 - 1, now_ns=1) == "next"
    assert primary.take(1, 8, now_ns=S // 2) is None
    assert primary.take(1, 15, now_ns=S + 1) == "first"
    assert primary.take(1, 16, now_ns=S + 2) == "next"


def test_who_is_forgotten_may_begin_anew():
    """After an outage the first report would be taken for an old one."""
    primary = PrimaryReceiver()
    primary.take(1, 7, now_ns=0)
    primary.forget()
    assert primary.receiver_id is None
    assert primary.take(1, 1, now_ns=1) == "first"
