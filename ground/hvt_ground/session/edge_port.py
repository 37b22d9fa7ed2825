"""One edge on the ground's link: its messages, a way to query it, and the reports to it. Knows no frames."""

from __future__ import annotations

import logging
import secrets
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.clock_offset import ClockOffset
from hvt_common.protocol.messages import (
    MAX_ACKNOWLEDGED_RANGES,
    Command,
    ControlRequest,
    Feedback,
    Info,
    InfoRequest,
    WireError,
)
from hvt_common.runtime.failures import RetryPause
from hvt_common.transport.inbox import FloodWatch, Inbox, Received, TokenBucket
from hvt_common.transport.link_doctor import control_unanswered
from hvt_common.transport.session import declare_publisher, query_later
from hvt_common.units import SECOND_NS
from hvt_ground.backlog.edge_backlog import EdgeBacklog

_log = logging.getLogger(__name__)

_INBOX_MESSAGES = 1024
_INBOX_SHARE = 0.75
"""Share of the inbox for one channel: reports by the thousand do not keep pictures out."""
_MOST_PER_S = 2000
"""Messages of one row from one edge. A camera has 240 pictures a second at the very most."""
_MOST_REPORTS_PER_S = 100
"""An edge reports its state each second, in lockstep each second of its clip. Each report costs all sinks a turn."""
_ANSWER_S = 1.0
_MOST_ANSWERS, _MOST_ERRORS = 4, 16
_UNANSWERED = 3
"""Three queries on control in a row without an answer are no accident."""

InfoAnswer = tuple[Info, int, int]
"""A session's facts with the times of asking and hearing, ns."""


