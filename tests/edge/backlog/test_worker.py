"""The threads behind the store: a disk that hangs, a link that is full, a folder that vanishes."""

import logging
import shutil
import sqlite3
import threading
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path

import pytest

from hvt_common.protocol.messages import AcknowledgedRange, BacklogKind
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.worker import EndSegment, Intake, StoreWorker
from hvt_edge.link.transmitter import Chunk
from media.clips import START_NS
from programs.processes import eventually
from rigs.kept import INFO, UNITS, S, add_stills, add_units, opened, shifted

UNIT = UNITS[0]


class Link:
    """How pieces leave, and what was sent; it may be `full`, so that sending blocks."""

    def __init__(self, *, is_open: bool = True) -> None:
        self.full = threading.Event()
        self.full.set()
        self.entered = threading.Event()
        """A chunk is in hand."""
        self.open = is_open
        self.gone = 0
        """So many pieces find that their room is gone."""
        self.now_ns = START_NS
        self.sent: list[tuple[int, Chunk]] = []
        self.failures = Failures(lambda: self.now_ns)

    def allowance(self, now_ns: int) -> int:
        return 5000 if self.open else 0

    def send(self, chunk: Chunk) -> int:
        self.entered.set()
        self.full.wait(60)
        if self.gone:
            self.gone -= 1
            return 0
        self.sent.append((self.now_ns, chunk))
        self.now_ns += S // 1000
        return len(chunk.data) + 60


def arrived(kind: str, number: int, bytes_: int) -> AcknowledgedRange:
    return AcknowledgedRange(session_id=7, kind=kind, number=number, acknowledged_bytes=bytes_)


def slow_info(disk: threading.Event) -> Callable[[], bytes]:
    return lambda: disk.wait(60) and INFO.pack()


def worker_of(path: Path, link: Link, *, info=INFO.pack, session_id: int = 7, **more) -> StoreWorker:
    parts = {"send": link.send, "close_s": 60.0, **more}
    return StoreWorker(
        Store(path, max_bytes=50_000_000, session_id=session_id, info=info),
        session_id=session_id,
        clock=lambda: link.now_ns,
        allowance=link.allowance,
        round_trip_ns=lambda: S // 10,
        failures=link.failures,
        **parts,
    )


def test_a_disk_that_hangs_costs_what_waits_and_says_so(tmp_path, caplog):
    """The edge would never end; or would end and say nothing of what it lost."""
    disk, link = threading.Event(), Link()
    worker = worker_of(tmp_path / "store", link, info=slow_info(disk), close_s=0.3)
    taken = sum(worker.offer(UNIT) for _ in range(600))
    assert 512 <= taken <= 513
    with caplog.at_level(logging.WARNING):
        worker.close()
    assert f"{taken - 1} frames and stills" in caplog.text, "one is being written"

    def failing() -> list[str]:
        link.now_ns += 11 * S
        return [one.part for one in link.failures.now]

    eventually(lambda: failing() == ["store"], what="it is said that it hangs")
    disk.set()
    eventually(lambda: not len(worker.intake), what="the thread has gone on")


def test_the_free_space_of_a_disk_that_hangs_is_unknown_and_holds_up_nobody(tmp_path, monkeypatch):
    link, hangs, on = Link(), threading.Event(), threading.Event()
    measure, asked_by = shutil.disk_usage, set()

    def disk_usage(path):
        asked_by.add(threading.current_thread().name)
        if hangs.is_set():
            on.wait(60)
        return measure(path)

    monkeypatch.setattr(shutil, "disk_usage", disk_usage)
    worker = worker_of(tmp_path / "not made yet", link)
    eventually(lambda: worker.disk_free_bytes, what="the free space is known")
    assert not any(asdict(worker.numbers).values()), "a summary tells of a store that was used"
    hangs.set()
    link.now_ns += 6 * S
    assert worker.disk_free_bytes is None
    on.set()
    eventually(lambda: worker.disk_free_bytes, what="the free space is known")
    worker.close()
    assert asked_by == {"hvt-store"}


