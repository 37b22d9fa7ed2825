"""One direction of a link: when what is offered arrives, if it does. Pure: time comes in, chance from the seed.

The link is a server of the script's rate behind a bounded queue, then a delay line. For TCP a lost packet is not
lost to the program: it stalls its own connection (head-of-line blocking) for one retransmission timeout, and after
darkness a connection goes on at the first of its doubling retransmissions, as the kernel's would.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass

from link.script import Script

__all__ = ["DATAGRAM_HEADER_BYTES", "SEGMENT_BYTES", "SEGMENT_HEADER_BYTES", "Pipe", "Stream"]

SEGMENT_BYTES = 1448
"""Payload of a TCP segment on Ethernet with timestamps."""
SEGMENT_HEADER_BYTES = 52
"""IPv4 and TCP with timestamps."""
DATAGRAM_HEADER_BYTES = 28
"""IPv4 and UDP."""

_LEAST_RTO_S = 0.2
"""What Linux adds to the round trip at least (TCP_RTO_MIN)."""
_MOST_RTO_S = 120.0
_OVERTAKEN_S = 0.03
"""How much later a reordered datagram comes."""


@dataclass(frozen=True, slots=True)
class _Passage:
    departs_s: float
    delay_s: float
    lost: bool
    reordered: bool


class Pipe:
    """The queue and the line of one direction, shared by all its connections.

    Attributes:
        script: what the link does; may be replaced (by one that has begun).
        dropped: datagrams that found the queue full. lost: packets lost on the line.
        passed_bytes: headers included.
    """

    def __init__(self, script: Script, *, seed: int | str) -> None:
        self.script = script
        self.dropped = 0
        self.lost = 0
        self.passed_bytes = 0
        self._random = random.Random(f"pipe-{seed}")
        self._free_s = -1e9
        self._queue: deque[tuple[float, int]] = deque()
        self._queued_bytes = 0

    def queued_bytes(self, now_s: float) -> int:
        """What waits for the line or is on its way onto it."""
        while self._queue and self._queue[0][0] <= now_s:
            self._queued_bytes -= self._queue.popleft()[1]
        return self._queued_bytes

    def room_s(self, size_bytes: int, now_s: float) -> float:
        """The first moment at which so many bytes fit into the queue."""
        excess = self.queued_bytes(now_s) + size_bytes - self.script.queue_bytes
        at_s = now_s
        for departs_s, size in self._queue:
            if excess <= 0:
                break
            at_s, excess = departs_s, excess - size
        return at_s

    def datagram(self, size_bytes: int, now_s: float) -> float | None:
        """When it arrives; None where the queue is full or the line loses it. ``size_bytes`` with headers."""
        if self.queued_bytes(now_s) + size_bytes > self.script.queue_bytes or self.script.at(now_s).dark:
            self._draw()
            self.dropped += 1
            return None
        passage = self.pass_on(size_bytes, now_s)
        if passage.lost or self.script.at(passage.departs_s).dark or self._was_dark(now_s, passage.departs_s):
            return None
        return passage.departs_s + passage.delay_s + (_OVERTAKEN_S if passage.reordered else 0.0)

    def pass_on(self, size_bytes: int, now_s: float) -> _Passage:
        """Take a packet onto the line behind what waits already."""
        loss_draw, jitter_draw, reorder_draw = self._draw()
        departs_s = self.script.finish_s(max(now_s, self._free_s), 8 * size_bytes)
        self._free_s = departs_s
        self._queue.append((departs_s, size_bytes))
        self._queued_bytes += size_bytes
        state = self.script.at(departs_s)
        lost = loss_draw < state.loss
        self.lost += lost
        self.passed_bytes += size_bytes
        delay_s = state.delay_s + state.jitter_s * jitter_draw
        return _Passage(departs_s, delay_s, lost, reorder_draw < state.reorder)

    def _was_dark(self, start_s: float, end_s: float) -> bool:
        return any(begin < end_s and start_s < end for begin, end in self.script.dark)

    def _draw(self) -> tuple[float, float, float]:
        """Every packet draws the same number of times, so that the n-th is treated alike whatever came before."""
        return self._random.random(), self._random.random(), self._random.random()


class Stream:
    """One TCP connection's way through a pipe: in order, nothing lost, late."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._held_s = -1e9
        """Nothing of this connection arrives before."""

    def may_send_s(self, now_s: float) -> float:
        """When the connection's next packet gets onto the link: in darkness at a retransmission after its end."""
        script = self._pipe.script
        return self._retransmitted_s(now_s) if script.at(now_s).dark else now_s

    def segment(self, size_bytes: int, now_s: float) -> float:
        """When this packet's payload reaches the program at the other end; ``size_bytes`` with headers."""
        script = self._pipe.script
        passage = self._pipe.pass_on(size_bytes, now_s)
        arrives_s = passage.departs_s + passage.delay_s
        for begin_s, end_s in script.dark:
            if begin_s < passage.departs_s and now_s < end_s:
                arrives_s = max(arrives_s, self._retransmitted_s(begin_s) + passage.delay_s)
        if passage.lost:
            # All of a burst is lost together and comes again together.
            certain = script.at(passage.departs_s).loss >= 1.0
            over_s = script.until(passage.departs_s) if certain else passage.departs_s
            arrives_s = over_s + self._rto_s(over_s) + passage.delay_s
        self._held_s = max(self._held_s, arrives_s)
        return self._held_s

    def _retransmitted_s(self, lost_s: float) -> float:
        light_s = self._pipe.script.light_s(lost_s)
        at_s, wait_s = lost_s, self._rto_s(lost_s)
        while at_s < light_s:
            at_s += wait_s
            wait_s = min(2 * wait_s, _MOST_RTO_S)
        return at_s

    def _rto_s(self, t_s: float) -> float:
        return _LEAST_RTO_S + 2 * self._pipe.script.at(t_s).delay_s