@dataclass(eq=False)
class EdgePort:
    """One edge as the link knows it: its messages in order of arrival, its presence, and a way to talk to it.

    ``put`` is for Zenoh's callbacks, `close` for any thread, all else for the edge's thread, which gets the errors of
    callbacks by `raise_error`.
    """

    session: zenoh.Session
    edge: str
    _: KW_ONLY
    clock: Callable[[], int]
    log: Callable[[Received], None] | None = None
    still_codecs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self._requester_id = secrets.randbits(64)
        self.inbox = Inbox(capacity=_INBOX_MESSAGES, share=_INBOX_SHARE)
        self._flood = FloodWatch(most_per_s=_MOST_PER_S)
        self._reports = TokenBucket(burst=_MOST_REPORTS_PER_S, every_ns=SECOND_NS // _MOST_REPORTS_PER_S)
        self.present = threading.Event()
        """Set while the edge's liveliness token is there."""
        self.used = threading.Event()
        """Set while there is more to this edge than messages under its name: a session that is open."""
        self.used_channels = set[Channel]()
        """Those on which something has come; `GroundLink` may forget them while no reports come."""
        self.resubscription: RetryPause | None = None
        """Until its silent channels are subscribed to again (`GroundLink`)."""
        self.reported_ns = 0
        """When its newest report came; 0 before the first."""
        self._unanswered = self._unusable = 0
        self._keys = EdgeKeys(self.edge)
        self._feedback: zenoh.Publisher | None = None
        self._sending = threading.Lock()
        """Zenoh raises where a publisher is undeclared while another thread puts into it."""
        self._closed = False
        self._errors: deque[Exception] = deque(maxlen=_MOST_ERRORS)
        self._answers: deque[InfoAnswer] = deque(maxlen=_MOST_ANSWERS)

    def query_info(self, session_id: int) -> InfoAnswer | None:
        """Wait for the facts of that session, of another edge of this id none; None without an answer in time."""
        found: deque[InfoAnswer] = deque()
        over = threading.Event()
        self._query_info(session_id, found, on_end=over.set)
        over.wait(2 * _ANSWER_S)
        return found[0] if found else None

    def request_info(self, session_id: int) -> None:
        """Like `query_info`, without waiting: `take_info` has the answer, if one comes."""
        self._query_info(session_id, self._answers, on_end=lambda: None)

    def take_info(self) -> InfoAnswer | None:
        """An answer to `request_info`, once."""
        return self._answers.popleft() if self._answers else None

    def _query_info(self, session_id: int, found: deque[InfoAnswer], *, on_end: Callable[[], None]) -> None:
        requested_ns = self.clock()

        def note(data: bytes) -> None:
            answered_ns = self.clock()
            if self.log is not None:
                self.log(Received(self._keys[Channel.INFO], data, b"", "", answered_ns))
            try:
                info = Info.parse(data)
            except WireError as error:
                self._unusable += 1
                if self._unusable.bit_count() == 1:  # 1, 2, 4, 8 …: anybody may answer, as often as he likes
                    _log.warning(
                        "%s: its answer to info cannot be used (%d so far): %s",
                        self.edge,
                        self._unusable,
                        error,
                    )
                return
            if info.session_id == session_id:
                found.append((info, requested_ns, answered_ns))
                on_end()

        request = InfoRequest(requester_id=self._requester_id, still_codecs=self.still_codecs)
        self._query(Channel.INFO, request.pack(), on_answer=note, on_end=on_end)

    def fail(self, error: Exception) -> None:
        self._errors.append(error)

    def raise_error(self) -> None:
        if self._errors:
            raise self._errors.popleft()

    def put(self, item: Received, row: Channel) -> None:
        """Take a message in, or drop it: without room, or where an edge reports without end."""
        self.used_channels.add(row)
        if row == Channel.STATUS:
            self.reported_ns = item.received_ns
            if not self._reports.take(item.received_ns):
                return
        if self.log is not None:
            self.log(item)
        self.inbox.put(item)
        if self._flood.note(row, now_ns=item.received_ns) is not None:
            _log.warning(
                "%s: more than %d messages a second on %s, far more than an edge sends: somebody else publishes "
                "in its name (docs/security.md has keys against that); what finds no room is dropped",
                self.edge,
                _MOST_PER_S,
                row,
            )

    def request_keyframe(self) -> None:
        """Ask for a keyframe; does not wait for the answer, which is the keyframe."""
        request = ControlRequest(session_id=0, command=Command.KEYFRAME, arguments={})
        answered = threading.Event()
        self._query(
            Channel.CONTROL,
            request.pack(),
            on_answer=lambda _answer: answered.set(),
            on_end=lambda: self._note_control(answered=answered.is_set()),
        )

    def _query(
        self, row: Channel, question: bytes, *, on_answer: Callable[[bytes], None], on_end: Callable[[], None]
    ) -> None:
        def take(data: bytes) -> None:
            try:
                on_answer(data)
            except Exception as error:  # noqa: BLE001 - for the edge's thread
                self.fail(error)

        try:
            query_later(
                self.session,
                row,
                keys=self._keys,
                question=question,
                timeout_s=_ANSWER_S,
                on_answer=take,
                on_end=on_end,
            )
        except zenoh.ZError:
            on_end()

    def _note_control(self, *, answered: bool) -> None:
        # Say once that nothing is answered: a question without the right to ask is dropped in silence.
        self._unanswered = 0 if answered else self._unanswered + 1
        if self._unanswered == _UNANSWERED and self.present.is_set():
            _log.warning("%s", control_unanswered(self.session, self.edge))

    def report(self, feedback: Feedback) -> None:
        with suppress(zenoh.ZError), self._sending:
            if self._closed:
                return
            if self._feedback is None:
                self._feedback = declare_publisher(self.session, Channel.FEEDBACK, keys=self._keys)
            self._feedback.put(feedback.pack())

    def close(self) -> None:
        """No more comes, and nothing goes out."""
        self.inbox.close()
        with self._sending, suppress(zenoh.ZError):  # the session may be closed
            self._closed = True
            if self._feedback is not None:
                self._feedback.undeclare()  # type: ignore[no-untyped-call]
                self._feedback = None


@dataclass(eq=False)
class ReceiverReports:
    """Makes and sends them, in the order of their numbers; ``clock`` is Unix nanoseconds without steps."""

    publish: Callable[[Feedback], None]
    _: KW_ONLY
    clock: Callable[[], int]
    clock_offset: ClockOffset
    backlog: EdgeBacklog

    def __post_init__(self) -> None:
        self._receiver_id = secrets.randbits(64)
        self._sequence = 0
        self._lock = threading.Lock()

    def send(self, feedback_of: Callable[..., Feedback]) -> None:
        """Send the report of ``feedback_of``, which takes the fields of the receiver: time and counts."""
        with self._lock:
            offset_ns, error_ns = self.clock_offset.estimate or (0, -1)
            feedback = feedback_of(
                receiver_id=self._receiver_id,
                sequence=self._sequence,
                send_ns=self.clock(),
                clock_offset_ns=offset_ns,
                clock_error_ns=error_ns,
                backlog=self.backlog.take_acknowledged_ranges(MAX_ACKNOWLEDGED_RANGES),
            )
            self._sequence += 1
            self.publish(feedback)