def test_a_relative_folder_whose_place_is_gone_costs_the_store_alone(tmp_path, monkeypatch):
    """The flight would end with a traceback, because nobody can say how full its disk is."""
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    worker = worker_of(Path("store"), Link())
    worker.offer(UNIT)
    eventually(lambda: worker.failed, what="it was tried")
    worker.close()


def test_no_word_is_lost_while_the_disk_is_slow(tmp_path):
    """The segment would never end, and never be sent: the outage's video would wait for the next one."""
    disk, link = threading.Event(), Link(is_open=False)
    with opened(tmp_path / "store", session_id=6) as folder:
        add_stills(folder, {1: 1.0})
    worker = worker_of(tmp_path / "store", link, info=slow_info(disk))
    units = [shifted(unit, 4 * part) for part in range(10) for unit in UNITS]
    taken = [unit.frame_index for unit in units if worker.offer(unit)]
    worker.intake.end_segment()
    worker.intake.signal(video_first=True)
    disk.set()
    eventually(lambda: worker.intake.idle, what="all is stored")
    link.open = True
    eventually(lambda: link.sent, what="an ended segment is sent")
    assert link.sent[0][1].key[1] == "base", "before the still"
    assert not worker.offer(UNITS[0]) or worker.numbers.segments > 1
    worker.close()
    assert len(taken) < len(units)
    with opened(tmp_path / "store", session_id=8) as folder:
        assert folder.span_ns > 25 * S


def test_one_frame_is_not_nothing(tmp_path):
    """Who asks for the video would be told that there is none; a clip would end without sending it."""
    link = Link(is_open=False)
    worker = worker_of(tmp_path / "store", link)
    assert worker.numbers.empty
    worker.offer(UNIT)
    eventually(lambda: not worker.numbers.empty, what="it is there")
    assert (worker.numbers.segments, worker.numbers.video_s) == (1, 0.0)
    worker.intake.end_segment()
    worker.close()
    assert (worker.numbers.segments, worker.numbers.empty) == (1, False)


def test_the_words_of_a_full_line_are_few():
    """A link that flaps over a dead disk would fill the memory; or the words would go where frames go."""
    intake = Intake(2)
    assert [intake.offer(UNIT) for _ in range(3)] == [True, True, False]
    for number in range(500):
        intake.end_segment()
        intake.signal(interrupted=True)
        intake.on_acknowledged([arrived("base", number, 5)], receiver_id=3)
    assert len(intake) == 2
    news, first = intake.take(0.0)
    assert (news.interrupted, first) == (True, UNIT)
    assert [one.number for one in news.acknowledged.values()] == list(range(436, 500)), "the newest"
    assert [type(intake.take(0.0)[1]) for _ in range(3)] == [AccessUnit, EndSegment, type(None)]
    assert not intake.take(0.0)[0].interrupted
    intake.signal(closed=True)
    assert not intake.offer(UNIT)
    assert intake.ended


@pytest.mark.parametrize("ended", [False, True])
def test_a_link_that_is_full_does_not_hold_up_the_disk_and_after_the_last_word_nothing_goes_out(
    tmp_path, ended
):
    """What is seen meanwhile would not be kept; or a ground that has it all would have closed its account already."""
    with opened(tmp_path / "store") as folder:
        add_units(folder, UNITS)
    link = Link()
    link.full.clear()
    worker = worker_of(tmp_path / "store", link)
    assert link.entered.wait(60), "a chunk is being sent"
    if ended:
        worker.send_no_more(within_s=0.1)
    for unit in UNITS[:10]:
        worker.offer(shifted(unit, 50))
    eventually(lambda: worker.numbers.segments == 2 and worker.intake.idle, what="it is kept")
    assert link.sent == []
    link.full.set()
    eventually(lambda: len(link.sent) > (0 if ended else 3), what="it goes on")
    worker.close()
    assert len(link.sent) == 1 or not ended, "the one that was under way"


