"""An edge that is started again and again, as a supervisor does with one that crashes: its ground stays as it is."""

import ctypes
import gc
import os
import pickle
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from hvt_archive.exports.extra import TableOptions
from hvt_common.runtime.failures import Failures
from hvt_common.transport.inbox import Received
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_ground.backlog.edge_backlog import BacklogRecordings
from hvt_ground.config import check
from hvt_ground.report.state import StateMaker
from hvt_ground.report.status import status_text, summary
from hvt_ground.session.edge_sessions import EdgeSessions, join
from hvt_ground.session.session import Session
from hvt_ground.session.subscribe import GroundLink
from hvt_ground.sinks import Outputs
from hvt_ground.wiring import Models, SessionFactory
from programs.outsider import joined
from programs.processes import PATIENT_S, eventually
from rigs.examples import Clock
from rigs.flight import Flight

SESSIONS, WARM, HALF = 200, 59, 70
FRAMES = 6
MOST_GROWTH_BYTES, MOST_BLOCKS = 20_000, 100
"""A session. Threads that happen to close a recording at that moment hold less than that."""


class Held:
    """What this process holds: in use, not what its allocators keep for later, which is by chance."""

    def __init__(self) -> None:
        gc.collect()
        self.types = types_alive()
        self.blocks = sys.getallocatedblocks()
        info = ctypes.CDLL(None).mallinfo2
        info.restype = _MallInfo
        found = info()
        self.native_bytes = found.uordblks + found.hblkhd
        self.threads = sum(1 for _ in Path("/proc/self/task").iterdir())
        self.files = sum(1 for _ in Path("/proc/self/fd").iterdir())


def types_alive() -> Counter[str]:
    """How many objects of each type there are, counted in a copy of this process where no thread goes on.

    Here ``gc.get_objects`` would hold the tuples that other threads are still making, and those threads would
    end with a SystemError.
    """
    reads, writes = os.pipe()
    child = os.fork()
    if not child:
        try:
            with os.fdopen(writes, "wb") as pipe:
                pickle.dump(Counter(name_of(type(one)) for one in gc.get_objects()), pipe)
        finally:
            os._exit(0)
    os.close(writes)
    with os.fdopen(reads, "rb") as pipe:
        counted = pickle.load(pipe)
    os.waitpid(child, 0)
    return counted


def name_of(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


class _MallInfo(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]


class Restarted:
    """An edge on the link: one session after the other, each of a few real access units."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self.flight = Flight(FRAMES)
        self._info = session.declare_queryable("hvt/uav-1/info", self._answer)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            query.reply("hvt/uav-1/info", self.flight.info().pack())

    def begin(self, number: int) -> None:
        self.flight.session_id = 1_000_000 + number
        self._put(*(self.flight.base(index) for index in range(FRAMES)))

    def end(self, *, crashes: bool) -> None:
        """A still and a report; one that crashes says nothing of an end."""
        state = "running" if crashes else "ended"
        self._put(self.flight.still(1, 0), self.flight.status(base=FRAMES, roi=1, state=state))

    def _put(self, *items: Received) -> None:
        for item in items:
            self._session.put(
                item.key,
                item.payload,
                attachment=item.attachment or None,
                encoding=item.encoding or None,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )


@contextmanager
def served(link: GroundLink, folder: Path, ended: list[str], clock: Clock) -> Iterator[EdgeSessions]:
    """The edge's thread with sessions as `hvt-ground` makes them; ``ended`` gets one word a session."""
    config = check(TableOptions(record=folder, tracks=folder, detector="motion", classifier="none"))
    outputs, models = Outputs(Failures(time.time_ns)), Models(config)
    factory = SessionFactory(config, models, clock=clock, outputs=outputs)

    def note(session: Session) -> None:
        assert summary(session)["frames_decoded"] == FRAMES, summary(session)
        ended.append(session.failure)

    eventually(link.ports, what="the edge is seen")
    (port,) = link.ports()
    sessions = EdgeSessions(
        port,
        open_session=factory.open_session,
        on_ended=note,
        recordings=BacklogRecordings(factory.open_backlog),
        clock=clock,
    ).start()
    try:
        yield sessions
    finally:
        assert join([sessions], timeout_s=PATIENT_S)
        outputs.close()
    assert sessions.error is None


@pytest.mark.nightly
def test_two_hundred_sessions_leave_nothing_behind(free_port: int, tmp_path: Path) -> None:
    """After a night with a drone that restarts every minute the ground would be killed for its memory."""
    endpoint, ended, clock = f"tcp/127.0.0.1:{free_port}", list[str](), Clock(time.time_ns())
    watching = threading.Event()
    maker = StateMaker(time.time_ns)

    def watch() -> None:
        while not watching.wait(0.001):
            status_text(maker.make([("uav-1", sessions)]))

    with (
        open_session(LinkSettings("ground", listen=(endpoint,))) as session,
        GroundLink(session, edges="*", clock=clock) as link,
        joined(endpoint) as outsider,
        outsider.liveliness().declare_token("hvt/uav-1/alive"),
        served(link, tmp_path, ended, clock) as sessions,
    ):
        edge = Restarted(outsider)
        watcher = threading.Thread(target=watch)
        watcher.start()
        held = []
        try:
            for number in range(SESSIONS):
                crashes = number % 2 == 1
                edge.begin(number)
                eventually(lambda: is_open(sessions, edge), what=f"{number} has begun")
                edge.end(crashes=crashes)
                if crashes:
                    eventually(lambda: sessions.session.reception.is_whole, what=f"{number} has come")
                else:
                    eventually(lambda before=number: len(ended) > before, what=f"{number} has ended")
                clock.now_ns += 7 * SECOND_NS
                if number + 1 in (WARM, WARM + HALF, WARM + 2 * HALF):
                    eventually(lambda: recordings() <= 1, what="all recordings but the open one are closed")
                if number in (
                    WARM,
                    WARM + HALF,
                    WARM + 2 * HALF,
                ):  # its sinks are there for those that were closed
                    held.append(Held())
        finally:
            watching.set()
            watcher.join()
        alive = types_alive()[name_of(Session)]
    assert len(ended) == SESSIONS
    assert not any(ended), [one for one in ended if one]
    assert len(list(tmp_path.glob("*.rrd"))) == SESSIONS
    assert alive <= 2, "the one that is open, and the one before it in the edge's hands"
    stays(*held)


def recordings() -> int:
    """How many are written or closed."""
    return sum(one.name.startswith("hvt-recording of") for one in threading.enumerate())


def stays(before: Held, between: Held, after: Held) -> None:
    """Objects, memory, threads and files are what they were. What grows once, as by an import, is no leak."""
    halves = (before, between), (between, after)
    types = [two.types - one.types for one, two in halves]
    more = {one: types[1][one] for one in types[1] if min(each[one] for each in types) > HALF // 2}
    assert not more, "one each session, or two"
    assert min(two.blocks - one.blocks for one, two in halves) < HALF * MOST_BLOCKS
    assert min(two.native_bytes - one.native_bytes for one, two in halves) < HALF * MOST_GROWTH_BYTES
    eventually(lambda: Held().threads <= before.threads + 2, what="threads have ended")
    eventually(lambda: Held().files <= before.files + 2, what="files are closed")


def is_open(sessions: EdgeSessions, edge: Restarted) -> bool:
    session = sessions.session
    return session is not None and session.info.session_id == edge.flight.session_id
