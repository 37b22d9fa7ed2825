"""One edge at the ground: its messages in, sessions out. Runs in a thread of its own, which no callback waits for."""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from hvt_common import __version__
from hvt_common.link.clock import ClockOffset
from hvt_common.link.inbox import Received
from hvt_common.link.keys import DELIVERIES, Row, parse_key
from hvt_common.link.ledger import Channel
from hvt_common.link.wire import (
    MAX_STILL_RESULTS,
    BaseHeader,
    Feedback,
    Info,
    RoiHeader,
    Status,
    TrackStep,
    UnknownVersionError,
    WireError,
)
from hvt_ground.reassemble import Arrival, Counters, Reassembler
from hvt_ground.reception import Reception, StepFree
from hvt_ground.session import GroundSession
from hvt_ground.subscribe import EdgePort

__all__ = ["EdgeReceiver"]

_log = logging.getLogger(__name__)

_SECOND_NS = 1_000_000_000
_ENDED_PATIENCE_NS = 2 * _SECOND_NS
"""How long the rest of a session may take to arrive after its edge has said that it ended."""
_GONE_NS = 5 * _SECOND_NS
"""An edge whose token is gone and that sends nothing for so long has ended without saying so."""
_INFO_TRIES = 3
_HEARD_NS = 2 * _SECOND_NS
"""A keyframe is asked for only while the edge is heard."""
_DRAIN_NS = _SECOND_NS
"""How long what has already arrived is still taken in when the ground stops."""