def test_a_piece_whose_room_is_gone_comes_next_and_no_hole_is_left(tmp_path):
    """The ground would wait for the hole, and the object begin again."""
    with opened(tmp_path / "store") as folder:
        add_units(folder, UNITS)
    link = Link()
    link.gone = 3
    worker = worker_of(tmp_path / "store", link)
    eventually(lambda: len(link.sent) > 2, what="pieces go out")
    worker.close()
    ends = accumulate(len(chunk.data) for _, chunk in link.sent)
    assert [chunk.offset for _, chunk in link.sent] == [0, *ends][:-1]


def test_a_folder_that_vanishes_in_mid_flight_is_made_again(tmp_path, caplog):
    """A stick that is pulled out would end the flight, or storing for the rest of it."""
    link, store = Link(is_open=False), tmp_path / "store"
    worker = worker_of(store, link)
    for unit in UNITS[:10]:
        worker.offer(unit)
    eventually(lambda: worker.intake.idle and worker.numbers.video_s > 0.5, what="they are written")
    shutil.rmtree(store)
    with caplog.at_level(logging.WARNING):
        worker.offer(shifted(UNITS[0], 60))
        eventually(lambda: worker.failed, what="it is noticed")
        assert worker.numbers.empty
        assert not worker.offer(UNITS[0])
        assert not store.exists(), "the next try comes after a pause"
        link.now_ns += 2 * S
        eventually(lambda: len(caplog.messages) == 2, what="it is tried again, and said")
    assert [one.partition(": ")[0] for one in caplog.messages] == ["store", "store"], "once that, once this"
    (part,) = link.failures.parts
    assert (part.part, part.count, part.working) == ("store", 1, True)
    worker.offer(shifted(UNITS[0], 70))
    worker.close()
    assert worker.numbers.segments == 1


def test_a_full_disk_stops_storing_alone_until_there_is_space(small_disk, caplog):
    """The flight would end for a full card; or what was stored before would not be sent, or be sent for ever."""
    link = Link(is_open=False)
    worker = worker_of(small_disk / "store", link)
    with caplog.at_level(logging.WARNING):
        for stretch in range(30):
            taken = [worker.offer(shifted(unit, 4 * stretch)) for unit in UNITS]
            eventually(lambda: worker.intake.idle, what="they are taken")
            if not all(taken):
                break
        eventually(lambda: worker.failed, what="the disk is full")
        stored = worker.numbers
        assert stored.segments >= 2
        for tries in (2, 3):  # in vain: twice as long after each
            link.now_ns += 100 * S
            eventually(lambda most=tries: link.failures.parts[0].count >= most, what="it is tried again")
        link.open = True
        eventually(lambda: len({chunk.key for _, chunk in link.sent}) >= 2, what="it is sent")
        link.open = False
        sent = {(chunk.key[2], chunk.total_bytes) for _, chunk in link.sent}
        ranges = [arrived("base", number, total) for number, total in sent]
        worker.intake.on_acknowledged(ranges, receiver_id=1)
        left = stored.segments - len(ranges)
        eventually(lambda: worker.numbers.segments == left, what="it has arrived")
        (small_disk / "filler").unlink()
        link.now_ns += 200 * S
        eventually(lambda: not worker.failed, what="there is space")
    (part,) = link.failures.parts
    assert (part.part, part.working) == ("store", True)
    assert "no space is left" in part.reason
    assert caplog.text.count("no space is left") == 1, "not at each try"
    worker.offer(shifted(UNITS[0], 1000))
    worker.close()
    with opened(small_disk / "store", session_id=8) as store:
        assert store.segments == left + 1
        assert all(store.read(entry) for entry in list(store.newest_segments()))


def test_what_a_dying_run_had_kept_is_sent_by_the_next(tmp_path, caplog):
    """An edge that is restarted at once would leave it for another flight."""
    store, link = tmp_path / "store", Link()
    with opened(store) as dying:
        add_stills(dying, {1: 1.0})
        worker = worker_of(store, link)
        eventually(lambda: "another edge uses it" in caplog.text, what="it found the folder taken")
        assert worker.numbers.empty
    link.now_ns += 2 * S
    eventually(lambda: worker.numbers.stills == 1, what="it asked again")
    eventually(lambda: link.sent, what="it is sent")
    worker.close()


