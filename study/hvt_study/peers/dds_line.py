"""The line between both ends of the peer: every message is weighed, counted once and sent over a serial link."""

import hashlib
import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger, overhead_bytes
from hvt_common.protocol.messages import BaseHeader, Flags
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.link.budget import RollingBudget
from hvt_study.flights.flight_link import Arrival, SerialLink

HEADER_BYTES = 44
"""The largest `BaseHeader`."""
_SESSION = 1 << 31  # as many bytes on the wire as a random one
_CHANNELS = {Channel.BASE: Account.BASE, Channel.ROI: Account.ROI, Channel.CONTROL: Account.META}
_KEYS = EdgeKeys("edge-1")
_VIDEO = DELIVERIES[Channel.BASE].encoding
_FURTHER = struct.Struct(">II")
"""Before each access unit but the first: its frame and its length."""


@dataclass(frozen=True, slots=True)
class UnitMessage:
    """Access units of one of the passes, as the ground gets them: one of the first, or some of the second."""

    row: Channel
    units: tuple[AccessUnit, ...]


def header_bps(line_bps: float, *, units_per_s: float, messages_per_s: float, row: Channel) -> float:
    """The part of headers and transport in ``line_bps``."""
    payload = round(line_bps / 8 / messages_per_s)
    around = HEADER_BYTES + overhead_bytes(payload, HEADER_BYTES, key=_KEYS[row], encoding=_VIDEO)
    return 8 * (messages_per_s * around + (units_per_s - messages_per_s) * _FURTHER.size)


class Line:
    """Both directions. Edge to ground goes over a simulated link; requests of the ground take their own time back."""

    def __init__(self, *, link_bps: int, budget: RollingBudget, window_ns: int) -> None:
        self.budget = budget
        self.ledger = Ledger(window_ns=window_ns, slack_ns=4 * window_ns)
        self.line_bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.max_frame_bytes = 0
        self.arrivals: list[Arrival[None]] = []
        """All messages that crossed, without their content."""
        self._link: SerialLink[UnitMessage] = SerialLink(rate_bps=link_bps)
        self._link_bps = link_bps
        self._digest = hashlib.sha256()
        self._under_way = 0

    @property
    def digest(self) -> str:
        return self._digest.hexdigest()

    @property
    def total_bytes(self) -> int:
        """Line bytes of everything that was sent."""
        return self.line_bytes.total()

    @property
    def empty(self) -> bool:
        """Whether everything that was sent to the ground has been taken out."""
        return not self._under_way

    def message_bytes(self, row: Channel, units: Sequence[AccessUnit], *, at_ns: int) -> int:
        """Line bytes of a message with these access units, were it sent then."""
        payload = _payload(units)
        attachment = self._header(row, units[0], at_ns=at_ns).pack(payload)
        return self._weight(row, payload, attachment, encoding=_VIDEO)

    def send(self, row: Channel, units: Sequence[AccessUnit], *, at_ns: int) -> int:
        """Edge to ground; return the line bytes. The budget is the caller's to tell."""
        payload = _payload(units)
        attachment = self._header(row, units[0], at_ns=at_ns).pack(payload)
        size_bytes = self._count(row, payload, attachment, encoding=_VIDEO, at_ns=at_ns)
        self.max_frame_bytes = max(self.max_frame_bytes, *(len(unit.data) for unit in units))
        self._link.put(
            UnitMessage(row, tuple(units)),
            size_bytes=size_bytes,
            enter_ns=at_ns,
            urgent=row is Channel.BASE,
        )
        self._under_way += 1
        return size_bytes

    def send_request(self, payload: bytes, *, now_ns: int) -> int:
        """Ground to edge as soon as the budget's window has room; return when it is there."""
        size_bytes = self._weight(
            Channel.CONTROL, payload, b"", encoding=DELIVERIES[Channel.CONTROL].encoding
        )
        at_ns = self.budget.earliest_ns(size_bytes, now_ns=now_ns)
        self._count(Channel.CONTROL, payload, b"", encoding=DELIVERIES[Channel.CONTROL].encoding, at_ns=at_ns)
        self.budget.record_metadata(size_bytes, now_ns=at_ns)
        return at_ns + round(size_bytes * 8 * SECOND_NS / self._link_bps)

    def arrived(self, now_ns: int) -> list[Arrival[UnitMessage]]:
        """Messages that have reached the ground by now."""
        there = self._link.arrived(now_ns)
        self._under_way -= len(there)
        self.arrivals += [
            Arrival(None, one.size_bytes, one.urgent, one.enter_ns, one.arrival_ns) for one in there
        ]
        return there

    def _header(self, row: Channel, unit: AccessUnit, *, at_ns: int) -> BaseHeader:
        return BaseHeader(
            session_id=_SESSION,
            sequence=self.messages[row],
            frame_index=unit.frame_index,
            capture_ns=unit.capture_ns,
            send_delay_ns=at_ns - unit.capture_ns,
            flags=int(Flags.LOCKSTEP | ((Flags.KEYFRAME | Flags.PARAMETER_SETS) if unit.keyframe else 0)),
        )

    def _weight(self, row: Channel, payload: bytes, attachment: bytes, *, encoding: str) -> int:
        key = _KEYS[row]
        around = overhead_bytes(len(payload), len(attachment), key=key, encoding=encoding)
        return len(payload) + len(attachment) + around

    def _count(self, row: Channel, payload: bytes, attachment: bytes, *, encoding: str, at_ns: int) -> int:
        size_bytes = self._weight(row, payload, attachment, encoding=encoding)
        self.ledger.count(
            _CHANNELS[row],
            payload_bytes=len(payload),
            attachment_bytes=len(attachment),
            overhead_bytes=size_bytes - len(payload) - len(attachment),
            at_ns=at_ns,
        )
        self.line_bytes[row] += size_bytes
        self.messages[row] += 1
        self._digest.update(payload)
        return size_bytes


def _payload(units: Sequence[AccessUnit]) -> bytes:
    """The first is the header's; the others carry their own kind."""
    first, *others = units
    return first.data + b"".join(_FURTHER.pack(one.frame_index, len(one.data)) + one.data for one in others)
