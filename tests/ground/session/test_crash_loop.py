"""An edge that is started again and again, as a supervisor does with one that crashes: its ground stays as it is."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from hvt_common.runtime.failures import Failures
from hvt_common.runtime.process import give_back_holes, limit_malloc_arenas
from hvt_common.transport.inbox import Received
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_ground.backlog.recordings import BacklogRecordings
from hvt_ground.config import GroundConfig, check
from hvt_ground.report.state import StateMaker
from hvt_ground.report.status import status_text, summary
from hvt_ground.session.edge_sessions import EdgeSessions, EdgeThread
from hvt_ground.session.session import GroundSession
from hvt_ground.session.subscribe import GroundLink
from hvt_ground.sinks import Outputs
from hvt_ground.wiring import Models, SessionFactory
from programs.outsider import joined
from programs.processes import PATIENT_S, eventually
from rigs.flight import Flight

SESSIONS, WARM = 200, 59
FRAMES = 6
MOST_GROWTH_BYTES = 24 * 2**20
"""Between the 60th and the 200th session: what one session leaves behind would be 140 times as much."""


class Clock:
    """Stands while a session flies, however long that takes; between two an edge has to be silent for seconds."""

    def __init__(self) -> None:
        self.now_ns = time.time_ns()

    def __call__(self) -> int:
        return self.now_ns


class Use:
    """What a process holds."""

    def __init__(self, pid: int | str = "self") -> None:
        self.pid = pid
        status = Path(f"/proc/{pid}/status").read_text().splitlines()
        fields = dict(line.split(":", 1) for line in status)
        # Its own memory: pages of libraries that other tests load meanwhile are no session's.
        self.own_bytes = int(fields["RssAnon"].split()[0]) * 1024
        self.threads = int(fields["Threads"])
        self.files = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())


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
        """The pictures of another session."""
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
    config = check(GroundConfig(record=folder, tracks=folder, detector="motion", classifier="none"))
    outputs, models = Outputs(Failures(time.time_ns)), Models(config)
    factory = SessionFactory(config, models, clock=clock, outputs=outputs, view=None)

    def note(session: GroundSession) -> None:
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
    )
    thread = EdgeThread(sessions)
    try:
        yield sessions
    finally:
        assert thread.close(timeout_s=PATIENT_S)
        outputs.close()
    assert thread.error is None


@pytest.mark.nightly
def test_two_hundred_sessions_leave_nothing_behind(free_port: int, tmp_path: Path) -> None:
    """After a night with a drone that restarts every minute the ground would be killed for its memory."""
    limit_malloc_arenas()  # as hvt-ground does
    endpoint, ended, clock = f"tcp/127.0.0.1:{free_port}", list[str](), Clock()
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
        before = None
        try:
            for number in range(SESSIONS):
                crashes = number % 2 == 1
                edge.begin(number)
                eventually(lambda: is_open(sessions, edge), what=f"{number} has begun")
                edge.end(crashes=crashes)
                if crashes:
                    eventually(lambda: sessions.session.is_whole, what=f"{number} has come")
                else:
                    eventually(lambda before=number: len(ended) > before, what=f"{number} has ended")
                clock.now_ns += 7 * SECOND_NS
                if number == WARM:
                    before = closed_and_used()
            after = closed_and_used()
        finally:
            watching.set()
            watcher.join()
        # Not before: a tuple that another thread is still making must not be seen.
        alive = sum(isinstance(one, GroundSession) for one in gc.get_objects())
    assert before is not None
    assert len(ended) == SESSIONS
    assert not any(ended)
    assert len(list(tmp_path.glob("*.rrd"))) == SESSIONS
    assert alive <= 2, "the one that is open, and the one before it in the edge's hands"
    stays(before, after)


def closed_and_used() -> Use:
    """What this process holds once the recordings of sessions that ended have got their footers."""

    def recording() -> int:
        return sum(one.name.startswith("hvt-recording of") for one in threading.enumerate())

    eventually(lambda: recording() <= 1, what="all recordings but the open one are closed")
    gc.collect()
    give_back_holes()
    return Use()


def stays(before: Use, after: Use) -> None:
    """Memory, threads and files are what they were."""
    most = before.own_bytes + MOST_GROWTH_BYTES

    def given_back() -> bool:  # on a busy machine what was in hand goes a little later
        gc.collect()
        give_back_holes()
        return Use(after.pid).own_bytes < most

    eventually(given_back, what="memory is given back")
    eventually(lambda: Use(after.pid).threads <= before.threads + 2, what="threads have ended")
    eventually(lambda: Use(after.pid).files <= before.files + 2, what="files are closed")


def is_open(sessions: EdgeSessions, edge: Restarted) -> bool:
    """Whether the edge's session has begun."""
    session = sessions.session
    return session is not None and session.info.session_id == edge.flight.session_id
