"""What was kept comes back in pieces, until a ground has it: a real store, a real assembly, a link that loses."""

import logging
import random
from collections import Counter

import pytest

from hvt_common.protocol.messages import (
    MAX_ACKNOWLEDGED_RANGES,
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    parse_backlog_units,
)
from hvt_edge.backlog.backfill import Backfill
from hvt_edge.link.transmitter import Chunk
from hvt_ground.backlog.assembly import BacklogAssembly, backlog_content
from rigs.kept import UNITS, S, add_stills, add_units, opened, shifted

RTT = 100_000_000


class Ground:
    """The receiving half, as `hvt_ground` has it; what came is kept by key."""

    def __init__(self, receiver_id: int = 1) -> None:
        self.receiver_id = receiver_id
        self.assembly = BacklogAssembly()
        self.objects: dict[tuple, bytes] = {}
        self.order: list[tuple] = []
        self.knows = {7}
        self.twice = Counter()

    def take(self, chunk: Chunk) -> None:
        key = session_id, kind, number = chunk.key
        place = {"offset": chunk.offset, "total_bytes": chunk.total_bytes, "send_ns": 1}
        header = BacklogHeader(session_id=session_id, kind=kind, number=number, **place)
        whole = self.assembly.chunk(BacklogHeader.parse(header.pack(chunk.data), chunk.data), chunk.data)
        if whole is None:
            return
        if kind == BacklogKind.INFO:
            self.knows.add(session_id)
        elif session_id not in self.knows:
            self.assembly.want_info(session_id)
            self.assembly.settle(key, usable=False)
            return
        backlog_content(key, whole, edge="uav-1") if kind != BacklogKind.INFO else None
        self.twice[key] += 1
        self.objects[key] = whole
        self.order.append(key)
        self.assembly.settle(key, usable=True)


class Rig:
    """A store, its backfill, a link of 100 kB/s, and a ground that reports five times a second."""

    def __init__(self, folder, *, session_id: int = 7, loss: float = 0.0, seed: int = 0) -> None:
        self.folder = folder
        self.done: list[tuple] = []
        self.backfill = Backfill(
            folder, session_id=session_id, on_done=lambda entry: self.done.append(entry.key)
        )
        self.ground = Ground()
        self.now_ns = 0
        self.loss, self.random = loss, random.Random(seed)
        self.sent: list[Chunk] = []
        self.listening = True

    def run(self, seconds: float, *, chunk_bytes: int = 5000, reports: bool = True) -> None:
        for step in range(round(seconds * 20)):
            self.now_ns += S // 20
            chunk = self.backfill.next_chunk(chunk_bytes, now_ns=self.now_ns, round_trip_ns=RTT)
            if chunk is not None:
                self.sent.append(chunk)
                if self.listening and self.random.random() >= self.loss:
                    self.ground.take(chunk)
            if reports and step % 4 == 3 and self.random.random() >= self.loss:
                self.report()

    def acknowledge(self, bytes_: int, *, receiver_id: int = 1, **key) -> None:
        one = AcknowledgedRange(
            **{"session_id": 7, "kind": "still", "number": 1} | key, acknowledged_bytes=bytes_
        )
        self.backfill.on_acknowledged(one, receiver_id=receiver_id, now_ns=self.now_ns)

    def report(self) -> None:
        for one in self.ground.assembly.take_acknowledged_ranges(MAX_ACKNOWLEDGED_RANGES):
            self.backfill.on_acknowledged(one, receiver_id=self.ground.receiver_id, now_ns=self.now_ns)


@pytest.fixture
def rig(folder) -> Rig:
    return Rig(folder)


def fill(folder, *, stills: int = 6) -> None:
    add_stills(folder, {number: float(number) for number in range(stills)})
    for part in range(3):
        add_units(folder, [shifted(unit, 10 * part) for unit in UNITS])


@pytest.mark.parametrize("video_first", [False, True])
def test_stills_come_by_worth_then_video_newest_first_and_the_disk_is_free(rig, folder, video_first):
    """The operator would wait for minutes of road before the one still that matters, or command without effect."""
    fill(folder)
    rig.backfill.video_first = video_first
    entries = [*folder.best_stills(), *folder.newest_segments()]
    expected = {entry.key: folder.read(entry) for entry in entries}
    rig.run(15)
    stills, video = [("still", n) for n in (5, 4, 3, 2, 1, 0)], [("base", n) for n in (300, 150, 0)]
    assert [key[1:] for key in rig.ground.order] == (video + stills if video_first else stills + video)
    assert rig.ground.objects == expected
    assert rig.done == rig.ground.order
    assert (folder.stills, folder.segments) == (0, 0)
    assert set(rig.ground.twice.values()) == {1}
    assert sum(len(chunk.data) for chunk in rig.sent) == sum(len(one) for one in expected.values())