class Panic(BaseException):
    """As of Zenoh, which is written in Rust."""


@pytest.mark.parametrize("error", [ZeroDivisionError, Panic])
def test_an_error_in_sending_stops_sending_alone(tmp_path, caplog, error):
    """A bug in what nobody watches would end the flight; or one object would hold up all others."""
    link, number_of_bad = Link(), 2

    def broken(chunk: Chunk) -> int:
        if chunk.key[2] == number_of_bad:
            raise error
        return link.send(chunk)

    with opened(tmp_path) as store:
        add_stills(store, {1: 1.0, 2: 2.0, 3: 3.0})
    worker = worker_of(tmp_path, link, send=broken)
    eventually(lambda: "what was stored is not sent" in caplog.text, what="it says so")
    assert worker.offer(UNITS[0]), "storing goes on"
    link.now_ns += 2 * S
    eventually(lambda: {1, 3} <= {chunk.key[2] for _, chunk in link.sent}, what="the others are sent")
    worker.check()
    worker.close()
    (part,) = (one for one in link.failures.parts if one.part == "backlog")
    assert part.working
    with opened(tmp_path, session_id=8) as store:
        assert store.find((7, BacklogKind.STILL, 2)) is not None, "it is not lost"


ROWS = {
    "session": "UPDATE object SET session = '00000000000000g1' WHERE kind = 'still'",
    "negative session": "UPDATE object SET session = '-1' WHERE kind = 'still'",
    "kind": "UPDATE object SET kind = 'stilm' WHERE kind = 'still'",
    "rank": "UPDATE object SET rank = 'a' WHERE kind = 'still'",
    "number": "UPDATE object SET number = 'a' WHERE kind = 'still'",
    "negative number": "UPDATE object SET number = -4 WHERE kind = 'still'",
    "span": "UPDATE object SET span_ns = 'a' WHERE kind = 'still'",
    "size": "UPDATE object SET bytes = 'a' WHERE kind = 'still'",
    "time of a frame": "UPDATE part SET capture_ns = 'x' WHERE frame_index = 3",
    "index of a frame": "UPDATE part SET frame_index = -5 WHERE frame_index = 3",
    "no table": "DROP TABLE part",
}


@pytest.mark.parametrize("what", ROWS)
def test_a_file_that_somebody_has_changed_ends_nothing(tmp_path, what):
    """One row that no edge has written would end each flight, until somebody deletes the file."""
    link = Link()
    with opened(tmp_path) as store:
        add_units(store, UNITS[:20])
        add_stills(store, {1: 1.0})
    with closing(sqlite3.connect(tmp_path / "backlog.sqlite")) as db, db:
        db.execute(ROWS[what])
    worker = worker_of(tmp_path, link, session_id=8)
    for _ in range(3):  # whatever had to wait for another try
        eventually(lambda: worker.intake.idle, what="it reads")
        link.now_ns += 70 * S
    worker.offer(shifted(UNITS[0], 1000))

    def stores() -> bool:
        worker.check()
        link.now_ns += 70 * S
        return worker.offer(shifted(UNITS[0], 1000)) and worker.numbers.segments > 0

    eventually(stores, what="frames are stored all the same")
    worker.close()


def test_what_was_sent_and_not_acknowledged_is_known_after_the_last_chunk(tmp_path):
    """A goodbye that does not wait for it loses it with the session: the ground's account would be another."""
    link = Link()
    with opened(tmp_path) as store:
        add_stills(store, {3: 1.0})
    worker = worker_of(tmp_path, link)
    eventually(lambda: link.sent, what="a chunk is sent")
    worker.send_no_more()
    sent_bytes = sum(len(chunk.data) for _, chunk in link.sent)
    time.sleep(0.3)  # turns in which nothing may be counted that does not leave
    assert worker.numbers.unacknowledged_bytes == sent_bytes == link.sent[0][1].total_bytes
    worker.intake.on_acknowledged([arrived("still", 3, sent_bytes)], receiver_id=1)
    eventually(lambda: not worker.numbers.unacknowledged_bytes, what="it has arrived")
    worker.close()
