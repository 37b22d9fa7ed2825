"""One edge at the ground: its packets are routed to its sessions, which begin and end here."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Self

from hvt_common import __version__
from hvt_common.errors import foreign
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import (
    BASE_CODEC,
    SPOKEN_VERSIONS,
    BacklogHeader,
    BaseHeader,
    Info,
    PoseReport,
    RoiHeader,
    Status,
    TrackStep,
    WireError,
)
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures, RetryPause, Turns, reason_of
from hvt_common.runtime.log import log_fields
from hvt_common.runtime.process import joined
from hvt_common.transport.inbox import Received, TokenBucket
from hvt_common.units import SECOND_NS
from hvt_ground.backlog.edge_backlog import BacklogRecordings, EdgeBacklog
from hvt_ground.link.reassemble import Arrival, StreamCounters
from hvt_ground.link.receiver import Packet, Receiver
from hvt_ground.session.edge_port import EdgePort, InfoAnswer, ReceiverReports
from hvt_ground.session.session import Session

_BASE_CODECS = (BASE_CODEC, "hevc")
"""The second is the name in version 4."""
_log = logging.getLogger(__name__)

_INFO_TRIES = 3
_BACKLOG_PAUSE_NS = 3 * SECOND_NS
"""After a pause of chunks this long the recording says how much of the backlog came."""
_UNSEEN_EVERY_NS = SECOND_NS // 2
"""Between two reports that no keyframe comes."""
_CLOCK_EVERY_NS = 20 * SECOND_NS
"""Time between two queries of the edge's clock."""
_NO_PICTURE = (
    "the edge sends pictures, and only small messages come: something on the way drops large packets (lower the MTU "
    "of the tunnel, docs/deployment.md), or the link is too slow for a picture"
)
_BURST, _EVERY_NS = 30, 5 * SECOND_NS
"""Up to 30 sessions begin at once, then one in 5 s: each is a file, and has a log of its own."""


