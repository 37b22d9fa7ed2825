"""The one place where bytes leave the edge: header, ledger and budget of every message in one step.

Base first, then metadata, stills by utility, the backlog. Five threads send:

* the frame loop: `base`, `status`, `pose`, and the objects that it stores instead; it waits for video alone;
* the stills' thread: `tracks` and `still`;
* the thread of requested stills: `still`;
* the store's thread: `backlog`;
* the link's callbacks: `reply` to queries of ``info`` and ``control``, and `resend` of missing access units.

The lock covers header, ledger and budget, never a wait or a ``put``. So a still whose ``put`` blocks holds up stills
alone; a base frame finds the lock free and a publisher of its own.

``now_ns`` is the time of the budget's windows: the wall clock in real time, media time in lockstep, so that the same
input gives the same stills. It is also the send time on the wire, so that the ground's ledger has exactly the same
windows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Protocol

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import (
    MAX_PAYLOAD_BYTES,
    BacklogHeader,
    BacklogStill,
    BaseHeader,
    CaptureTimes,
    Flags,
    ObjectKey,
    PackedMessage,
    RoiHeader,
    fitted_text,
)
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES, RollingBudget
from hvt_edge.link.pacer import BaseInFlight, Pacer
from hvt_edge.link.stills import Still

STILL_ATTACHMENT_BYTES = 55
"""Typical size of the `RoiHeader` of one track with the usual names: for estimates before a still exists.
`Transmitter.still_allowance_bytes` of an existing still counts its own header."""
BACKLOG_ATTACHMENT_BYTES = 48
"""The largest `BacklogHeader`."""
LEAST_CHUNK_BYTES, _MOST_CHUNK_BYTES = 1_000, 12_000
_CHUNK_S = 0.05
"""Longest time that a chunk occupies the link, so that a frame or a live still need not wait for it."""
_RESEND_WAIT_NS = 150_000_000
_GROWTH_BYTES = 16
"""Growth of a message that is made for a later moment: its two times."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes of one stored object."""

    key: ObjectKey
    offset: int
    total_bytes: int
    data: bytes


