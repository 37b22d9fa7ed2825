"""A serial link of a given rate, in media time, and the edge's end of it in a flight of the study.

One server, first come first served, the base stream before everything else, nothing interrupted: a message that has
begun to go goes to its end. That is a radio modem behind a queue which knows two priorities. The sizes are line
bytes, as the ledger counts them. Pure: time is an argument.
"""

from __future__ import annotations

import hashlib
import math
from bisect import insort
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.protocol.messages import BaseHeader, CaptureTimes, RoiHeader, Status, StillResult, TrackStep
from hvt_common.runtime.clock import SteadyClock
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import Answers
from hvt_edge.perception.shadow import Detected
from hvt_study.datasets.sequence import NOMINAL_FPS

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, order=True)
class _Queued(Generic[_T]):
    enter_ns: int
    number: int
    size_bytes: int = field(compare=False)
    message: _T = field(compare=False)


@dataclass(frozen=True, slots=True)
class Arrival(Generic[_T]):
    """One message at the far end."""

    message: _T
    size_bytes: int
    urgent: bool
    enter_ns: int
    """When it was handed to the link."""
    arrival_ns: int
    """When its last bit was there."""


@dataclass(frozen=True, slots=True)
class LinkReport:
    """How long messages took; NaN where none did."""

    delay_p50_ms: float
    """From the reference time that was given for each to its arrival."""
    delay_p95_ms: float
    worst_queue_bytes: int
    """The most that was handed over and had not arrived, of all channels."""

    @classmethod
    def of(cls, delays_ns: Iterable[int], arrivals: Iterable[Arrival[_T]]) -> LinkReport:
        """``delays_ns`` of the messages that matter; the queue is that of all ``arrivals``."""
        delays_ms = np.fromiter(delays_ns, np.float64) / 1e6
        p50, p95 = np.percentile(delays_ms, (50, 95)).tolist() if len(delays_ms) else (math.nan, math.nan)
        return cls(delay_p50_ms=p50, delay_p95_ms=p95, worst_queue_bytes=_worst_queue(arrivals))


class SerialLink(Generic[_T]):
    """Takes messages of type ``_T`` with the time at which they are handed over; gives them back as they arrive."""

    def __init__(self, *, rate_bps: float) -> None:
        if not rate_bps > 0:
            raise ValueError(f"rate_bps is {rate_bps}, must be above 0")
        self._byte_ns = 8 * SECOND_NS / rate_bps
        self._queued: dict[bool, list[_Queued[_T]]] = {True: [], False: []}
        self._under_way: deque[Arrival[_T]] = deque()
        self._free_ns = 0.0
        self._count = 0

    def put(self, message: _T, *, size_bytes: int, enter_ns: int, urgent: bool) -> None:
        """Hand over one message; ``urgent`` ones go before all others that wait.

        Messages may be put in another order than they enter, as long as none enters before a time that `arrived` was
        asked for already.
        """
        insort(self._queued[urgent], _Queued(enter_ns, self._count, size_bytes, message))
        self._count += 1

    def arrived(self, now_ns: int | None) -> list[Arrival[_T]]:
        """Messages that have arrived by ``now_ns`` and were not returned before, in order; None: all the rest.

        Everything that enters before ``now_ns`` has to be put before.
        """
        while (start_ns := self._next_start_ns()) is not None and (now_ns is None or start_ns < now_ns):
            self._serve(start_ns)
        there: list[Arrival[_T]] = []
        while self._under_way and (now_ns is None or self._under_way[0].arrival_ns <= now_ns):
            there.append(self._under_way.popleft())
        return there

    def _next_start_ns(self) -> float | None:
        first_ns = min((queue[0].enter_ns for queue in self._queued.values() if queue), default=None)
        return None if first_ns is None else max(self._free_ns, first_ns)

    def _serve(self, start_ns: float) -> None:
        urgent = bool(self._queued[True]) and self._queued[True][0].enter_ns <= start_ns
        one = self._queued[urgent].pop(0)
        self._free_ns = start_ns + one.size_bytes * self._byte_ns
        self._under_way.append(
            Arrival(one.message, one.size_bytes, urgent, one.enter_ns, round(self._free_ns))
        )