class EdgeReceiver:
    """Parses, counts, reassembles, and hands on to the session; asks for keyframes; reports back."""

    def __init__(
        self, port: EdgePort, *, open_session: Callable[[Info, EdgeReceiver], GroundSession]
    ) -> None:
        self.port = port
        self.clock_offset = ClockOffset()
        self.session: GroundSession | None = None
        self.done: list[GroundSession] = []
        """Sessions that have ended."""
        self.reassembler: Reassembler[BaseHeader] = Reassembler()
        self.unusable = 0
        """Messages that were skipped: damaged, foreign, or of another version."""
        self.error: BaseException | None = None
        self._open_session = open_session
        self._receiver_id = secrets.randbits(64)
        self._report_sequence = 0
        self._report_lock = threading.Lock()
        self._reception = Reception()
        self._step_free = StepFree(wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())
        self._ended_ns: int | None = None
        self._ended_id: int | None = None
        self._first_status: tuple[Status, Received] | None = None
        """The first report of a session may overtake the keyframe that begins it; it counts all the same."""
        self._stop_ns = 0
        self._counted = Counters()
        """The counters when the session before ended."""
        self._heard_ns = time.monotonic_ns()
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
                item = self.port.inbox.get(timeout_s=0.05)
                if item is not None:
                    self._handle(item)
                self._keep_house()
            self._end_session()
        except BaseException as error:  # noqa: BLE001 - handed to the app, which ends the process
            self.error = error

    def _finished(self) -> bool:
        if not self._stop.is_set():
            return False
        return len(self.port.inbox) == 0 or time.monotonic_ns() - self._stop_ns > _DRAIN_NS

    def _handle(self, item: Received) -> None:
        self._heard_ns = time.monotonic_ns()
        parsed = parse_key(item.key)
        row = parsed[1] if parsed else None
        try:
            if row is Row.BASE:
                self._base(BaseHeader.parse(item.attachment, item.payload), item)
            elif row is Row.ROI:
                self._still(RoiHeader.parse(item.attachment, item.payload), item)
            elif row is Row.TRACKS:
                self._tracks(TrackStep.parse(item.payload), item)
            elif row is Row.STATUS:
                self._status(Status.parse(item.payload), item)
        except WireError as error:
            if row is Row.BASE:
                self.reassembler.corrupt()
            self._skip(str(row), error)

    def _base(self, header: BaseHeader, item: Received) -> None:
        for arrival in self.reassembler.accept(header, item.payload, now_ns=time.monotonic_ns()):
            if arrival.starts_session or (arrival.starts_run and self._may_resume(arrival.header.session_id)):
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
            self._reception.base(
                arrival.header,
                size_bytes=own.size_bytes,
                arrived_ns=self._without_steps_ns(item.received_ns),
                delay_ms=None if session.lockstep else self._delay_ms(arrival.header, item),
            )
        decodable = arrival.verdict == "decode"
        if not session.base(arrival.header, own, decode=decodable, starts_run=arrival.starts_run):
            self.reassembler.decoder_failed()

    def _still(self, header: RoiHeader, item: Received) -> None:
        session = self.session
        if session is None or header.session_id != session.info.session_id:
            self._skip("roi", WireError("a still of another session"))
            return
        media_type = item.encoding.partition(";")[0] or DELIVERIES[Row.ROI].encoding
        self._reception.still(
            header.sequence, size_bytes=item.size_bytes, arrived_ns=self._without_steps_ns(item.received_ns)
        )
        session.still(header, item, media_type=media_type)

    def _tracks(self, step: TrackStep, item: Received) -> None:
        session = self.session
        if session is None or step.session_id != session.info.session_id:
            self._skip("tracks", WireError("tracks of another session"))
            return
        session.tracks(step, item)

    def _status(self, status: Status, item: Received) -> None:
        session = self.session
        if session is None or status.session_id != session.info.session_id:
            if status.sequence == 0:
                self._first_status = (status, item)
            return
        session.status(status, item)
        if status.state == "ended":
            self._ended_ns = time.monotonic_ns()

    # Sessions

    def _may_resume(self, session_id: int) -> bool:
        """Whether a session that is not open here goes on at the edge: after an outage, or a lost answer to info."""
        return self.session is None and session_id != self._ended_id

    def _begin_session(self, session_id: int) -> None:
        self._end_session()
        info = self._ask_info(session_id)
        if info is None:
            self._skip("info", WireError("the edge does not say what its session is"))
            return
        self._ended_ns = None
        with self._report_lock:
            self._reception = Reception(lockstep=info.pace == "lockstep")
        self.session = self._open_session(info, self)
        first, self._first_status = self._first_status, None
        if first is not None:
            self._status(*first)

    def _ask_info(self, session_id: int) -> Info | None:
        for _ in range(_INFO_TRIES):
            info = self.refresh_clock()
            if info is not None and info.session_id == session_id:
                return info
            if self._stop.is_set():
                break
        return None

    def refresh_clock(self) -> Info | None:
        """Ask the edge what it is and what time it has."""
        answer = self.port.ask_info()
        if answer is None:
            return None
        info, asked_ns, heard_ns = answer
        if info.edge != self.port.edge:  # it names files and keys: another's name is nobody's
            self._skip("info", WireError(f"the edge says that it is {info.edge!r:.40}"))
            return None
        self.clock_offset.add(t0_ns=asked_ns, t1_ns=info.received_ns, t2_ns=info.answered_ns, t3_ns=heard_ns)
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
            session.close()
            self._report(session)
        finally:
            self._counted = replace(self.reassembler.counters)

    # What goes back

    def report_now(self) -> None:
        """Report at once: the edge waits for it (lockstep), or a still was read."""
        if self.session is not None:
            self._report(self.session)

    def _keep_house(self) -> None:
        now_ns = time.monotonic_ns()
        if now_ns - self._heard_ns < _HEARD_NS and self.reassembler.wants_keyframe(now_ns):
            self.reassembler.keyframe_requested(now_ns)
            self.port.request_keyframe()
            if self.session is not None:
                self.session.note("warning", "keyframe requested")
        session = self.session
        if session is None:
            return
        session.raise_error()
        if self._reception.due(now_ns=self._without_steps_ns(time.time_ns())):
            self._report(session)
        if self._is_over(session, now_ns):
            gone = self._ended_ns is None
            self._end_session()
            if gone:
                self.reassembler.decoder_failed()  # should it come back, it starts with a keyframe

    def _is_over(self, session: GroundSession, now_ns: int) -> bool:
        if self._ended_ns is not None and session.last_status is not None:
            wanted = session.last_status.base_messages, session.last_status.roi_messages
            have = session.frames_received, session.stills_received
            # A report does not count itself. Track steps have no number of their own there: they are metadata.
            metadata = session.ledger.messages(Channel.META) > session.last_status.meta_messages
            complete = have[0] >= wanted[0] and have[1] >= wanted[1] and metadata
            return complete or now_ns - self._ended_ns > _ENDED_PATIENCE_NS
        return not self.port.present.is_set() and now_ns - self._heard_ns > _GONE_NS

    def _report(self, session: GroundSession) -> None:
        counters = self.reassembler.counters.since(self._counted)
        with self._report_lock:
            send_ns = self._without_steps_ns(time.time_ns())
            measured = self._reception.take(send_ns)
            delay_ms = measured.delay_p50_ms
            error_ns = self.clock_offset.error_ns
            feedback = Feedback(
                session_id=session.info.session_id,
                receiver_id=self._receiver_id,
                sequence=self._report_sequence,
                send_ns=send_ns,
                last_frame_index=session.last_frame_index,
                base_messages=session.frames_received,
                base_bytes=session.ledger.base_bytes,
                roi_messages=session.stills_received,
                roi_bytes=session.ledger.roi_bytes,
                lost=counters.lost,
                corrupt=counters.corrupt,
                base_sequence=measured.base_sequence,
                base_held_us=measured.base_held_us,
                still_sequence=measured.still_sequence,
                delay_p50_ms=-1.0 if delay_ms is None else min(delay_ms, 3_600_000.0),
                clock_offset_ns=self.clock_offset.offset_ns or 0,
                clock_error_ns=-1 if error_ns is None else error_ns,
                stills=session.take_results(MAX_STILL_RESULTS),
            )
            self._report_sequence += 1
            self.port.report(feedback)

    def _without_steps_ns(self, noted_ns: int) -> int:
        return self._step_free.time_ns(noted_ns, wall_ns=time.time_ns(), monotonic_ns=time.monotonic_ns())

    def _delay_ms(self, header: BaseHeader, item: Received) -> float:
        return max(0.0, (item.received_ns - self.clock_offset.to_local_ns(header.capture_ns)) / 1e6)

    def _skip(self, row: str, error: WireError) -> None:
        self.unusable += 1
        if self.unusable.bit_count() == 1:  # 1, 2, 4, 8 …: a flood does not fill the log
            kind = "of another version" if isinstance(error, UnknownVersionError) else "unusable"
            _log.warning("%s: %s message %s (%d so far): %s", self.port.edge, row, kind, self.unusable, error)
