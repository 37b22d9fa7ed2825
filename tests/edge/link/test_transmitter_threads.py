"""The frame loop, the stills and the backlog send at one time: the budget holds whoever comes first."""

import random
import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count

import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import BacklogKind, RoiHeader
from hvt_common.values import AccessUnit
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.transmitter import Chunk
from rigs.examples import Clock
from rigs.keeping import STILL, Out
from rigs.world import make_transmitter

S = 1_000_000_000
NOW_NS = 1_790_000_000 * S
TOTAL = 800_000


class Rig:
    """A sender; nothing has gone out for a while."""

    def __init__(self) -> None:
        self.out, self.ledger, self.waits = Out(), Ledger(), []
        self.out.dark = True
        self.sender = make_transmitter(
            self.out, ledger=self.ledger, budget=(TOTAL, 400_000), session_id=7, wait_until=self.waits.append
        )

    def still(self, number: int, size: int, *, now_ns: int = NOW_NS) -> None:
        still = replace(STILL.with_header(sequence=number), data=b"\xff" * size)
        self.sender.still(still, now_ns=now_ns)

    def backlog(self, size: int, *, now_ns: int = NOW_NS, offset: int = 0) -> int:
        return self.sender.backlog(Chunk((7, BacklogKind.BASE, 0), offset, 10**6, bytes(size)), now_ns=now_ns)


def test_a_chunk_that_lost_its_room_to_a_still_is_not_sent():
    """105000 bytes would go into a window of 100000."""
    rig = Rig()
    rig.sender.budget.end_base()
    for number in range(7):
        rig.still(number, 12_000)
    room = rig.sender.backlog_allowance_bytes(NOW_NS, reserve=0.0)
    assert room == 5_000, "what the store's thread is told"
    rig.still(7, 12_000)  # by the stills' thread, meanwhile
    assert rig.backlog(room) == 0
    assert [row for row, _, _ in rig.out.puts if row is Channel.BACKLOG] == []
    assert rig.backlog(rig.sender.backlog_allowance_bytes(NOW_NS, reserve=0.0)) in range(5_000)
    assert rig.ledger.worst_window_bps.total <= TOTAL


def test_a_still_that_lost_its_room_waits_until_there_is_some():
    """A still and a chunk that were both admitted would exceed the window together."""
    rig = Rig()
    rig.sender.budget.end_base()
    assert rig.backlog(40_000)
    rig.still(0, 500)
    assert rig.waits == [NOW_NS], "where it has its room it goes at once"
    room = rig.sender.still_allowance_bytes(NOW_NS)
    assert room > 6_000
    assert rig.backlog(55_000, offset=40_000)  # by the store's thread, meanwhile
    rig.still(1, room)
    row, payload, attachment = rig.out.puts[-1]
    assert row is Channel.ROI
    sent_ns = RoiHeader.parse(attachment, payload).send_ns
    assert rig.waits[-1] == sent_ns >= NOW_NS + S, "when the window has moved on"
    assert rig.ledger.worst_window_bps.total <= TOTAL


@pytest.mark.parametrize("what", [Channel.ROI, Channel.BACKLOG])
def test_what_blocks_in_its_put_holds_up_no_base_frame(what):
    """One still, or stored piece, into a full link would freeze the picture for as long as the link stays full."""
    rig, blocked, entered = Rig(), threading.Event(), threading.Event()

    def block(channel: Channel) -> None:
        if channel is what:
            entered.set()
            assert blocked.wait(60)

    rig.out.before_put = block
    still, piece = partial(rig.still, 0, 5_000), partial(rig.backlog, 5_000)
    thread = threading.Thread(target=still if what is Channel.ROI else piece)
    thread.start()
    assert entered.wait(60)
    for index in range(30):  # two seconds of video
        at_ns = NOW_NS + index * S // 15
        rig.sender.base(AccessUnit(index, at_ns, bytes(1_500), False), now_ns=at_ns)
        assert rig.waits[-1] == at_ns, "it does not wait for the budget either"
    assert thread.is_alive(), "it is blocked all the while"
    blocked.set()
    thread.join()
    assert [channel for channel, _, _ in rig.out.puts] == [Channel.BASE] * 30 + [what]