class Outlet(Protocol):
    """Takes the bytes: the link, or in the study a sink."""

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Hand over one message; may block while the link is full."""
        ...


@dataclass(eq=False)
class Transmitter:
    """Sends access units, stills, tracks and status, and accounts for each.

    ``wait_until(at_ns)`` sleeps until then in real time, and does nothing in lockstep. A ``pacer`` counts every
    message sent, and holds stills while the link is busy. ``in_flight`` holds access units until they are reported.
    ``clock`` gives the windows' time where time passes while a still is coded; None in lockstep.
    """

    outlet: Outlet
    _: KW_ONLY
    ledger: Ledger
    budget: RollingBudget
    edge_id: str
    session_id: int
    lockstep: bool
    wait_until: Callable[[int], None]
    pacer: Pacer | None = None
    in_flight: BaseInFlight = field(default_factory=BaseInFlight)
    clock: Callable[[], int] | None = None
    class_names: tuple[str, ...] = ()
    """The names of `Info`: for a ground known to have it, a still names its class by the index."""

    def __post_init__(self) -> None:
        self._keys = EdgeKeys(self.edge_id)
        self._flags = Flags.LOCKSTEP if self.lockstep else Flags(0)
        self._lock = self.budget.lock
        self.base_sequence = -1
        """Index of the last access unit sent; -1 before the first."""
        self.still_sequence = -1
        self.base_waited_ns = 0
        """Total time for which base messages have waited for the budget's window."""
        self._captures = CaptureTimes()
        self._packed: tuple[RoiHeader, PackedMessage] | None = None
        self._ended = False

    def base(self, unit: AccessUnit, *, now_ns: int, after_hole: bool = False, announced: bool = True) -> int:
        """Send one access unit as soon as the budget's window has room for it; return its line bytes.

        Returns 0 where it is not sent, because no window has room for it, or no message (`holds`): a keyframe has to
        follow. ``after_hole``: frames that it builds on were not sent. A sequence number is left out, so that no
        ground shows it. ``announced``: stills yield to a keyframe beforehand; else the budget keeps room for later
        keyframes that come unannounced.
        """
        line_bytes = self._line_bytes(Channel.BASE, unit.data, BASE_ATTACHMENT_BYTES)
        with self._lock:
            if not self._holds(unit, line_bytes):
                return 0
            at_ns = self.budget.earliest_ns(line_bytes, now_ns=now_ns, base=True)
            self.base_sequence += 2 if after_hole else 1
            header = self._base_header(self.base_sequence, unit, at_ns=at_ns)
            attachment = header.pack(unit.data)
            self._captures.note(header)
            line_bytes = self._count(Channel.BASE, Account.BASE, unit.data, attachment, at_ns=at_ns)
            self.budget.record_base(line_bytes, now_ns=at_ns, keyframe=unit.keyframe and announced)
            if self.pacer is not None:
                self.pacer.sent_base(self.base_sequence, line_bytes, now_ns=at_ns, keyframe=unit.keyframe)
            self.in_flight.sent(self.base_sequence, unit, now_ns=at_ns)
        self.base_waited_ns += max(0, at_ns - now_ns)
        self.wait_until(at_ns)
        self._put(Channel.BASE, unit.data, attachment)
        return line_bytes

    def _base_header(
        self, sequence: int, unit: AccessUnit, *, at_ns: int, resent: bool = False
    ) -> BaseHeader:
        start = Flags.KEYFRAME | Flags.PARAMETER_SETS if unit.keyframe else 0
        return BaseHeader(
            session_id=self.session_id,
            sequence=sequence,
            frame_index=unit.frame_index,
            capture_ns=unit.capture_ns,
            send_delay_ns=at_ns - unit.capture_ns,
            flags=self._flags | start | (Flags.RESENT if resent else 0),
        )

    def resend(self, missing: Sequence[int], *, now_ns: int) -> None:
        """Send access units that the primary receiver misses once more, before units that are yet to come.

        A unit without room in the budget's window within `_RESEND_WAIT_NS`, or beyond the share of such messages, may
        go at the next report, and so may the units behind it, which are of no use without it.
        """
        for sequence in () if self.lockstep else missing:
            now_ns = now_ns if self.clock is None else max(now_ns, self.clock())
            with self._lock:
                unit = self.in_flight.missing(sequence, now_ns=now_ns, round_trip_ns=self.round_trip_ns)
                if unit is None:
                    continue
                line_bytes = self._line_bytes(Channel.BASE, unit.data, BASE_ATTACHMENT_BYTES)
                at_ns = self.budget.resend_ns(line_bytes, now_ns=now_ns)
                if self._ended or at_ns is None or at_ns - now_ns > _RESEND_WAIT_NS:
                    return
                header = self._base_header(sequence, unit, at_ns=at_ns, resent=True)
                attachment = header.pack(unit.data)
                line_bytes = self._count(
                    Channel.BASE, Account.BASE, unit.data, attachment, at_ns=at_ns, again=True
                )
                self.budget.record_resent(line_bytes, now_ns=at_ns)
                if self.pacer is not None:
                    self.pacer.sent_other(line_bytes, now_ns=at_ns)
                self.in_flight.resent(sequence, now_ns=at_ns)
            self.wait_until(at_ns)
            self._put(Channel.BASE, unit.data, attachment)

    def still_allowance_bytes(self, now_ns: int, *, still: Still | None = None, paced: bool = True) -> int:
        """Payload that a still with the header of this one may take now, whatever data it holds itself.

        Exact to the byte: all that differs between stills is counted (names, parameters, further tracks,
        media type). Without ``still`` it is an estimate for one with the usual names. Without ``paced`` it is the
        budget's allowance, whether or not the link is free at this moment.
        """
        with self._lock:
            line_bytes = self.budget.still_allowance(now_ns)
        if paced and not self.link_is_free(now_ns):
            return 0
        return self._usual_payload(line_bytes) if still is None else self._payload(line_bytes, still, now_ns)

    def requested_allowance_bytes(self, now_ns: int, *, still: Still) -> int:
        """Like `still_allowance_bytes`, not paced, for a requested still: the video yields to it."""
        with self._lock:
            line_bytes = self.budget.requested_allowance(now_ns)
        return self._payload(line_bytes, still, now_ns)

    def link_is_free(self, now_ns: int) -> bool:
        return self.pacer is None or self.pacer.admits_still(now_ns)

    def want_requested(self, size_bytes: int | None, *, now_ns: int) -> None:
        """A requested still of ``size_bytes`` payload waits for its room; None: none waits any more."""
        with self._lock:
            line_bytes = size_bytes
            if size_bytes is not None:
                line_bytes = size_bytes + self._around(Channel.ROI, size_bytes, STILL_ATTACHMENT_BYTES)
                line_bytes = min(line_bytes, self.budget.most_requested_bytes)
            self.budget.want_requested(line_bytes, now_ns=now_ns)

    def most_requested_bytes(self) -> int:
        """Approximate payload of the largest still that a ground can be sent on request at the present rates."""
        with self._lock:
            return self._usual_payload(self.budget.most_requested_bytes)

    def most_still_bytes(self) -> int:
        """Approximate payload of the largest still that the budget ever admits."""
        return self._usual_payload(self.budget.most_still_bytes)

    def still(self, still: Still, *, now_ns: int, copy: str = "", requested: bool = False) -> None:
        """Send one still that `still_allowance_bytes` admitted at this very time; ``copy``: why it is sent again.

        ``requested`` by a ground: `requested_allowance_bytes` admitted it.

        It is sent once it is coded, which is later than ``now_ns``. Where another thread has taken the allowance
        since, it waits until there is room again, as every message does.
        Its outcome is noted with its bytes: ``sent``, or ``dropped`` once the run has ended.
        """
        with self._lock:
            header = still.header
            if self._ended:
                self.ledger.record_outcome("dropped", "ended")
                return
            self.ledger.record_outcome("sent", copy or header.reason)
            self.still_sequence = max(self.still_sequence, header.sequence)
            at_ns = self._still_at_ns(still, max(now_ns, now_ns if self.clock is None else self.clock()))
            attachment = self._header_at(still, at_ns).pack(still.data)
            line_bytes = self._count(
                Channel.ROI, Account.ROI, still.data, attachment, at_ns=at_ns, encoding=still.encoding
            )
            record = self.budget.record_requested if requested else self.budget.record_still
            record(line_bytes, now_ns=at_ns)
            if self.pacer is not None and copy:  # its number stands for the first copy, or for later stills
                self.pacer.sent_other(line_bytes, now_ns=at_ns)
            elif self.pacer is not None:
                self.pacer.sent_still(header.sequence, line_bytes, now_ns=at_ns)
        self.wait_until(at_ns)
        self.outlet.put(Channel.ROI, still.data, attachment=attachment, encoding=still.encoding)

    def store_base(self, unit: AccessUnit, *, now_ns: int) -> None:
        """Count an access unit that is stored: it has used up its share, of which a still can borrow nothing."""
        line_bytes = self._line_bytes(Channel.BASE, unit.data, BASE_ATTACHMENT_BYTES)
        with self._lock:
            self.budget.record_base(line_bytes, now_ns=now_ns, keyframe=unit.keyframe, stored=True)

    def store_still(self, still: Still, *, now_ns: int, counted: bool = True) -> BacklogStill:
        """The still as it would have been sent, for the backlog; ``counted``: its share of the budget is taken."""
        attachment = self._header_at(still, now_ns, stored=True).pack(still.data)
        if counted:
            line_bytes = self._line_bytes(Channel.ROI, still.data, len(attachment), encoding=still.encoding)
            with self._lock:
                self.budget.record_still(line_bytes, now_ns=now_ns)
        return BacklogStill(attachment, still.encoding, still.data)

    @property
    def round_trip_ns(self) -> int:
        """The round trip of the link; half a second if it is not measured."""
        return SECOND_NS // 2 if self.pacer is None else self.pacer.round_trip_ns

    def backlog_allowance_bytes(self, now_ns: int, *, reserve: float | None) -> int:
        """Payload that a chunk of the backlog may have now; ``reserve``: see `RollingBudget.backlog_allowance`."""
        with self._lock:
            if self.budget.yielding(now_ns):
                return 0
            line_bytes = self.budget.backlog_allowance(now_ns, reserve=reserve)
        if not self.link_is_free(now_ns):
            return 0
        around = self._around(Channel.BACKLOG, line_bytes, BACKLOG_ATTACHMENT_BYTES)
        most = min(_MOST_CHUNK_BYTES, max(LEAST_CHUNK_BYTES, round(_CHUNK_S * self.budget.total_bps / 8)))
        return min(most, max(0, line_bytes - around))

    def backlog(self, chunk: Chunk, *, now_ns: int) -> int:
        """Send a chunk that `backlog_allowance_bytes` admitted at this very time; return its line bytes.

        Returns 0 where another thread has taken the allowance since: the chunk was not sent.
        """
        session_id, kind, number = chunk.key
        header = BacklogHeader(
            session_id=session_id,
            kind=kind,
            number=number,
            offset=chunk.offset,
            total_bytes=chunk.total_bytes,
            send_ns=now_ns,
        )
        attachment = header.pack(chunk.data)
        with self._lock:
            needed_bytes = self._line_bytes(Channel.BACKLOG, chunk.data, len(attachment))
            if not self.budget.fits(needed_bytes, now_ns=now_ns):
                return 0
            line_bytes = self._count(Channel.BACKLOG, Account.BACKLOG, chunk.data, attachment, at_ns=now_ns)
            self.budget.record_other(line_bytes, now_ns)
            if self.pacer is not None:
                self.pacer.sent_other(line_bytes, now_ns=now_ns)
        self._put(Channel.BACKLOG, chunk.data, attachment)
        return line_bytes

    def metadata(
        self,
        channel: Channel,
        make: Callable[[int], bytes],
        *,
        now_ns: int,
        before_frames: bool = False,
        last: bool = False,
    ) -> bool:
        """Send a message of neither stream, where the next frame keeps its room; else return False: try again.

        ``before_frames``: a message that has waited long goes as soon as it fits. The ``last`` one, of ``status``,
        waits until it fits.

        ``make(at_ns)`` runs while no other message is counted: all it reads of the ledger is of one moment. After the
        ``last`` message no stills and no tracks are sent, whichever thread still has some: a ground that has received
        everything named in it closes the session.
        """
        at_ns = now_ns
        with self._lock:
            if self._ended:
                return False
            self._ended = last
            size_bytes = _GROWTH_BYTES + self._line_bytes(channel, make(now_ns), 0)
            if last:
                at_ns = self.budget.earliest_ns(size_bytes, now_ns=now_ns)
            elif not self.budget.metadata_fits(size_bytes, now_ns=now_ns, before_frames=before_frames):
                return False
            payload = make(at_ns)
            line_bytes = self._count(channel, Account.META, payload, b"", at_ns=at_ns)
            self.budget.record_metadata(line_bytes, now_ns=at_ns)
            if self.pacer is not None:
                self.pacer.sent_other(line_bytes, now_ns=at_ns)
        self.wait_until(at_ns)
        self._put(channel, payload, None)
        return True

    def reply(self, channel: Channel, payload: bytes) -> bytes:
        """Count an answer to a query, and let it go at once: the link puts it on the line as this returns.

        It waits for no window and takes none of the budget. Until a query is answered, later queries stand still, and
        in the end all that the link receives, keyframe requests and reports too; the requester measures the clock by
        the time that the answer takes; and if answers took from the budget, any ground that may query could stop the
        video. Its bytes have an account of their own, since each ground sees only the answers that it requested.
        """
        overhead = overhead_bytes(
            len(payload), 0, key=self._keys[channel], encoding=DELIVERIES[channel].encoding, reply=True
        )
        with self._lock:
            self.ledger.count_reply(len(payload) + overhead)
        return payload

    def base_wait_ns(self, now_ns: int, *, line_bytes: int | None = None) -> int:
        """The wait of a base message for the budget's window, were it sent now; None: an average frame."""
        with self._lock:
            line_bytes = round(self.budget.base_step_bytes) if line_bytes is None else line_bytes
            return max(0, self.budget.earliest_ns(line_bytes, now_ns=now_ns, base=True) - now_ns)

    def base_unit_wait_ns(self, unit: AccessUnit, *, now_ns: int) -> int | None:
        """The wait of this unit for the budget's window; None where it never has room."""
        line_bytes = self._line_bytes(Channel.BASE, unit.data, BASE_ATTACHMENT_BYTES)
        with self._lock:
            at_ns = self.budget.earliest_ns(line_bytes, now_ns=now_ns, base=True)
            return at_ns - now_ns if self._holds(unit, line_bytes) else None

    def holds(self, unit: AccessUnit) -> bool:
        """Tell whether an empty window of the budget, and a message, have room for this unit."""
        line_bytes = self._line_bytes(Channel.BASE, unit.data, BASE_ATTACHMENT_BYTES)
        with self._lock:
            return self._holds(unit, line_bytes)

    def _holds(self, unit: AccessUnit, line_bytes: int) -> bool:
        return len(unit.data) <= MAX_PAYLOAD_BYTES and self.budget.holds(line_bytes)

    def outcome(self, outcome: str, reason: str) -> None:
        """Note the outcome of a candidate: ``sent``, ``deferred`` or ``dropped``, and its reason."""
        assert outcome in ("sent", "deferred", "dropped")
        with self._lock:
            self.ledger.record_outcome(outcome, reason)  # type: ignore[arg-type]

    def _still_at_ns(self, still: Still, now_ns: int) -> int:
        header_bytes = self._header_at(still, now_ns).size_bytes
        line_bytes = self._line_bytes(Channel.ROI, still.data, header_bytes, encoding=still.encoding)
        if self.budget.fits(line_bytes, now_ns=now_ns):
            return now_ns
        return self.budget.earliest_ns(line_bytes + _GROWTH_BYTES, now_ns=now_ns)

    def _header_at(self, still: Still, send_ns: int, *, stored: bool = False) -> PackedMessage:
        # The header as sent at this time. The newest is packed once, however often it is requested.
        header, packed = still.header, self._packed
        if packed is None or packed[0] is not header:
            sent = replace(
                header,
                session_id=self.session_id,
                class_name=fitted_text(header.class_name, 64),
                reason=fitted_text(header.reason, 48),
            )
            self._packed = packed = header, PackedMessage.of(sent)
        fields = {"send_delay_ns": send_ns - header.capture_ns}
        # A requester need not have the video, nor the session's facts; nor does a ground when a stored still arrives.
        if not stored and "ask" not in header.parameters:
            if self._captures.knows(self.session_id, header.frame_index):
                fields["capture_ns"] = -1
            if header.class_name in self.class_names:
                fields["class_name"] = self.class_names.index(header.class_name)
        flags = self._flags | Flags.STORED if stored else self._flags
        return packed[1].with_fields(flags=int(flags), **fields)

    def _payload(self, line_bytes: int, still: Still, now_ns: int) -> int:
        header_bytes = self._header_at(still, now_ns).size_bytes
        around = self._around(Channel.ROI, line_bytes, header_bytes, encoding=still.encoding)
        return max(0, line_bytes - around)

    def _usual_payload(self, line_bytes: int) -> int:
        return max(0, line_bytes - self._around(Channel.ROI, line_bytes, STILL_ATTACHMENT_BYTES))

    def _count(
        self,
        channel: Channel,
        account: Account,
        payload: bytes,
        attachment: bytes,
        *,
        at_ns: int,
        encoding: str = "",
        again: bool = False,
    ) -> int:
        line_bytes = self._line_bytes(channel, payload, len(attachment), encoding=encoding)
        self.ledger.count(
            account,
            payload_bytes=len(payload),
            attachment_bytes=len(attachment),
            overhead_bytes=line_bytes - len(payload) - len(attachment),
            at_ns=at_ns,
            again=again,
        )
        return line_bytes

    def _put(self, channel: Channel, payload: bytes, attachment: bytes | None) -> None:
        self.outlet.put(channel, payload, attachment=attachment, encoding=DELIVERIES[channel].encoding)

    def _line_bytes(
        self, channel: Channel, payload: bytes, attachment_bytes: int, *, encoding: str = ""
    ) -> int:
        return len(payload) + self._around(channel, len(payload), attachment_bytes, encoding=encoding)

    def _around(self, channel: Channel, size_bytes: int, attachment_bytes: int, *, encoding: str = "") -> int:
        # Line bytes of a message beside its ``size_bytes`` of payload.
        return attachment_bytes + overhead_bytes(
            size_bytes,
            attachment_bytes,
            key=self._keys[channel],
            encoding=encoding or DELIVERIES[channel].encoding,
        )