class EdgeSessions:
    """Routes messages to the open session; requests keyframes and lets the session report.

    Any exception ends the open session, with its recording whole, and nothing else: another session begins with
    the next keyframe, after a pause that grows where it goes wrong again and again. For one thread: that of `start`,
    which no callback of the link waits for, or without it another's.

    ``on_ended`` takes each session when it is closed. ``clock`` is Unix nanoseconds without steps. Without
    ``recordings``, which are closed with this, nothing of a session that is over is taken. An edge without a token
    that sends nothing for ``patience_s`` has ended; where it said so, the rest has ``ended_patience_s`` to arrive.
    """

    def __init__(
        self,
        port: EdgePort,
        *,
        open_session: Callable[[Info, ReceiverReports], Session],
        on_ended: Callable[[Session], None] = lambda _session: None,
        clock: Callable[[], int] | None = None,
        recordings: BacklogRecordings | None = None,
        patience_s: float = 5.0,
        ended_patience_s: float = 2.0,
        pause: RetryPause | None = None,
        versions: Sequence[int] = SPOKEN_VERSIONS,
    ) -> None:
        self.port = port
        self._open_session = open_session
        self._on_ended = on_ended
        self._patience_ns = round(patience_s * SECOND_NS)
        self._ended_patience_ns = round(ended_patience_s * SECOND_NS)
        self._clock = clock or SteadyClock()
        self._pause = pause or RetryPause()
        self._beginnings = TokenBucket(burst=_BURST, every_ns=_EVERY_NS)
        self.failures = Failures(self._clock)
        self.backlog = EdgeBacklog(port.edge, recordings=recordings)
        self._clock_offset = ClockOffset()
        self._reports = ReceiverReports(
            port.report, clock=self._clock, clock_offset=self._clock_offset, backlog=self.backlog
        )
        self.receiver = Receiver(port.edge, clock=self._clock, versions=versions)
        self._ended_ns: int | None = None
        """When the edge said that the open session has ended."""
        self._ended_id: int | None = None
        self._lost_id: int | None = None
        """The session that ended as its edge was gone: only its stored objects may still come."""
        self._backlog_ns: int | None = None
        """When the last chunk of it came that nothing has been said of."""
        self._next_clock_ns = self._next_unseen_ns = 0
        self.session: Session | None = None
        """The one that is open."""
        self.ended = 0
        self.disconnected = False
        """The newest was closed here, as without a link, and has not ended at its edge."""
        self._part, self._video = f"session of {port.edge}", f"video of {port.edge}"
        self._turns = Turns(self._video, self.failures)
        self._unseen_failure = 0
        self.error: BaseException | None = None
        self._stopped_ns: int | None = None

    def start(self, *, drain_s: float = 6.0) -> Self:
        """Begin the thread. When it stops, arrived messages are still taken in, for at most ``drain_s``."""
        self._drain_ns = round(drain_s * SECOND_NS)
        name = f"hvt-receive-{self.port.edge}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Begin to finish; `join` waits for it."""
        if self._stopped_ns is None:
            self._stopped_ns = time.monotonic_ns()
            self.port.inbox.close()

    @property
    def finished(self) -> bool:
        return not self._thread.is_alive()

    def _run(self) -> None:
        inbox = self.port.inbox
        log_fields(edge=self.port.edge)
        try:
            while self._stopped_ns is None or (
                (left := len(inbox)) and time.monotonic_ns() - self._stopped_ns <= self._drain_ns
            ):
                item = inbox.get(timeout_s=0.05)
                self.work(item, pending=len(inbox) > 0)
            if left:
                self.failures.failed(
                    self._part,
                    f"{left} of the messages that had come are not in it: it ended before",
                    last=True,
                )
            self.close()
        except BaseException as error:  # noqa: BLE001 - handed to the app, which ends the process
            self.error = error

    @property
    def idle(self) -> bool:
        return self.session is None

    def work(self, item: Received | None, *, pending: bool) -> None:
        """Take one message, if there is one, and do all that is due; ``pending``: more wait. It never raises."""
        try:
            self.port.raise_error()
            if item is not None:
                self.handle(item)
            self.housekeep(pending=pending)
        except foreign() as error:  # it ends one session of one edge, whatever it is
            self._fail(error)

    def handle(self, item: Received) -> None:
        """Take one message; raises whatever goes wrong with it."""
        for packet in self.receiver.receive(item):
            self._route(packet)
        if self.session is None and self.receiver.other_version:
            self._say_unseen(self.receiver.other_version)
        self._note_held()

    def _note_held(self) -> None:
        # Missing units are reported at once: each moment more is one without a picture.
        session, missing, newest = self.session, self.receiver.missing(), self.receiver.stream.newest_held
        if session is None:
            return
        if not missing or newest is None or newest.header.session_id != session.info.session_id:
            session.reception.note_held((), None, at_ns=0)
        elif session.reception.note_held(missing, newest.header, at_ns=newest.message.received_ns):
            session.report()

    def close(self) -> None:
        """End the session that is open, and close the recordings of former ones."""
        self.disconnected = self.session is not None and self._ended_ns is None
        self._end_session()
        # The summaries are there all the same.
        self.failures.attempt(f"recordings of former sessions of {self.port.edge}", self.backlog.close, None)

    # Housekeeping

    def housekeep(self, *, pending: bool) -> None:
        """Do all that is due by now; raises any exception of it."""
        for packet in self.receiver.take_overdue(pending=pending):
            self._route(packet)
        self._note_held()
        session, now_ns = self.session, time.monotonic_ns()
        if self._pause.due(now_ns) and self.receiver.take_keyframe_request(pending=pending):
            if session is not None:
                session.report()  # a request is free where losses are known
            self.port.request_keyframe()
            if session is not None:
                session.note("warning", "the ground has asked for a keyframe")
        if session is not None:
            self._serve(session, now_ns)
        waits = self.receiver.unseen
        if waits is not None and self.receiver.silent_ns > self._patience_ns:
            self.receiver.unseen = None
            self._say_unseen("")
        elif waits is not None and waits.lost and now_ns >= self._next_unseen_ns:
            self._next_unseen_ns = now_ns + _UNSEEN_EVERY_NS
            self._reports.send(waits.feedback)

    def _serve(self, session: Session, now_ns: int) -> None:
        if session.take_resumed():
            self.port.request_keyframe()
        session.worker.raise_error()
        paused = self._backlog_ns is not None and now_ns - self._backlog_ns > _BACKLOG_PAUSE_NS
        if paused and not self.backlog.working:
            self._backlog_ns = None
            session.report_backlog()
        session.report_if_due()
        self._refresh_clock(session, now_ns)
        if clock := self._clock_offset.estimate:  # its error is half a round trip
            self.receiver.stream.repair.round_trip_ns = 2 * clock[1]
        if self._is_over(session, now_ns):
            gone = self._ended_ns is None
            self._end_session()
            if gone:
                self._lost_id = session.info.session_id
                self.receiver.stream.decoder_failed()  # should it come back, it starts with a keyframe

    def _refresh_clock(self, session: Session, now_ns: int) -> None:
        # Ask the edge for its time now and then; nothing waits for the answer.
        while (answer := self.port.take_info()) is not None:
            info = self._learn(answer)
            if info is not None and info.session_id == session.info.session_id:
                session.reception.learn(info)
        if now_ns >= self._next_clock_ns and self.port.present.is_set():
            self._next_clock_ns = now_ns + _CLOCK_EVERY_NS
            self.port.request_info(session.info.session_id)

    def _query_info(self, session_id: int) -> Info | None:
        answer = self.port.query_info(session_id)
        return None if answer is None else self._learn(answer)

    def _learn(self, answer: InfoAnswer) -> Info | None:
        info, requested_ns, answered_ns = answer
        if info.edge != self.port.edge:  # it names files and keys: another's name is nobody's
            self.receiver.skip("info", WireError(f"the edge says that it is {info.edge!r:.40}"))
            return None
        if info.codec not in _BASE_CODECS:
            text = f"the edge sends video of {info.codec!r:.40}, and this ground reads {BASE_CODEC}: none is shown"
            self.receiver.skip("info", WireError(text))
            self._pause.failed(time.monotonic_ns())  # its keyframes are of no use here
            return None
        self._clock_offset.add(
            t0_ns=requested_ns, t1_ns=info.received_ns, t2_ns=info.answered_ns, t3_ns=answered_ns
        )
        if info.software != __version__:
            _log.info("%s runs version %s, this is %s", self.port.edge, info.software, __version__)
        return info

    # Routing

    def _route(self, packet: Arrival[Received] | Packet) -> None:
        if isinstance(packet, Arrival):
            self._base(packet)
            if self.session is not None:  # else it is of no use yet
                self.failures.works(self._video)
                self._unseen_failure = 0
            return
        session, header, item = self.session, packet.header, packet.item
        row = item.key.rpartition("/")[2]
        try:
            if isinstance(header, BacklogHeader):
                self._backlog(header, item)
            elif session is not None and packet.is_of(session.info.session_id):
                session.take(header, item)
                if isinstance(header, Status) and header.state == "ended":
                    self._ended_ns = time.monotonic_ns()
            elif isinstance(header, PoseReport | Status) or (
                isinstance(header, RoiHeader) and session is None
            ):
                self.receiver.hold(packet)  # it may overtake the first keyframe of its session
                # An edge that was restarted may be heard, and not seen, while its former session is still open.
                alone = session is None or session.reception.health(self._clock()) is None
                if isinstance(header, Status) and alone:
                    self._say_unseen(_NO_PICTURE if self.receiver.is_unseen(header, item.received_ns) else "")
            elif isinstance(header, TrackStep) and session is None:
                pass  # who joins between two keyframes gets some; the next ones say all of it again
            else:
                self.receiver.skip_stranger(row, header.session_id)
        except WireError as error:
            self.receiver.skip(row, error)

    def _say_unseen(self, reason: str) -> None:
        if not reason:
            self.failures.over(self._video, self._unseen_failure)
            self._unseen_failure = 0
        elif not self._unseen_failure:
            self._unseen_failure = self.failures.failed(self._video, reason)

    def _base(self, arrival: Arrival[Received]) -> None:
        session_id = arrival.header.session_id
        if arrival.duplicate and self.session is not None:
            text = self.receiver.duplicate_notice(session_id, shown=self.session.info.session_id)
            if text is not None:
                self.session.note("warning", text)
        begins = arrival.starts_session and not self._goes_on(arrival.header)
        if begins or (arrival.starts_run and self.session is None and session_id != self._ended_id):
            if self._pause.due(time.monotonic_ns()):
                self._begin_session(session_id)
            if self.session is None:
                self.receiver.stream.decoder_failed()  # the next keyframe is the next try
        session = self.session
        usable = arrival.verdict in ("decode", "skip")
        if session is None or not usable or session_id != session.info.session_id:
            return
        if arrival.lost_before:
            lost = "1 picture was" if arrival.lost_before == 1 else f"{arrival.lost_before} pictures were"
            session.note("warning", f"{lost} lost: the ground waits for a keyframe")
        with nullcontext() if session.lockstep else self._turns:  # where others may be waited for
            decoded = session.base(arrival)
        if not decoded:
            self.receiver.stream.decoder_failed()

    def _goes_on(self, header: BaseHeader) -> bool:
        # Whether the open session comes back from an interruption that was none of its own.
        session = self.session
        if session is None or header.session_id != session.info.session_id:
            return False
        return header.frame_index > session.reception.newest_index

    def _backlog(self, header: BacklogHeader, item: Received) -> None:
        lost = self.session is None and header.session_id == self._lost_id
        if lost and self._pause.due(time.monotonic_ns()):
            self._begin_session(header.session_id)
        session = self.session
        if session is None:
            raise WireError("it was stored, and no session is open to take it")
        self._backlog_ns = time.monotonic_ns()
        delivered = False
        try:
            delivered = self.backlog.chunk(header, item.payload, own=session.backlog, worker=session.worker)
        finally:
            session.reception.backlog(header, item, delivered=delivered)

    # Sessions

    def _begin_session(self, session_id: int) -> None:
        due, info = self._pause.due, None
        for _ in range(_INFO_TRIES):
            if info is None and due(time.monotonic_ns()):
                info = self._query_info(session_id)
        shown = self.session
        if info is None and shown is not None and self._query_info(shown.info.session_id) is not None:
            self.receiver.stream.disown()
            self.receiver.skip("base", WireError(f"the edge does not know of a session {session_id:08x}"))
            return
        self._end_session()
        if info is None:
            if due(time.monotonic_ns()):  # else its answer was of no use
                self.receiver.skip("info", WireError("the edge does not say what its session is"))
            return
        if not self._beginnings.take(self._clock()):
            text = f"the edge begins sessions again and again: one in {_EVERY_NS // SECOND_NS} s is shown"
            self.receiver.skip("base", WireError(text))
            return
        self.port.used.set()
        self._next_clock_ns = time.monotonic_ns() + _CLOCK_EVERY_NS
        log_fields(session=f"{info.session_id:08x}")
        self.session = self._open_session(info, self._reports)
        self.session.reception.counters = self.receiver.stream.counters
        self.receiver.unseen = None
        self.failures.works(self._part)
        for packet in self.receiver.take_held():
            self._route(packet)

    def _end_session(self) -> None:
        session, self.session = self.session, None
        if session is None:
            return
        if self._ended_ns is not None:
            self._ended_id = session.info.session_id
        self._ended_ns = None
        self.receiver.stream.counters = StreamCounters()
        self.ended += 1
        for step in (session.close, partial(self._report_end, session), partial(self._on_ended, session)):
            try:
                step()
            except Exception as error:  # noqa: BLE001 - the steps after it are due all the same
                self._say_failed(error, session)
        self.port.used.clear()
        log_fields(session="")

    def _report_end(self, session: Session) -> None:
        session.report()
        while self.backlog.unreported:  # one report names a few
            session.report()
        self.backlog.session_ended(session.info)

    def _fail(self, error: BaseException) -> None:
        # End the session that is open; the next begins with a keyframe, not before the pause is over.
        self._pause.failed(time.monotonic_ns())
        self._say_failed(error, self.session)
        self._end_session()
        self.receiver.stream.decoder_failed()

    def _say_failed(self, error: BaseException, session: Session | None) -> None:
        if session is not None:
            if session.failure:
                return  # one fault may come to light in several places
            session.failure = reason_of(error)
        self.failures.failed(self._part, reason_of(error))

    def _is_over(self, session: Session, now_ns: int) -> bool:
        if self._ended_ns is None:
            return not self.port.present.is_set() and self.receiver.silent_ns > self._patience_ns
        whole = session.reception.is_whole and not self.backlog.working
        return whole or now_ns - self._ended_ns > self._ended_patience_ns


def join(edges: Sequence[EdgeSessions], *, timeout_s: float = 4.0) -> bool:
    """Finish arrived messages, close sessions, join threads (`joined`) in the time of one; False where one hangs."""
    for one in edges:
        one.stop()
    threads = [one._thread for one in edges]  # noqa: SLF001 - of this module
    return joined(*threads, left=lambda: sum(len(one.port.inbox) for one in edges), within_s=timeout_s)
