"""One edge at the ground: its messages in, sessions out. Runs in a thread of its own, which no callback waits for."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from hvt_common import __version__
from hvt_common.protocol.channels import DELIVERIES, Channel, parse_key
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.ledger import Account
from hvt_common.protocol.messages import (
    BacklogHeader,
    BacklogKind,
    BaseHeader,
    Info,
    RoiHeader,
    Status,
    TrackStep,
    UnknownVersionError,
    WireError,
)
from hvt_common.runtime.clock import SteadyClock
from hvt_common.transport.inbox import Received
from hvt_ground.backlog.delivery import BacklogDelivery
from hvt_ground.backlog.recordings import BacklogRecording, BacklogRecordings
from hvt_ground.link.other_sessions import DuplicatePublishers, PreSessionBuffer
from hvt_ground.link.reassemble import Arrival, Reassembler, StreamCounters
from hvt_ground.link.statistics import Uptime
from hvt_ground.session.receiver_report import Reports
from hvt_ground.session.session import GroundSession
from hvt_ground.session.subscribe import EdgePort

__all__ = ["EdgeReceiver"]

_log = logging.getLogger(__name__)

_SECOND_NS = 1_000_000_000
_ENDED_PATIENCE_NS = 2 * _SECOND_NS
"""How long the rest of a session may take to arrive after its edge has said that it ended."""
_INFO_TRIES = 3
_SILENT_NS = 2 * _SECOND_NS
"""A keyframe is asked for only while the edge is heard."""
_TELL_NS = 3 * _SECOND_NS
"""After so long without another chunk the log says how much came of what was kept."""
_DRAIN_NS = _SECOND_NS
"""How long what has already arrived is still taken in when the ground stops."""


class EdgeReceiver:
    """Parses, counts, reassembles, and hands on to the session; asks for keyframes; reports back.

    Args:
        port: of the edge.
        open_session: makes what the messages of a session go to.
        clock: the port's, Unix nanoseconds without steps; one of its own by default.
        open_backlog: makes what goes to a session that is over; without it nothing of one is taken.
        patience_s: an edge whose token is gone and that sends nothing for so long has ended without saying so.
    """

    def __init__(
        self,
        port: EdgePort,
        *,
        open_session: Callable[[Info, EdgeReceiver], GroundSession],
        clock: Callable[[], int] | None = None,
        open_backlog: Callable[[Info], BacklogRecording] | None = None,
        patience_s: float = 5.0,
    ) -> None:
        self.port = port
        self._clock = clock or SteadyClock()
        self.clock_offset = ClockOffset()
        self.session: GroundSession | None = None
        self.done: list[GroundSession] = []
        """Sessions that have ended."""
        self.reassembler: Reassembler[BaseHeader] = Reassembler()
        self.unusable = 0
        """Messages that were skipped: damaged, foreign, or of another version."""
        self.error: BaseException | None = None
        self._open_session = open_session
        self._patience_ns = round(patience_s * _SECOND_NS)
        self._ended_ns: int | None = None
        self._ended_id: int | None = None
        self._early = PreSessionBuffer()
        self._duplicates = DuplicatePublishers(port.edge)
        self.backlog = BacklogDelivery(
            port.edge, recordings=None if open_backlog is None else BacklogRecordings(open_backlog)
        )
        """What was kept while the link was away."""
        self._reports = Reports(port, clock=self._clock, clock_offset=self.clock_offset, backlog=self.backlog)
        self._backlog_ns: int | None = None
        """When the last chunk of it came, of which nothing has been told yet."""
        self._worked_ns = 0
        self._stop_ns = 0
        self._counted = StreamCounters()
        """The counters when the session before ended."""
        self._last_message_ns = time.monotonic_ns()
        self._time = Uptime()
        """That the reassembly goes by."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"hvt-receive-{port.edge}", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        """Whether no session is open (any more)."""
        return self.session is None

    def close(self) -> None:
        """Finish what has arrived, close the session, join the thread."""
        self.stop()
        self._thread.join(4.0)

    def stop(self) -> None:
        """Begin to finish; `close` waits for it. Several receivers finish in the time of one."""
        if not self._stop.is_set():
            self._stop_ns = time.monotonic_ns()
            self._stop.set()
            self.port.inbox.close()

    # The thread

    def _run(self) -> None:
        try:
            while not self._finished():
                item = self.port.inbox.get(timeout_s=0.0 if self.backlog.has_work else 0.05)
                if item is not None:
                    self._handle(item)
                self._work_on_backlog(came=item is not None)
                self._housekeep()
            self._end_session()
            self.backlog.close()
        except BaseException as error:  # noqa: BLE001 - handed to the app, which ends the process
            self.error = error

    def _work_on_backlog(self, *, came: bool) -> None:
        """A frame of it when nothing came, and where something always does ten a second."""
        if not self.backlog.has_work:
            return
        now_ns = time.monotonic_ns()
        if not came or now_ns - self._worked_ns > _SECOND_NS // 10:
            self._worked_ns = now_ns
            self.backlog.work()

    def _finished(self) -> bool:
        if not self._stop.is_set():
            return False
        return len(self.port.inbox) == 0 or time.monotonic_ns() - self._stop_ns > _DRAIN_NS

    def _handle(self, item: Received) -> None:
        self._last_message_ns = time.monotonic_ns()
        at_ns = self._time.handle(arrived_ns=item.received_ns, now_ns=self._clock())
        parsed = parse_key(item.key)
        row = parsed[1] if parsed else None
        try:
            if row is Channel.BASE:
                self._base(BaseHeader.parse(item.attachment, item.payload), item, at_ns=at_ns)
            elif row is Channel.ROI:
                self._still(RoiHeader.parse(item.attachment, item.payload), item)
            elif row is Channel.TRACKS:
                self._tracks(TrackStep.parse(item.payload), item)
            elif row is Channel.BACKLOG:
                self._backlog(BacklogHeader.parse(item.attachment, item.payload), item)
            elif row is Channel.STATUS:
                self._status(Status.parse(item.payload), item)
        except WireError as error:
            if row is Channel.BASE:
                self.reassembler.corrupt()
            self._skip(str(row), error)

    def _base(self, header: BaseHeader, item: Received, *, at_ns: int) -> None:
        for arrival in self.reassembler.accept(header, item.payload, now_ns=at_ns):
            if arrival.duplicate:
                self._note_duplicate(arrival.header.session_id)
            if (arrival.starts_session and not self._goes_on(arrival.header)) or (
                arrival.starts_run and self._may_resume(arrival.header.session_id)
            ):
                self._begin_session(arrival.header.session_id)
                if self.session is None:
                    self.reassembler.decoder_failed()  # the next keyframe is the next try
            session = self.session
            if session is None or arrival.verdict not in ("decode", "skip"):
                continue
            if arrival.header.session_id != session.info.session_id:
                continue
            if arrival.lost_before:
                session.note("warning", f"{arrival.lost_before} base messages lost; waiting for a keyframe")
            self._to_session(session, arrival, item)

    def _to_session(self, session: GroundSession, arrival: Arrival[BaseHeader], item: Received) -> None:
        # A unit that waited behind a hole comes out with a later message: it keeps its own bytes and header.
        own = item
        if arrival.payload is not item.payload:
            own = replace(item, payload=arrival.payload, attachment=arrival.header.pack(arrival.payload))
        # Of one that waited behind a hole only the number counts: the time is that of the message that freed it.
        if own is item:
            self._reports.reception_statistics.base(
                arrival.header,
                size_bytes=own.size_bytes,
                arrived_ns=item.received_ns,
                delay_ms=None if session.lockstep else self._reports.delay_ms(arrival.header, item),
            )
        decodable = arrival.verdict == "decode"
        if not session.base(arrival.header, own, decode=decodable, starts_run=arrival.starts_run):
            self.reassembler.decoder_failed()

    def _still(self, header: RoiHeader, item: Received) -> None:
        session = self.session
        if session is None:
            self._early.still(header, item)
            return
        if header.session_id != session.info.session_id:
            self._skip_stranger("roi", header.session_id)
            return
        media_type = item.encoding.partition(";")[0] or DELIVERIES[Channel.ROI].encoding
        self._reports.reception_statistics.still(
            header.sequence, size_bytes=item.size_bytes, arrived_ns=item.received_ns
        )
        session.still(header, item, media_type=media_type)

    def _tracks(self, step: TrackStep, item: Received) -> None:
        session = self.session
        if session is None or step.session_id != session.info.session_id:
            self._skip_stranger("tracks", step.session_id)
            return
        session.tracks(step, item)

    def _backlog(self, header: BacklogHeader, item: Received) -> None:
        session = self.session
        if session is None:
            self._skip("backlog", WireError("it was kept, and no session is open to take it"))
            return
        self._reports.reception_statistics.backlog(size_bytes=item.size_bytes, arrived_ns=item.received_ns)
        self._backlog_ns = time.monotonic_ns()
        delivered = False
        try:
            delivered = self.backlog.chunk(header, item.payload, session=session)
        finally:
            session.backlog_chunk(header, item, delivered=delivered)
        if delivered and header.kind == BacklogKind.STILL and header.session_id == session.info.session_id:
            self._reports.reception_statistics.stored_still(header.number)

    def _status(self, status: Status, item: Received) -> None:
        session = self.session
        if session is None or status.session_id != session.info.session_id:
            self._early.status(status, item)
            return
        session.status(status, item)
        if status.state == "ended":
            self._ended_ns = time.monotonic_ns()

    # Sessions

    def _may_resume(self, session_id: int) -> bool:
        """Whether a session that is not open here goes on at the edge: after an outage, or a lost answer to info."""
        return self.session is None and session_id != self._ended_id

    def _goes_on(self, header: BaseHeader) -> bool:
        """Whether the open session comes back from an interruption that was none of its own."""
        session = self.session
        if session is None or header.session_id != session.info.session_id:
            return False
        return header.frame_index > session.newest_index

    def _begin_session(self, session_id: int) -> None:
        info = self._query_info(session_id)
        if info is None and self.session is not None and self.refresh_clock() is not None:
            self.reassembler.disown()
            self._skip("base", WireError(f"the edge does not know of a session {session_id:016x}"))
            return
        self._end_session()
        if info is None:
            self._skip("info", WireError("the edge does not say what its session is"))
            return
        self._ended_ns = None
        self._reports.begin(lockstep=info.pace == "lockstep")
        self.session = self._open_session(info, self)
        if (first := self._early.take_status()) is not None:
            self._status(*first)
        for still in self._early.take_stills():
            self._still(*still)

    def _query_info(self, session_id: int) -> Info | None:
        for _ in range(_INFO_TRIES):
            if (info := self.refresh_clock(session_id)) is not None:
                return info
            if self._stop.is_set():
                break
        return None

    def refresh_clock(self, session_id: int | None = None) -> Info | None:
        """Ask the edge what it is and what time it has; by default the one that is shown.

        Another edge of the same id may run on a machine with another clock.
        """
        session = self.session
        if session_id is None and session is not None:
            session_id = session.info.session_id
        answer = self.port.query_info(session_id)
        if answer is None:
            return None
        info, requested_ns, answered_ns = answer
        if info.edge != self.port.edge:  # it names files and keys: another's name is nobody's
            self._skip("info", WireError(f"the edge says that it is {info.edge!r:.40}"))
            return None
        self.clock_offset.add(
            t0_ns=requested_ns, t1_ns=info.received_ns, t2_ns=info.answered_ns, t3_ns=answered_ns
        )
        if info.software != __version__:
            _log.info("%s runs version %s, this is %s", self.port.edge, info.software, __version__)
        return info

    def _end_session(self) -> None:
        session, self.session = self.session, None
        if session is None:
            return
        if self._ended_ns is not None:
            self._ended_id = session.info.session_id
        self._ended_ns = None
        session.counters = self.reassembler.counters.since(self._counted)
        self.done.append(session)
        try:
            self.backlog.finish()
            session.close()
            self._report(session)
            while self.backlog.unsaid:  # one report names a few
                self._report(session)
            self.backlog.session_ended(session.info)
        finally:
            self._counted = replace(self.reassembler.counters)

    # What goes back

    def report_now(self) -> None:
        """Report at once: the edge waits for it (lockstep), or a still was read."""
        if self.session is not None:
            self._report(self.session)

    def _housekeep(self) -> None:
        now_ns = time.monotonic_ns()
        at_ns = self._time.at(self._clock(), pending=len(self.port.inbox) > 0)
        if now_ns - self._last_message_ns < _SILENT_NS and self.reassembler.wants_keyframe(at_ns):
            self.reassembler.keyframe_requested(at_ns)
            self.port.request_keyframe()
            if self.session is not None:
                self.session.note("warning", "keyframe requested")
        session = self.session
        if session is None:
            return
        session.raise_error()
        if self._backlog_ns is not None and now_ns - self._backlog_ns > _TELL_NS and self.backlog.idle:
            self._backlog_ns = None
            session.report_backlog()
        if self._reports.reception_statistics.due(now_ns=self._clock()):
            self._report(session)
        if self._is_over(session, now_ns):
            gone = self._ended_ns is None
            self._end_session()
            if gone:
                self.reassembler.decoder_failed()  # should it come back, it starts with a keyframe

    def _is_over(self, session: GroundSession, now_ns: int) -> bool:
        if self._ended_ns is not None and session.last_status is not None:
            last, messages = session.last_status, session.ledger.messages
            wanted = last.base_messages, last.roi_messages, last.backlog_messages
            acknowledged_range = session.frames_received, messages(Account.ROI), messages(Account.BACKLOG)
            # A report does not count itself. Track steps have no number of their own there: they are metadata.
            metadata = messages(Account.META) > last.meta_messages
            whole = metadata and all(
                one >= other for one, other in zip(acknowledged_range, wanted, strict=True)
            )
            return (whole and self.backlog.idle) or now_ns - self._ended_ns > _ENDED_PATIENCE_NS
        return not self.port.present.is_set() and now_ns - self._last_message_ns > self._patience_ns

    def _report(self, session: GroundSession) -> None:
        counters = self.reassembler.counters.since(self._counted)
        self._reports.send(session, lost=counters.lost, corrupt=counters.corrupt)

    def _note_duplicate(self, session_id: int) -> None:
        """A second edge of this id is there, and not shown."""
        if self.session is None:
            return
        shown, now_ns = self.session.info.session_id, time.monotonic_ns()
        text = self._duplicates.note(session_id, shown=shown, now_ns=now_ns)
        if text is not None:
            _log.warning("%s", text)
            self.session.note("warning", text)

    def _skip_stranger(self, row: str, session_id: int) -> None:
        """What is of neither this session nor the one that follows."""
        if self._duplicates.knows(session_id):
            self.unusable += 1
        else:
            self._skip(row, WireError(f"it belongs to the session {session_id:016x}, which is not shown"))

    def _skip(self, row: str, error: WireError) -> None:
        self.unusable += 1
        if self.unusable.bit_count() == 1:  # 1, 2, 4, 8 …: a flood does not fill the log
            kind = "of another version" if isinstance(error, UnknownVersionError) else "unusable"
            _log.warning("%s: %s message %s (%d so far): %s", self.port.edge, row, kind, self.unusable, error)
