"""The ledger of the link: bytes by channel, rolling windows, and the outcome of every still.

Pure: the time of each message is an argument. Both sides count the same sizes and the times of the headers, and get
the same totals and windows.
"""

from __future__ import annotations

from bisect import insort
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any, Literal

StillOutcome = Literal["sent", "deferred", "dropped", "received"]


class Account(Enum):
    """The stream that a message belongs to."""

    BASE = "base"
    ROI = "roi"
    BACKLOG = "backlog"
    """Objects stored while the link was down, and sent afterwards."""
    META = "meta"
    """Status, info, feedback and tracks."""


_MOST_REASONS = 23
"""Reasons of one outcome that are counted by name; a status carries one more."""
MOST_WINDOW_NS = 60_000_000_000
"""The longest window, which an edge may name."""
_MOST_PENDING = _MOST_IN_WINDOW = 65_536
"""Messages; in a flood of more the windows hold the newest."""

# Measured between two peers of eclipse-zenoh 1.10 over TCP, with `ss -ti` (bytes_sent) and a veth's tx_bytes. It is
# the length of a batch (2), frame header and sequence number (7) and push, key and put headers (5), without the
# key's own characters. A row of Zenoh's default priority and congestion control would save 4; HVT has none.
_FRAMING_BYTES = 12
_STANDARD_ENCODING_BYTES = 1
_CUSTOM_ENCODING_BYTES = 4
_REPLY_BYTES = 36
"""More than a put: the numbers of query and replier, and the message that ends the query. Measured likewise."""
STANDARD_ENCODINGS = frozenset(
    {
        *("application/octet-stream", "application/cbor", "application/json"),
        *("image/jpeg", "image/png", "image/webp", "video/h264", "video/h265"),
    }
)
_BATCH_BYTES = 16384
"""`session` sets this size; a longer message crosses in fragments with a header each."""
_FRAGMENT_BYTES = 9
_SEGMENT_PAYLOAD_BYTES = 1448
"""Payload of TCP with timestamps over IPv4 on a link with an MTU of 1500."""
_SEGMENT_HEADER_BYTES = 52


def overhead_bytes(
    payload_bytes: int, attachment_bytes: int, *, key: str, encoding: str = "", reply: bool = False
) -> int:
    """Bytes that one Zenoh message over TCP and IPv4 takes on the line beyond its payload and attachment.

    ``key`` is the whole key: to a subscriber with a wildcard Zenoh sends it in full each time. ``encoding`` is the
    encoding's name, empty for Zenoh's default. A ``reply`` is the only one to its query. Headers below IP (14 bytes a
    packet on Ethernet), acknowledgements and retransmissions are not in it, nor the bytes saved where Zenoh sends
    two messages in one batch.
    """
    framing = _FRAMING_BYTES + len(key) + _varint_bytes(payload_bytes)
    if attachment_bytes:
        framing += 1 + _varint_bytes(attachment_bytes)
    if encoding in STANDARD_ENCODINGS:
        framing += _STANDARD_ENCODING_BYTES
    elif encoding:
        framing += _CUSTOM_ENCODING_BYTES + len(encoding)
    if reply:
        framing += _REPLY_BYTES
    message = payload_bytes + attachment_bytes + framing
    if message > _BATCH_BYTES:
        framing += 1 + _FRAGMENT_BYTES * (_ceil(message, _BATCH_BYTES - _FRAGMENT_BYTES) - 1)
    segments = _ceil(payload_bytes + attachment_bytes + framing, _SEGMENT_PAYLOAD_BYTES)
    return framing + _SEGMENT_HEADER_BYTES * segments


@dataclass(frozen=True, slots=True)
class WindowRates:
    """The fullest rolling window of a run, line bytes as bits per second."""

    base: int
    roi: int
    total: int


