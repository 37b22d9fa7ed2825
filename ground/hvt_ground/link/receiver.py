"""The messages of one edge, parsed, counted and put in order: bytes in, packets out. No threads, no session."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any

from hvt_common.protocol.channels import Channel, parse_key
from hvt_common.protocol.messages import (
    BacklogHeader,
    BaseHeader,
    CaptureTimes,
    Feedback,
    Flags,
    PoseReport,
    RoiHeader,
    Status,
    TrackStep,
    UnknownVersionError,
    WireError,
)
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_ground.link.reassemble import Arrival, Reassembler

_log = logging.getLogger(__name__)

_Message = BaseHeader | RoiHeader | BacklogHeader | TrackStep | PoseReport | Status
_KINDS: Mapping[Channel, type[_Message]] = {
    Channel.BASE: BaseHeader,
    Channel.ROI: RoiHeader,
    Channel.BACKLOG: BacklogHeader,
    Channel.TRACKS: TrackStep,
    Channel.POSE: PoseReport,
    Channel.STATUS: Status,
}
_ATTACHED = (Channel.BASE, Channel.ROI, Channel.BACKLOG)
_SILENT_NS = 2_000_000_000
"""A keyframe is requested only of an edge that sent something within this time."""
_MOST_HELD = 16
"""Stills, and poses, that are held for a session that is not open yet."""
_UNSEEN_NS, _UNSEEN = 15 * SECOND_NS, 3
"""An edge reports for 15 s that it sent pictures, 3 at least, of which none came. A keyframe is coded for less than a
second of the rate: it takes that long on a link of a fifteenth of it."""
_OVERDUE_NS = 4 * SECOND_NS
"""After this time without the keyframe of a session the edge is told so: it still has the pictures of 5 s."""
_AGAIN_NS = 60 * SECOND_NS
"""Between two warnings: sessions' ids cost a forger nothing, and a log is not to fill."""


@dataclass(frozen=True, slots=True)
class Packet:
    """Any message but an access unit, which is an `Arrival`."""

    header: RoiHeader | TrackStep | PoseReport | BacklogHeader | Status
    item: Received

    def is_of(self, session_id: int) -> bool:
        if isinstance(self.header, PoseReport):
            return self.header.is_of(session_id)
        return self.header.session_id == session_id


@dataclass(slots=True)
class Unseen:
    """A session that is not open although its edge sends pictures, from its first report on."""

    first: Status
    since_ns: int
    corrupt: int
    """Access units that had come damaged by then."""
    came: set[bool] = field(default_factory=set)
    """Whether access units of the edge came: True for a keyframe, False for another."""
    lost: int = 0
    """Pictures that the edge is to be told of; 0 while the first may be under way."""

    def note(self, status: Status, now_ns: int) -> bool:
        """Take a further report of the edge; whether its keyframes have not come for long."""
        if status.base_messages < self.first.base_messages:  # one of the two was forged
            self.first, self.since_ns = status, now_ns
        sent, first = status.base_messages - self.first.base_messages, self.first.health.keyframes
        # Keyframes that come are not lost; who joins between two of them waits for the next one.
        if True in self.came or (self.came and status.health.keyframes == first):
            sent = 0
        lasts_ns = now_ns - self.since_ns
        self.lost = sent if lasts_ns >= _OVERDUE_NS else 0
        return lasts_ns >= _UNSEEN_NS and sent >= _UNSEEN

    def feedback(self, **of_receiver: Any) -> Feedback:
        """The report of a ground that waits: nothing of the session can be shown."""
        return Feedback(
            session_id=self.first.session_id,
            last_frame_index=-1,
            base_messages=0,
            base_bytes=0,
            roi_messages=0,
            roi_bytes=0,
            lost=self.lost,
            corrupt=0,
            base_sequence=-1,
            base_held_us=0,
            still_sequence=-1,
            missing_stills=(),
            delay_p50_ms=-1.0,
            stills=(),
            **of_receiver,
        )


class Uptime:
    """Counts a gap between two messages only as far as both their arrival and their handling show it.

    While the thread was away the sender was not silent, so by arrival the gap is small. And a sender that waited for
    this side's answer in the meantime was not silent either: by handling that gap is small. Both clocks are one.
    """

    def __init__(self) -> None:
        self._lived_ns = 0
        self._arrived_ns: int | None = None
        self._handled_ns = 0

    def handle(self, *, arrived_ns: int, now_ns: int) -> int:
        """Return the time of the message that is taken up now; never less than before."""
        arrived_ns = min(arrived_ns, now_ns)
        if self._arrived_ns is None:
            self._lived_ns = now_ns
        else:
            self._lived_ns += max(0, min(arrived_ns - self._arrived_ns, now_ns - self._handled_ns))
            arrived_ns = max(arrived_ns, self._arrived_ns)
        self._arrived_ns, self._handled_ns = arrived_ns, now_ns
        return self._lived_ns

    def at(self, now_ns: int, *, pending: bool) -> int:
        """Return the time now; with messages ``pending`` it is still that of the last one taken up."""
        if self._arrived_ns is None:
            return now_ns
        return self._lived_ns + (0 if pending else max(0, now_ns - self._handled_ns))


