"""The account of line bytes and its rolling windows."""

import itertools
import pickle
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes

WINDOW = 1_000
SLACK = 2_000
CHANNELS = list(Account)

events = st.lists(
    st.tuples(st.integers(0, 400), st.sampled_from(CHANNELS), st.integers(0, 5_000), st.integers(0, 60)),
    min_size=1,
    max_size=80,
)


def dated(gaps):
    """(at_ns, channel, payload, attachment) in the order of time."""
    times = itertools.accumulate(gap for gap, *_ in gaps)
    return [(at, *rest) for at, (_, *rest) in zip(times, gaps, strict=True)]


def fed(items):
    ledger = Ledger(window_ns=WINDOW, slack_ns=SLACK)
    for at, channel, payload, attachment in items:
        ledger.count(channel, payload_bytes=payload, attachment_bytes=attachment, overhead_bytes=66, at_ns=at)
    return ledger


def brute(items, channel, now):
    return sum(
        payload + attachment + 66
        for at, entry, payload, attachment in items
        if now - WINDOW < at <= now and channel in (None, entry)
    )


def brute_worst(items, channel):
    """The fullest window in bits a second, from the definition."""
    return max(brute(items, channel, at) for at, *_ in items) * 8 * 1_000_000


@given(gaps=events)
def test_windows_and_worst_windows_are_exact(gaps):
    """The budget would be held on average and broken in some second."""
    items = dated(gaps)
    ledger = fed(items)
    worst = ledger.worst_window_bps
    assert worst.base == brute_worst(items, Account.BASE)
    assert worst.roi == brute_worst(items, Account.ROI)
    assert worst.total == brute_worst(items, None)
    newest = items[-1][0]
    for now in (newest, newest + 1, newest + 500, newest + WINDOW, newest - 700, newest - SLACK):
        for channel in (None, *CHANNELS):
            assert ledger.window_bytes(channel, now) == brute(items, channel, now)


@given(gaps=events, seed=st.integers(0, 10_000))
def test_slightly_other_order_gives_the_same_account(gaps, seed):
    """Edge and ground would print two different sums of the same bytes: stills overtake, clocks do not."""
    items = dated(gaps)
    shift = random.Random(seed)
    late = sorted(items, key=lambda item: item[0] + shift.randrange(SLACK))
    one, other = fed(items), fed(late)
    assert one.summary(3.0) == other.summary(3.0)
    assert one.window_bytes(None, items[-1][0]) == other.window_bytes(None, items[-1][0])


def test_totals_put_every_byte_in_one_place():
    """The budget and the report would not add up."""
    ledger = Ledger()
    for channel, payload, attachment, overhead, at_ns in (
        (Account.BASE, 5_000, 39, 240, 0),
        (Account.ROI, 1_500, 90, 136, 10),
        (Account.META, 200, 0, 84, 20),
        (Account.BACKLOG, 700, 40, 120, 20),
    ):
        sizes: Any = {"payload_bytes": payload, "attachment_bytes": attachment}
        ledger.count(channel, **sizes, overhead_bytes=overhead, at_ns=at_ns)
    summary = ledger.summary(2.0)
    assert (summary.base_bytes, summary.roi_bytes, summary.backlog_bytes) == (5_000, 1_500, 700)
    assert (summary.meta_bytes, summary.overhead_bytes) == (39 + 90 + 40 + 200, 240 + 136 + 120 + 84)
    assert summary.line_bytes == ledger.line_bytes == 5_279 + 1_726 + 860 + 284
    assert summary.messages == {"base": 1, "roi": 1, "backlog": 1, "meta": 1}
    assert (summary.base_bps, summary.roi_bps, summary.total_bps) == (5_279 * 4, 1_726 * 4, 8_149 * 4)
    assert ledger.messages(Account.ROI) == 1
    empty = Ledger().summary(0.0)
    assert (empty.total_bps, empty.worst_window_bps.total) == (0, 0)


def test_memory_stays_flat():
    """An edge that flies for hours would run out of memory."""
    ledger, sizes = Ledger(), set()
    of_one: Any = {"payload_bytes": 5_000, "attachment_bytes": 40, "overhead_bytes": 240}
    for frame in range(20_000):
        ledger.count(Account.BASE, **of_one, at_ns=frame * 66_666_667)
        if frame > 100 and frame % 50 == 0:
            sizes.add(len(pickle.dumps(ledger)))
    assert max(sizes) <= 1.1 * min(sizes)
    assert ledger.worst_window_bps.total == 15 * 5_280 * 8