@dataclass(frozen=True, slots=True)
class LedgerSummary:
    """A ledger's account over a whole run; rates count line bytes (payload, metadata and overhead)."""

    duration_s: float
    base_bytes: int
    roi_bytes: int
    backlog_bytes: int
    meta_bytes: int
    overhead_bytes: int
    messages: Mapping[str, int]
    base_bps: int
    """Line bits of messages of the base stream a second."""
    roi_bps: int
    total_bps: int
    worst_window_bps: WindowRates
    outcomes: Mapping[str, Mapping[str, int]]
    """For each outcome the number of stills by reason."""

    def as_dict(self) -> dict[str, Any]:
        rates = asdict(self)
        return {name: value for name, value in rates.items() if name.endswith(("_bytes", "_bps"))}

    @property
    def line_bytes(self) -> int:
        return self.base_bytes + self.roi_bytes + self.backlog_bytes + self.meta_bytes + self.overhead_bytes


class Ledger:
    """Counts messages. Memory is bounded by the messages of one window and the slack, however long the run.

    Windows are half open: ``now - window < at <= now``. Messages may be counted out of order within ``slack_ns`` of
    the newest: the worst windows come out the same in every order. A message older than that means that a clock was
    set back: it is counted in every total, and the windows start afresh from it.
    """

    def __init__(self, *, window_ns: int = 1_000_000_000, slack_ns: int = 2_000_000_000) -> None:
        """``window_ns``: length of the rolling window. ``slack_ns``: how far out of order a message may come."""
        self.window_ns = window_ns = min(window_ns, MOST_WINDOW_NS)
        self._slack_ns = slack_ns
        self._pending: list[tuple[int, str, int]] = []
        self._windows = _Windows(window_ns)
        self._line = dict.fromkeys(Account, 0)
        self._messages = dict.fromkeys(Account, 0)
        self._outcomes: dict[StillOutcome, Counter[str]] = {
            outcome: Counter() for outcome in ("sent", "deferred", "dropped", "received")
        }
        self._bytes = dict.fromkeys(Account, 0)
        """Payload by account; of `Account.META` also all attachments."""
        self._overhead_bytes = 0
        self.replies = 0
        """Answers to queries. They and their bytes are in no other figure: no two grounds get the same ones."""
        self.reply_bytes = 0
        """On the line, with all headers."""

    def count_reply(self, line_bytes: int) -> None:
        self.replies += 1
        self.reply_bytes += line_bytes

    def count(
        self,
        channel: Account,
        *,
        payload_bytes: int,
        attachment_bytes: int,
        overhead_bytes: int,
        at_ns: int,
        again: bool = False,
    ) -> None:
        """Add one message; ``at_ns`` is the time that its windows go by. Of one sent ``again`` only bytes count."""
        self._overhead_bytes += overhead_bytes
        self._bytes[Account.META] += attachment_bytes
        self._bytes[channel] += payload_bytes
        line = payload_bytes + attachment_bytes + overhead_bytes
        self._line[channel] += line
        self._messages[channel] += not again
        self._enter(at_ns, channel, line)

    def record_outcome(self, outcome: StillOutcome, reason: str) -> None:
        """Count the outcome of a still by reason; reasons beyond 23, which the network may send, are ``other``."""
        outcomes = self._outcomes[outcome]
        outcomes[reason if reason in outcomes or len(outcomes) < _MOST_REASONS else "other"] += 1

    def outcomes(self, outcome: StillOutcome) -> dict[str, int]:
        """Number of stills with this outcome, by reason."""
        return dict(self._outcomes[outcome])

    def messages(self, channel: Account) -> int:
        return self._messages[channel]

    @property
    def base_bytes(self) -> int:
        return self._bytes[Account.BASE]

    @property
    def roi_bytes(self) -> int:
        return self._bytes[Account.ROI]

    @property
    def line_bytes(self) -> int:
        return sum(self._bytes.values()) + self._overhead_bytes

    def window_bytes(self, channel: Account | None, now_ns: int) -> int:
        """Line bytes of the messages in the window that ends at ``now_ns``; of all channels for None.

        Exact for any ``now_ns`` not further back than the slack from the newest message.
        """
        name = "total" if channel is None else channel.value
        after_ns = now_ns - self.window_ns
        windows, pending = self._windows.copy(), tuple(self._pending)
        windows.forget(until_ns=after_ns)
        return windows.sums[name] + sum(
            line for at_ns, entry, line in pending if after_ns < at_ns <= now_ns and name in ("total", entry)
        )

    @property
    def worst_window_bps(self) -> WindowRates:
        """The fullest windows so far. Safe to read while another thread counts."""
        windows = self._windows.copy()
        for entry in tuple(self._pending):
            windows.add(*entry)
        bits = {name: round(line * 8 * 1e9 / self.window_ns) for name, line in windows.worst.items()}
        return WindowRates(base=bits["base"], roi=bits["roi"], total=bits["total"])

    def summary(self, duration_s: float) -> LedgerSummary:
        """The account; ``duration_s`` is the length of the stream: last minus first frame, plus one interval."""
        return LedgerSummary(
            duration_s=duration_s,
            **{f"{account.value}_bytes": size for account, size in self._bytes.items()},
            overhead_bytes=self._overhead_bytes,
            messages={channel.value: number for channel, number in self._messages.items()},
            base_bps=_rate(self._line[Account.BASE], duration_s),
            roi_bps=_rate(self._line[Account.ROI], duration_s),
            total_bps=_rate(self.line_bytes, duration_s),
            worst_window_bps=self.worst_window_bps,
            outcomes={outcome: dict(reasons) for outcome, reasons in self._outcomes.items()},
        )

    def _enter(self, at_ns: int, channel: Account, line: int) -> None:
        if self._pending and at_ns < self._pending[-1][0] - self._slack_ns:
            self._release(before_ns=self._pending[-1][0] + 1)
            self._windows.restart()
        insort(self._pending, (at_ns, channel.value, line))
        self._release(before_ns=self._pending[-1][0] - self._slack_ns)
        if len(self._pending) > _MOST_PENDING:  # a flood, or a sender whose clock stands still
            self._release(before_ns=self._pending[-1][0] + 1)
            self._windows.restart()

    def _release(self, *, before_ns: int) -> None:
        # Pass on, in order of time, messages that no late one can precede any more.
        ready = 0
        while ready < len(self._pending) and self._pending[ready][0] < before_ns:
            self._windows.add(*self._pending[ready])
            ready += 1
        del self._pending[:ready]