class Receiver:
    """Receives one edge, over all its sessions; ``clock`` is Unix nanoseconds without steps.

    Messages of other ``versions`` are skipped.
    """

    def __init__(self, edge: str, *, clock: Callable[[], int], versions: Sequence[int]) -> None:
        self._edge = edge
        self._versions = versions
        self._clock = clock
        self.stream = Reassembler[Received]()
        """The base stream, over all sessions."""
        self._other: int | None = None
        """The session of a second edge of this id that was noted last."""
        self._other_said_ns: int | None = None
        self._held: Mapping[type[_Message], deque[Packet]] = {
            Status: deque(maxlen=1),
            PoseReport: deque(maxlen=_MOST_HELD),
            RoiHeader: deque(maxlen=_MOST_HELD),
        }
        self.unseen: Unseen | None = None
        """The session of the newest report, if it is not open."""
        self._uptime = Uptime()
        self._captures = CaptureTimes()
        self._last_message_ns = time.monotonic_ns()
        self.unusable = 0
        """Messages that were skipped: damaged, foreign, or of another version."""
        self.other_version = ""
        """The remedy, as a sentence, where the newest message is of another version."""

    @property
    def silent_ns(self) -> int:
        """For how long nothing has come."""
        return time.monotonic_ns() - self._last_message_ns

    def receive(self, item: Received) -> Sequence[Arrival[Received] | Packet]:
        """The packets of one message: none if it is unusable or waits, several if it fills a hole."""
        self._last_message_ns, self.other_version = time.monotonic_ns(), ""
        at_ns = self._uptime.handle(arrived_ns=item.received_ns, now_ns=self._clock())
        parsed = parse_key(item.key)
        row = parsed[1] if parsed else None
        try:
            kind = _KINDS.get(row) if row else None
            if kind is None:
                return []
            parts = (item.attachment, item.payload) if row in _ATTACHED else (item.payload, b"")
            message: _Message | None = kind.parse(*parts, versions=self._versions)
            match message:
                case BaseHeader():
                    self._captures.note(message)
                    if self.unseen is not None:
                        self.unseen.came.add(bool(message.flags & Flags.KEYFRAME))
                    return self.stream.accept(message, item, now_ns=at_ns)
                case RoiHeader():
                    otherwise_ns = item.received_ns - message.send_delay_ns
                    message = self._captures.filled(message, otherwise_ns=otherwise_ns)
            return [] if message is None else [Packet(message, item)]
        except WireError as error:
            if row is Channel.BASE and not isinstance(error, UnknownVersionError):
                self.stream.corrupt()
            self.skip(str(row), error)
        return []

    def take_overdue(self, *, pending: bool) -> list[Arrival[Received]]:
        """Access units that have waited long enough behind a hole; ``pending``: messages wait to be received."""
        return self.stream.overdue(now_ns=self._uptime.at(self._clock(), pending=pending))

    def missing(self) -> tuple[int, ...]:
        """The access units to tell the edge of (`Reassembler.named`)."""
        return self.stream.named(self._uptime.at(self._clock(), pending=False))

    def take_keyframe_request(self, *, pending: bool) -> bool:
        """Whether to request a keyframe now, which is noted; ``pending``: messages wait to be received."""
        at_ns = self._uptime.at(self._clock(), pending=pending)
        if self.silent_ns > _SILENT_NS or not self.stream.wants_keyframe(at_ns):
            return False
        self.stream.keyframe_requested(at_ns)
        return True

    def is_unseen(self, status: Status, now_ns: int) -> bool:
        """Whether the edge has said for long that it sends pictures of a session of which no keyframe comes."""
        of = status.session_id, self.stream.counters.corrupt
        if status.state == "ended":
            self.unseen = None
        elif self.unseen is None or (self.unseen.first.session_id, self.unseen.corrupt) != of:
            self.unseen = Unseen(status, now_ns, of[1])
        return self.unseen is not None and self.unseen.note(status, now_ns)

    def hold(self, packet: Packet) -> None:
        """Hold a still, a pose, or the first report of a session: it may overtake the keyframe that begins it."""
        header = packet.header
        if not (isinstance(header, Status) and header.sequence > 0):
            self._held[type(header)].append(packet)

    def take_held(self) -> list[Packet]:
        """Hand them out, once: the report, then poses and stills, each in the order in which they came."""
        packets = [*chain.from_iterable(self._held.values())]
        for held in self._held.values():
            held.clear()
        return packets

    def duplicate_notice(self, session_id: int, *, shown: int) -> str | None:
        """The notice of a second edge of this id; None if it was given lately."""
        self._other, now_ns = session_id, time.monotonic_ns()
        if self._other_said_ns is not None and now_ns - self._other_said_ns < _AGAIN_NS:
            return None
        self._other_said_ns = now_ns
        text = (
            f"two edges call themselves {self._edge}: the session {shown:08x} is shown, {session_id:08x} is not; "
            "stop one of them, or start it with an --edge-id of its own"
        )
        _log.warning("%s", text)
        return text

    def skip(self, row: str, error: WireError) -> None:
        """Count an unusable message."""
        self.unusable += 1
        if isinstance(error, UnknownVersionError):
            self.other_version = error.between(f"edge {self._edge}", "this ground")
        elif self.unusable.bit_count() == 1:  # 1, 2, 4, 8 …: a flood does not fill the log
            _log.warning("%s: %s message unusable (%d so far): %s", self._edge, row, self.unusable, error)

    def skip_stranger(self, row: str, session_id: int) -> None:
        """Count a message of a session that is not open."""
        if session_id == self._other:  # of which enough has been said
            self.unusable += 1
        else:
            self.skip(row, WireError(f"it belongs to the session {session_id:08x}, which is not shown"))
