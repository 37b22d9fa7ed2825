"""One direction of a link: when an offered packet arrives, if it does. Pure: time comes in, chance from the seed.

The link is a server of the script's rate behind a bounded queue, then a delay line. For TCP a lost packet is not
lost to the program: it stalls its own connection (head-of-line blocking) until it is sent again, as Linux does it:

- One round trip after a later packet of the connection was sent that got through: its acknowledgement tells (SACK and
  RACK, RFC 8985), but not before the lost one is a round trip and a quarter old. So, too, where a retransmission was
  lost.
- Where nothing later gets through, by the timer (RFC 6298): 200 ms and the round trip after it left, then doubling
  for as long as the retransmissions are lost, too. Packets lost with it are sent again one round trip later.

Not modelled: the congestion window (a real TCP sends more slowly after a loss, and hardly at all after a timeout),
the tail loss probe, and the three later packets after which the quarter is not waited for. Retransmissions and
acknowledgements take nothing of the rate, but are lost like all else; a connection that had something to send in
darkness goes on at the first of its doubling retransmissions after it.
"""

import math
import random
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from lab.link.timeline import Script

SEGMENT_BYTES = 1448
"""Payload of a TCP segment on Ethernet with timestamps."""
SEGMENT_HEADER_BYTES = 52
"""IPv4 and TCP with timestamps."""
DATAGRAM_HEADER_BYTES = 28
"""IPv4 and UDP."""

_LEAST_RTO_S = 0.2
"""Linux adds at least this to the round trip (TCP_RTO_MIN)."""
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
        script: the course of the link; may be replaced (by one that has begun).
        dropped: datagrams that found the queue full. lost: packets lost on the line.
        passed_bytes: headers included.
    """

    def __init__(self, script: Script, *, seed: int | str) -> None:
        self.script = script
        self.dropped = 0
        self.lost = 0
        self.passed_bytes = 0
        self._random = random.Random(f"pipe-{seed}")
        self._repair_random = random.Random(f"repair-{seed}")
        self._free_s = -1e9
        self._queue: deque[tuple[float, int]] = deque()
        self._queued_bytes = 0

    def queued_bytes(self, now_s: float) -> int:
        """Bytes that wait for the line or are on their way onto it."""
        while self._queue and self._queue[0][0] <= now_s:
            self._queued_bytes -= self._queue.popleft()[1]
        return self._queued_bytes

    def fits_at_s(self, size_bytes: int, now_s: float) -> float:
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
        """Take a packet onto the line behind the waiting ones."""
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

    def passes(self, at_s: float) -> bool:
        """Whether a retransmission or an acknowledgement of this moment gets through. Draws by itself."""
        state = self.script.at(at_s)
        if state.dark or state.loss >= 1.0:
            return False
        return state.loss == 0.0 or self._repair_random.random() >= state.loss

    def _was_dark(self, start_s: float, end_s: float) -> bool:
        return any(begin < end_s and start_s < end for begin, end in self.script.dark)

    def _draw(self) -> tuple[float, float, float]:
        """Every packet draws the same number of times, so that the n-th is treated alike whatever came before."""
        return self._random.random(), self._random.random(), self._random.random()


@dataclass(slots=True, eq=False)
class Segment:
    """A packet of a connection. It is handed to the program when it has come and all before it were handed over."""

    arrives_s: float
    """When it comes; for a lost packet, as far as is known: later packets may change it until then."""


@dataclass(slots=True, eq=False)
class _Lost:
    """A segment that is under way for a second time, or more."""

    segment: Segment
    delay_s: float
    lost_s: list[float]
    """When it was sent in vain, in order."""
    again_s: float = math.inf
    """When it is sent such that it gets through."""

    def comes(self, again_s: float) -> None:
        """It is sent again then, and gets through."""
        self.again_s = again_s
        self.segment.arrives_s = again_s + self.delay_s

    def is_lost_again(self, again_s: float) -> None:
        """It is sent again then, in vain."""
        self.lost_s.append(again_s)
        self.again_s = math.inf


class Stream:
    """One TCP connection's way through a pipe: in order, nothing lost, late."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._lost: list[_Lost] = []

    def may_send_s(self, now_s: float) -> float:
        """When the connection's next packet gets onto the link: in darkness at a retransmission after its end."""
        if not self._pipe.script.at(now_s).dark:
            return now_s
        return next(at_s for at_s in self._timer_s(now_s) if not self._pipe.script.at(at_s).dark)

    def segment(self, size_bytes: int, now_s: float) -> Segment:
        """Send a packet; ``size_bytes`` with headers. May change when earlier ones arrive that were lost."""
        passage = self._pipe.pass_on(size_bytes, now_s)
        sent_s, came_s = passage.departs_s, passage.departs_s + passage.delay_s
        segment = Segment(came_s)
        self._lost = [one for one in self._lost if one.segment.arrives_s > now_s]
        dark_s = [begin for begin, end in self._pipe.script.dark if begin < sent_s and now_s < end]
        if dark_s:
            self._lose(_Lost(segment, passage.delay_s, [max(now_s, dark_s[0])]))
        elif passage.lost:
            self._lose(_Lost(segment, passage.delay_s, [sent_s]))
        elif self._lost and self._pipe.passes(came_s):
            self._acknowledged(self._lost, sent_s=sent_s, came_s=came_s)
        return segment

    def _lose(self, lost: _Lost) -> None:
        hole = next((one for one in self._lost if one.again_s > lost.lost_s[0]), None)
        self._lost.append(lost)
        if hole is None:
            self._by_timer([lost])
        else:
            self._acknowledged([lost], sent_s=hole.again_s, came_s=hole.segment.arrives_s)

    def _acknowledged(self, lost: Sequence[_Lost], *, sent_s: float, came_s: float) -> None:
        """Something was sent after these, and came: send them again (RFC 8985, section 6.2, step 5)."""
        back_s = self._pipe.script.at(came_s).delay_s
        known_s, reordering_s = came_s + back_s, 2 * back_s / 4
        in_vain = []
        for one in lost:
            before = [at_s for at_s in one.lost_s if at_s < known_s]
            again_s = known_s + max(0.0, reordering_s - (sent_s - before[-1]))
            if before[-1] >= sent_s or again_s >= one.again_s:
                continue
            one.lost_s = before  # the timer is not waited for
            if self._pipe.passes(again_s):
                one.comes(again_s)
            else:
                one.is_lost_again(again_s)
                in_vain.append(one)
        self._by_timer(in_vain)

    def _by_timer(self, lost: Sequence[_Lost]) -> None:
        """The first comes by the timer, the others by its acknowledgement."""
        if not lost:
            return
        first, *others = lost
        for at_s in self._timer_s(first.lost_s[-1]):
            if self._pipe.passes(at_s):
                first.comes(at_s)
                break
            first.is_lost_again(at_s)
        self._acknowledged(others, sent_s=first.again_s, came_s=first.segment.arrives_s)

    def _timer_s(self, sent_s: float) -> Iterator[float]:
        """The times at which a packet sent then is sent again and again, for as long as nothing is heard."""
        wait_s = _LEAST_RTO_S + 2 * self._pipe.script.at(sent_s).delay_s
        while True:
            sent_s += wait_s
            yield sent_s
            wait_s = min(2 * wait_s, _MOST_RTO_S)