_SUMS = (*(channel.value for channel in Account), "total")


@dataclass(slots=True)
class _Windows:
    # Rolling sums over messages in order of time, and the largest of each.

    window_ns: int
    entries: deque[tuple[int, str, int]] = field(default_factory=deque)
    sums: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_SUMS, 0))
    worst: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_SUMS, 0))

    def add(self, at_ns: int, channel: str, line: int) -> None:
        """The window that ends with this message is the fullest that holds it and nothing later."""
        self.forget(until_ns=at_ns - self.window_ns)
        if len(self.entries) >= _MOST_IN_WINDOW:
            self._drop_oldest()
        self.entries.append((at_ns, channel, line))
        for name in (channel, "total"):
            self.sums[name] += line
            self.worst[name] = max(self.worst[name], self.sums[name])

    def forget(self, *, until_ns: int) -> None:
        """Leave out the messages of this time and before."""
        while self.entries and self.entries[0][0] <= until_ns:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        _, channel, line = self.entries.popleft()
        self.sums[channel] -= line
        self.sums["total"] -= line

    def copy(self) -> _Windows:
        """An independent copy. Each part is copied in one step, which no other thread can interrupt."""
        return _Windows(self.window_ns, self.entries.copy(), self.sums.copy(), self.worst.copy())

    def restart(self) -> None:
        """Forget the messages of the window but not the worst."""
        self.entries.clear()
        self.sums = dict.fromkeys(self.sums, 0)


def _rate(line_bytes: int, duration_s: float) -> int:
    return round(line_bytes * 8 / duration_s) if duration_s > 0 else 0


def _ceil(amount: int, part: int) -> int:
    return -(-amount // part)


def _varint_bytes(number: int) -> int:
    # Bytes that Zenoh's variable-length integer takes, seven bits each.
    return max(1, _ceil(number.bit_length(), 7))