def _worst_queue(arrivals: Iterable[Arrival[_T]]) -> int:
    """The highest sum of bytes that have entered and not arrived; an arrival makes room at its instant."""
    steps: list[tuple[int, int]] = []
    for one in arrivals:
        steps += [(one.enter_ns, one.size_bytes), (one.arrival_ns, -one.size_bytes)]
    held = worst = 0
    for _, size_bytes in sorted(steps):
        held += size_bytes
        worst = max(worst, held)
    return worst


START_NS = 1_700_000_000_000_000_000


def frame_ns(frame_index: int) -> int:
    """Capture of a frame of the clip."""
    return START_NS + round(frame_index * SECOND_NS / NOMINAL_FPS)


class MediaClock(SteadyClock):
    """Stands still: in lockstep the source alone sets the time."""

    def __call__(self) -> int:
        """Unix nanoseconds of the flight's beginning."""
        return START_NS


class FlightInbox(FeedbackInbox):
    """The answers of the ground, when the link has brought them back; nobody ever waits for more."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = START_NS
        self.due: deque[tuple[int, StillResult]] = deque()
        self.due_detected: deque[tuple[int, Detected]] = deque()

    def take(self) -> list[StillResult]:
        """Return and forget the answers that have come by now."""
        due = [one for at_ns, one in self.due if at_ns <= self.now_ns]
        self.due = deque((at_ns, one) for at_ns, one in self.due if at_ns > self.now_ns)
        return due

    def take_up_to(self, sequence: int) -> list[StillResult]:  # noqa: ARG002 - time decides here
        return self.take()

    def take_detected(self, *, up_to: int | None = None) -> Detected | None:  # noqa: ARG002 - time decides here
        """The newest that has come by now."""
        newest = None
        while self.due_detected and self.due_detected[0][0] <= self.now_ns:
            newest = self.due_detected.popleft()[1]
        return newest

    def wait_for(self, **_: Any) -> bool:
        return True

    def wait_for_end(self, **_: Any) -> bool:
        return True


class FlightOutlet:
    """The edge's end of the link: `hvt_edge.link.publisher.EdgeLink` without Zenoh.

    ``on_listen(info)`` is called with the edge's answer to ``info`` once it is ready.
    """

    unusable = 0
    trouble = ""

    def __init__(
        self, link: SerialLink[Received], *, edge_id: str, on_listen: Callable[[bytes], None]
    ) -> None:
        self._link = link
        self._keys = EdgeKeys(edge_id)
        self._on_listen = on_listen
        self._digest = hashlib.sha256()
        self._captures = CaptureTimes()
        self.line_bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.max_frame_bytes = 0
        self.last_frame = -1

    def has_ground(self) -> bool:
        return True

    def has_subscriber(self, channel: Channel) -> bool:  # noqa: ARG002
        return True

    def mend(self) -> None:
        """It loses nothing."""

    def listen(self, answers: Answers) -> None:
        self._on_listen(answers.info(START_NS))

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Hand over one message at the time that it says itself."""
        attached = attachment or b""
        key = self._keys[channel]
        size_bytes = (
            len(payload)
            + len(attached)
            + overhead_bytes(len(payload), len(attached), key=key, encoding=encoding)
        )
        self.line_bytes[channel] += size_bytes
        self.messages[channel] += 1
        if channel is not Channel.STATUS:  # it holds figures of the machine
            self._digest.update(payload)
        self._link.put(
            Received(key, payload, attached, encoding, 0),
            size_bytes=size_bytes,
            enter_ns=self._enter_ns(channel, payload, attached),
            urgent=channel is Channel.BASE,
        )

    @property
    def digest(self) -> str:
        """Digest of all that was sent but status: equal flights have the same."""
        return self._digest.hexdigest()

    def _enter_ns(self, channel: Channel, payload: bytes, attachment: bytes) -> int:
        if channel is Channel.BASE:
            header = BaseHeader.parse(attachment, payload)
            self.last_frame = header.frame_index
            self.max_frame_bytes = max(self.max_frame_bytes, len(payload))
            self._captures.note(header)
            return header.send_ns
        if channel is Channel.ROI:
            still = RoiHeader.parse(attachment, payload)
            return self._captures.filled(still, otherwise_ns=0).send_ns
        if channel is Channel.TRACKS:
            return TrackStep.parse(payload).send_ns
        assert channel is Channel.STATUS, f"the edge sends no {channel}"
        return Status.parse(payload).send_ns