def test_a_clock_set_back_starts_the_windows_afresh():
    """An hour's step of the clock would pile every later message into one window."""
    ledger = fed([(10_000_000 + n * 100, Account.BASE, 934, 0) for n in range(50)])
    before = ledger.worst_window_bps.base
    for n in range(50):
        ledger.count(Account.BASE, payload_bytes=934, attachment_bytes=0, overhead_bytes=66, at_ns=n * 100)
    assert before == ledger.worst_window_bps.base == 10 * 1_000 * 8 * 1_000_000
    assert ledger.window_bytes(None, 4_900) == 10_000
    assert ledger.base_bytes == 100 * 934


def test_fates_are_counted_by_reason():
    """Nobody would learn why an object has no still."""
    ledger = Ledger()
    ledger.record_outcome("dropped", "stale")
    for _ in range(2):
        ledger.record_outcome("sent", "small")
    assert ledger.outcomes("sent") == {"small": 2}
    wanted = {"sent": {"small": 2}, "deferred": {}, "dropped": {"stale": 1}, "received": {}}
    assert ledger.summary(1.0).outcomes == wanted


@pytest.mark.parametrize(
    ("payload", "attachment", "encoding", "framing"),
    [
        # Measured with `ss -ti` between two peers, key hvt/edge-1/base (15 characters), eclipse-zenoh 1.10.2.
        (200, 44, "", 31),
        (100, 44, "video/h265", 31),
        (127, 44, "video/h265", 31),
        (128, 44, "video/h265", 32),
        (200, 44, "image/jpeg", 32),
        (200, 44, "application/msgpack", 54),
        (200, 44, "image/avif", 45),
        (16_000, 127, "video/h265", 32),
        (2_000, 129, "video/h265", 33),
        # Fragments of 16384 bytes.
        (16_000, 39, "video/h265", 32),
        (16_320, 39, "video/h265", 42),
        (30_000, 39, "video/h265", 43),
        (60_000, 39, "video/h265", 61),
        (300_000, 39, "video/h265", 196),
    ],
)
def test_framing_is_what_was_measured(payload, attachment, encoding, framing):
    """The overhead column would be a guess."""
    segments = -(-(payload + attachment + framing) // 1448)
    got = overhead_bytes(payload, attachment, key="hvt/edge-1/base", encoding=encoding)
    assert got == framing + 52 * segments


@given(payload=st.integers(0, 4_000_000), attachment=st.integers(0, 500))
def test_overhead_is_bounded_and_grows_with_size(payload, attachment):
    """A formula with a hole would let a still through that the link has no room for."""
    key = "hvt/uav-1/roi"
    got = overhead_bytes(payload, attachment, key=key, encoding="image/jpeg")
    assert 52 + 12 + len(key) < got <= 160 + 0.05 * (payload + attachment)
    assert overhead_bytes(payload + 1, attachment, key=key, encoding="image/jpeg") >= got


@pytest.mark.parametrize(
    ("step_ns", "most_bytes", "newest"), [(0, 300_000, 65_537), (500_000, 950_000, 70_536)]
)
def test_a_flood_is_bounded_in_a_long_window_and_where_the_clock_stands(step_ns, most_bytes, newest):
    """An edge that says that its window is an hour, or invents reasons, would take the ground's memory."""
    count = 80_000
    ledger = Ledger(window_ns=3_600_000_000_000)
    for n in range(count):
        ledger.count(
            Account.BASE, payload_bytes=60, attachment_bytes=0, overhead_bytes=90, at_ns=10**9 + n * step_ns
        )
        ledger.record_outcome("received", f"reason {n}")
    assert len(pickle.dumps(ledger)) < most_bytes, "65 536 messages; all of them would be more"
    assert ledger.window_bytes(None, 10**9 + count * step_ns) <= 150 * newest
    assert (ledger.base_bytes, ledger.line_bytes) == (count * 60, count * 150)
    reasons = ledger.outcomes("received")
    assert (len(reasons), reasons["other"]) == (24, count - 23)
