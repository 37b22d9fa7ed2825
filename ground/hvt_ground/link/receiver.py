"""The messages of one edge, parsed, counted and put in order: bytes in, packets out. No threads, no session."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from hvt_common.protocol.channels import Channel, parse_key
from hvt_common.protocol.messages import (
    BacklogHeader,
    BaseHeader,
    CaptureTimes,
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
        self._unseen: tuple[tuple[int, int], int, int] | None = None
        """The first report since a picture came: its session and how many pictures had come damaged, how many were
        sent by then, and when the report came."""
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
                    self._unseen = None
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

    def is_unseen(self, status: Status | None, now_ns: int) -> bool:
        """Whether the edge has said for long that it sends pictures of which none comes; None: it says nothing."""
        of = None if status is None else (status.session_id, self.stream.counters.corrupt)
        if status is None or status.state == "ended" or (self._unseen is not None and self._unseen[0] != of):
            self._unseen = None
        if status is None or of is None:
            return False
        if self._unseen is None:
            self._unseen = of, status.base_messages, now_ns
        _, sent, since_ns = self._unseen
        return now_ns - since_ns >= _UNSEEN_NS and status.base_messages - sent >= _UNSEEN

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