def frames(rig: Rig, clock: Clock) -> Iterator[None]:
    for index in count():
        due_ns = NOW_NS + index * S // 15
        while clock() < due_ns:
            yield
        at_ns = clock()
        yield
        rig.sender.base(AccessUnit(index, due_ns, bytes(1_500 + 2_000 * (index % 3)), False), now_ns=at_ns)


def stills(rig: Rig, clock: Clock) -> Iterator[None]:
    for number in count():
        at_ns = clock()
        room = rig.sender.still_allowance_bytes(at_ns)
        yield
        if room > 500:
            rig.still(number, min(room, 12_000), now_ns=at_ns)
        yield


def stored(rig: Rig, clock: Clock) -> Iterator[None]:
    offset = 0
    while True:
        at_ns = clock()
        room = rig.sender.backlog_allowance_bytes(at_ns, reserve=0.0)
        yield
        if room > 500:
            offset += room if rig.backlog(room, now_ns=at_ns, offset=offset % 900_000) else 0
        yield


@pytest.mark.parametrize("seed", range(4))
def test_three_threads_keep_to_one_budget_in_whatever_order_they_run(seed):
    """The hard limit would be hard for one thread only: 105000 bytes in a window of 100000."""
    rig, clock, chance = Rig(), Clock(NOW_NS), random.Random(seed)
    threads = [one(rig, clock) for one in (frames, stills, stored)]
    for _ in range(1_000):
        clock.now_ns += S // 100
        for _ in range(chance.randrange(1, 8)):
            next(chance.choice(threads))
    rows = [row for row, _, _ in rig.out.puts]
    assert min(rows.count(row) for row in (Channel.BASE, Channel.ROI, Channel.BACKLOG)) > 10
    assert rig.ledger.worst_window_bps.total <= TOTAL


def test_of_what_a_quiet_scene_leaves_the_backlog_has_most_and_a_busy_one_hardly_waits():
    """At 300 kbps the base has .95: a chunk never fitted, and of 20 s of video .4 came in 40 s beside 85 kbps."""
    total, step_ns = 300_000, S // 15
    budget = RollingBudget(BudgetSettings(total, 285_000, fps=15, metadata_bps=5_000))
    stored_bytes, waits_ns = [0, 0], []
    for frame in range(15 * 20):
        now_ns = NOW_NS + frame * step_ns
        size = 700 if frame < 150 else round(budget.base_step_bytes)
        at_ns = budget.earliest_ns(size, now_ns=now_ns, base=True)
        waits_ns.append(at_ns - now_ns)
        budget.record_base(size, now_ns=at_ns)
        room = budget.backlog_allowance(at_ns, reserve=1 / 3)
        if room >= 1_000:
            budget.record_other(min(room, 1_875), now_ns=at_ns)
            stored_bytes[frame >= 165] += min(room, 1_875)
    assert stored_bytes[0] * 8 / 10 > 0.6 * (total - 85_000)
    assert stored_bytes[1] == 0, "the base takes its share again"
    assert max(waits_ns) < step_ns


def test_room_for_the_backlog_leaves_what_base_and_stills_will_want():
    """A chunk would take the room of the next frame, or of a still that comes."""
    budget = RollingBudget(BudgetSettings(TOTAL, 400_000, fps=15))
    room = budget.backlog_allowance(NOW_NS, reserve=0.0)
    assert 45_000 <= room <= 50_000, "the first frame may come at any moment"
    assert budget.backlog_allowance(NOW_NS, reserve=0.5) == room - 25_000
    budget.record_base(3_000, now_ns=NOW_NS)
    room = budget.backlog_allowance(NOW_NS, reserve=0.0)
    assert 45_000 <= room <= 50_000, "the base's half of the coming window is not given away"
    budget.record_other(20_000, now_ns=NOW_NS)
    assert budget.backlog_allowance(NOW_NS, reserve=0.0) <= room
    assert budget.backlog_allowance(NOW_NS + 3 * S, reserve=0.0) <= 50_000, "so may the next one"
    budget.end_base()
    assert budget.backlog_allowance(NOW_NS + 3 * S, reserve=0.0) == 100_000
