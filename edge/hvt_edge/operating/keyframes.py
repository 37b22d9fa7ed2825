"""Requests for a keyframe: from grounds, from the link, from the store, from a reconfiguration.

Any thread adds a request; the frame loop's plan (`hvt_edge.video.keyframes`) takes them and publishes its state.
A ground's requests are limited by a token bucket, so that whoever may command cannot make the stream all keyframes:
one costs the time in which its bytes are ``request_share`` of the budget. After reported losses a request is free: on
a lossy link a refused keyframe is a dark screen.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

from hvt_common.units import SECOND_NS

_MOST_RECEIVERS = 16
"""Whose losses are remembered: ids cost a sender nothing."""


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Times in nanoseconds; ``interval_ns`` of 0 sends keyframes on demand only."""

    interval_ns: int = 10 * SECOND_NS
    patience_ns: int = 3 * SECOND_NS // 5
    scheduled_patience_ns: int = 2 * SECOND_NS
    rest_ns: int = 3 * SECOND_NS // 10
    """After a keyframe, requests are taken as answered by it for so long: they crossed it on the way. With the
    second request of a ground (0.3 s after the first) and the patience it stays under a second."""
    burst: int = 6
    """Requests in a row: losses come in bursts."""
    refill_ns: int = 7 * SECOND_NS // 10
    """After that one in so long at the most, where losses were reported too; 0 for no limit. On a link that loses one
    frame in twenty, two seconds would show half of what 0.7 s shows."""
    request_share: float = 0.35
    """Share of the budget for keyframes that nobody needs as far as the edge can tell."""
    camera_every_s: float | None = None
    """The camera makes its own keyframes, about so far apart, and none on request; None: the edge makes them."""


@dataclass(frozen=True, slots=True)
class KeyframeState:
    """The published state of the plan."""

    interval_ns: int
    last_ns: int | None = None
    """When the newest keyframe was encoded; None before the first."""
    due_ns: int | None = None
    """The time since which one is due; None if none is."""
    sent: int = 0
    requested: bool = False
    """Whether the one that is due was requested, and is no mere one of the schedule."""

    def due(self, now_ns: int) -> bool:
        """Whether a keyframe is to come: the first, one that was requested, or one of the schedule."""
        if self.last_ns is None or self.due_ns is not None:
            return True
        return self.interval_ns > 0 and now_ns - self.last_ns >= self.interval_ns


class KeyframeRequests:
    """Thread-safe; time is an argument."""

    def __init__(self, settings: KeyframeSettings = KeyframeSettings()) -> None:
        self.settings = settings
        self._lock = threading.Lock()
        self._state = KeyframeState(settings.interval_ns)
        self._requested_ns: int | None = None
        """The oldest request that the plan has not taken."""
        self._paid_ns = -(2**63)
        """Requests are paid for up to this time: `_cost_ns` each."""
        self._keyframe_ns = 0
        """The cost of a keyframe, as time of the budget."""
        self._losses: dict[int, int] = {}
        """Losses by receiver, as of its last report."""
        self._lossy = False
        """Whether somebody has lost more since the last keyframe."""
        self.served = 0
        """Requests of grounds that were met by a keyframe of their own, or one that was due or fresh."""

    # Anybody

    @property
    def sent(self) -> int:
        """Keyframes so far."""
        return self._state.sent

    def due(self, now_ns: int) -> bool:
        """Whether a keyframe is to come: stills are held from now on until it has gone."""
        return self._requested_ns is not None or self._state.due(now_ns)

    @property
    def requested(self) -> bool:
        """Whether a keyframe is to come that somebody or something needs: not even a requested still goes before."""
        state = self._state
        return self._requested_ns is not None or state.requested or state.last_ns is None

    def request(self, now_ns: int) -> str | None:
        """A ground wants a keyframe; return why it gets none now, in a sentence, or None where it is served.

        What costs no keyframe of its own is always served: one is due already, or the newest one is so fresh that it
        crossed the request on the way.
        """
        if self.settings.camera_every_s is not None:
            return (
                "the camera's own video is sent (--encoder passthrough), and it makes no keyframe on request: the "
                f"next comes by itself, one each {self.settings.camera_every_s:.1f} s or so"
            )
        with self._lock:
            state = self._state
            fresh = state.last_ns is not None and now_ns - state.last_ns < self.settings.rest_ns
            pending = self._requested_ns is not None or state.due_ns is not None
            if not fresh and not pending and state.last_ns is not None:
                refusal = self._pay(now_ns, last_ns=state.last_ns)
                if refusal is not None:
                    return refusal
            self.served += 1
            if not fresh:
                self._add(now_ns)
            return None

    def require(self, now_ns: int) -> None:
        """The edge itself wants one, because something is to change with it; a camera's next one will do."""
        if self.settings.camera_every_s is not None:
            return
        with self._lock:
            self._add(now_ns)

    def report_losses(self, receiver_id: int, count: int) -> None:
        """A receiver reports so many lost or damaged messages in all; its next request is free."""
        with self._lock:
            if count <= self._losses.get(receiver_id, 0):
                return
            if receiver_id not in self._losses and len(self._losses) >= _MOST_RECEIVERS:
                del self._losses[next(iter(self._losses))]
            self._losses[receiver_id] = count
            self._lossy = True

    # The plan

    def take(self) -> int | None:
        """Return when the oldest request came that was not taken yet, and forget all; None where there is none."""
        with self._lock:
            requested_ns, self._requested_ns = self._requested_ns, None
            return requested_ns

    def publish(self, state: KeyframeState) -> None:
        """The plan's state from now on. With another keyframe, losses before it are no reason any more."""
        with self._lock:
            if state.sent != self._state.sent:
                self._lossy = False
            self._state = state

    def note_cost(self, keyframe_ns: int) -> None:
        """A keyframe has been sent that takes the whole budget for so long."""
        self._keyframe_ns = keyframe_ns

    def _add(self, now_ns: int) -> None:
        self._requested_ns = now_ns if self._requested_ns is None else self._requested_ns

    @property
    def _cost_ns(self) -> int:
        return max(self.settings.refill_ns, round(self._keyframe_ns / self.settings.request_share))

    def _pay(self, now_ns: int, *, last_ns: int) -> str | None:
        # Take a token; return why not, where there is none. After a loss nobody pays.
        settings, cost_ns = self.settings, self._cost_ns
        if settings.refill_ns == 0 or (self._lossy and now_ns - last_ns >= settings.refill_ns):
            return None
        paid_ns = max(self._paid_ns, now_ns - settings.burst * cost_ns) + cost_ns
        if paid_ns > now_ns:
            return (
                f"the last keyframe came {(now_ns - last_ns) / SECOND_NS:.1f} s ago, after many others: ask again "
                f"in {(paid_ns - now_ns) / SECOND_NS:.1f} s"
            )
        self._paid_ns = paid_ns
        return None