def test_the_facts_of_a_former_session_come_before_its_objects(tmp_path):
    """The ground would have pictures of a session that it knows nothing of."""
    with opened(tmp_path) as folder:
        fill(folder)
    with opened(tmp_path, session_id=8) as folder:
        rig = Rig(folder, session_id=8)
        rig.ground.knows = set()
        rig.run(16)
        assert rig.ground.order[0] == (7, "info", 0)
        assert len(rig.ground.order) == 10
        assert folder.info_of(7) is None, "nothing is left"


@pytest.mark.parametrize("loss", [0.1, 0.2])
def test_lost_pieces_and_reports_cost_time_and_nothing_else(folder, loss):
    """A lossy link would leave holes, or begin everything anew."""
    fill(folder)
    rig = Rig(folder, loss=loss, seed=3)
    rig.run(240)
    assert len(rig.ground.objects) == 9
    assert (folder.stills, folder.segments) == (0, 0)
    assert rig.backfill.given_up == 0
    assert set(rig.ground.twice.values()) == {1}


def test_after_an_outage_it_goes_on_where_the_ground_left_off(rig, folder):
    """Each outage would begin the video of the last one again."""
    add_units(folder, UNITS + [shifted(unit, 4) for unit in UNITS[:14]])
    total = len(folder.read(next(folder.newest_segments())))
    rig.run(0.6)
    assert 0 < sum(len(chunk.data) for chunk in rig.sent) < total
    rig.backfill.interrupt()
    rig.run(30)
    resent = sum(len(chunk.data) for chunk in rig.sent) - total
    assert len(rig.ground.objects) == 1
    assert resent <= 4 * 5000, "what went out before the first report"


def test_what_arrived_before_an_outage_is_not_sent_after_it(rig, folder):
    """The link breaks before the report: a link that flaps would carry the same stills again and again."""
    fill(folder)
    rig.run(0.6, reports=False)
    sent = len(rig.sent)
    rig.backfill.interrupt()
    rig.report()
    assert folder.stills == 0
    rig.run(15)
    assert set(rig.ground.twice.values()) == {1}
    assert {chunk.key[1] for chunk in rig.sent[sent:]} == {"base"}


def test_a_ground_that_was_started_again_gets_it_from_the_beginning(rig, folder):
    """The object would be complete for the edge and half for the ground."""
    fill(folder, stills=0)
    rig.run(0.8)
    rig.ground = Ground(receiver_id=2)
    rig.run(60)
    assert len(rig.ground.objects) == 3
    for key, data in rig.ground.objects.items():
        assert parse_backlog_units(data)[0].frame_index == key[2]


def test_what_a_ground_does_not_take_is_put_aside_and_never_deleted(rig, folder, caplog):
    """One object would hold up all others for ever; or who listens and never answers would empty the store."""
    add_stills(folder, {1: 1.0, 2: 0.5})
    add_units(folder, UNITS)
    rig.listening = False
    with caplog.at_level(logging.WARNING):
        rig.run(6)
        assert rig.backfill.given_up == 0
        rig.run(60)
    assert rig.backfill.given_up == 3
    assert Counter(chunk.key[2] for chunk in rig.sent if chunk.offset == 0) == {1: 3, 2: 3, 0: 3}
    assert (folder.stills, folder.segments) == (2, 1)
    assert "3 tries" in caplog.text
    assert "stays on disk" in caplog.text
    rig.listening = True
    rig.ground = Ground(receiver_id=2)
    rig.ground.assembly.want_info(7)  # its first word
    rig.report()
    rig.run(30)
    assert len([key for key in rig.ground.objects if key[1] != "info"]) == 3, "another ground is asked again"
    assert (folder.stills, folder.segments) == (0, 0)


def test_a_ground_that_answers_is_busy_and_not_gone(rig, folder):
    """A ground that works through what has come would lose all that it has no time for yet."""
    add_stills(folder, {1: 1.0})
    rig.listening = False  # it has no room: the piece is not kept, and it says so
    key = (7, BacklogKind.STILL, 1)
    for _ in range(60):
        rig.run(1, reports=False)
        rig.acknowledge(0)
    assert rig.backfill.given_up == 0
    rig.listening = True
    rig.run(5)
    assert list(rig.ground.objects) == [key]
    assert folder.stills == 0


def test_a_word_that_comes_late_still_counts(rig, folder):
    """What the ground has would be sent to it again after every start, and fill the disk until then."""
    add_stills(folder, {1: 1.0})
    rig.run(30, reports=False)
    assert rig.backfill.given_up == 1
    ((_, data),) = rig.ground.objects.items()
    for acknowledged_bytes, left in ((len(data) - 1, 1), (len(data), 0)):
        rig.acknowledge(acknowledged_bytes)
        assert folder.stills == left
    assert rig.done == [(7, BacklogKind.STILL, 1)]


def test_an_outage_is_no_try(rig, folder):
    """A flapping link would cost everything that was kept."""
    add_stills(folder, {1: 1.0})
    rig.listening = False
    for _ in range(10):
        rig.run(1.5)
        rig.backfill.interrupt()
    assert folder.stills == 1
    rig.listening = True
    rig.run(3)
    assert len(rig.ground.objects) == 1


def test_reports_of_nonsense_and_of_other_grounds_change_nothing(rig, folder):
    """Anybody who may report could delete what was kept."""
    add_units(folder, UNITS)
    rig.run(0.4)
    total = len(folder.read(next(folder.newest_segments())))
    rig.acknowledge(total, kind="base", number=0, receiver_id=99)
    rig.acknowledge(total + 1, kind="base", number=0)
    rig.acknowledge(5, kind="base", number=77)
    rig.acknowledge(0, number=0)
    rig.acknowledge(0, kind="info", number=4)
    assert folder.segments == 1
    rig.run(20)
    assert len(rig.ground.objects) == 1


def test_only_facts_that_are_here_can_be_asked_for(rig, folder):
    """A flood of reports would fill the memory of the drone with numbers of sessions."""
    add_stills(folder, {1: 1.0})
    for session_id in range(7, 2000):
        rig.acknowledge(0, session_id=session_id, kind="info", number=0)
    sent = [rig.backfill.next_chunk(10_000, now_ns=2, round_trip_ns=RTT) for _ in range(3)]
    assert [one.key[:2] for one in sent if one] == [(7, "info")], "then the objects"


def test_bytes_count_as_arrived_once_whatever_the_link_does(rig, folder):
    """After each outage the summary would have more come back than was ever kept."""
    add_units(folder, UNITS)
    total = len(folder.read(next(folder.newest_segments())))
    for _ in range(3):
        rig.run(0.4, chunk_bytes=3000)
        rig.backfill.interrupt()
    rig.run(30)
    assert folder.segments == 0
    assert rig.backfill.acknowledged_bytes == total


def test_memory_holds_one_object(rig, folder):
    """A store of 200 MB would be read into the memory of a drone."""
    add_stills(folder, dict.fromkeys(range(50), 1.0))
    for part in range(6):
        add_units(folder, [shifted(unit, 10 * part) for unit in UNITS])
    rig.run(10, reports=False)
    objects, data = rig.backfill.line, rig.backfill.data
    assert len(objects) == 12, "without a word from the ground no more goes out"
    assert data is None or len(data[1]) < 200_000


def test_a_file_that_goes_while_it_is_sent_stops_nothing(rig, folder):
    """A full store evicts what is on its way; the next one has to come all the same."""
    fill(folder)
    rig.run(1)
    for entry in [*folder.best_stills(), *list(folder.newest_segments())[:1]]:
        folder.remove(entry)
    rig.run(20)
    assert (folder.stills, folder.segments) == (0, 0)
    assert {key[2] for key in rig.ground.objects if key[1] == "base"} >= {0, 150}


def test_an_arrival_removes_no_other_object_from_the_disk(rig, folder):
    """A still that made room while it was under way had its row taken by the next, which went when it arrived."""
    add_stills(folder, {1: 1.0})
    rig.run(0.1, reports=False)
    (evicted,) = folder.best_stills()
    folder.remove(evicted)
    add_stills(folder, {2: 1.0})
    rig.report()
    assert rig.done == [evicted.key]
    assert [one.number for one in folder.best_stills()] == [2]


def test_pieces_are_no_smaller_than_they_are_worth(folder):
    """A link with little room would carry headers."""
    add_stills(folder, {1: 1.0})
    backfill = Backfill(folder, session_id=7)
    assert backfill.next_chunk(300, now_ns=1, round_trip_ns=RTT) is None
    assert backfill.next_chunk(0, now_ns=1, round_trip_ns=RTT) is None
    first = backfill.next_chunk(1000, now_ns=1, round_trip_ns=RTT)
    assert (first.offset, len(first.data)) == (0, 1000)
    rest = first.total_bytes - 1000
    assert backfill.next_chunk(rest, now_ns=1, round_trip_ns=RTT).offset == 1000
