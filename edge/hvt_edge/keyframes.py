"""When a keyframe comes: at the start, on a long schedule, and on request of grounds, of the link, of the store.

Any thread requests one; the frame loop decides (`Keyframes.now`). A keyframe is the largest message there is, so it
is announced: while one is due stills are held, and it is sent as soon as it fits the budget's window. A scheduled one
may wait ``scheduled_patience_ns`` for that, a requested one ``patience_ns``, so that a ground that joins late sees a
picture within a second.

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
    """After a keyframe, requests are taken as answered by it for so long at most: they crossed it on the way. With
    the second request of a ground (0.3 s after the first) and the patience it stays under a second."""
    coding_ns: int = SECOND_NS // 10
    """A keyframe is coded and put on the line for so long: with the round trip, a request crosses it for as long."""
    burst: int = 6
    """Requests in a row: losses come in bursts."""
    refill_ns: int = 7 * SECOND_NS // 10
    """After that one in so long at the most, where losses were reported too; 0 for no limit. On a link that loses one
    frame in twenty, two seconds would show half of what 0.7 s shows."""
    request_share: float = 0.35
    """Share of the budget for keyframes that nobody needs as far as the edge can tell."""
    camera_every_s: float | None = None
    """The camera makes its own keyframes, about so far apart, and none on request; None: the edge makes them."""


class Keyframes:
    """Thread-safe; time is an argument. `now`, `done` and `note_cost` are for the frame loop."""

    def __init__(self, settings: KeyframeSettings = KeyframeSettings()) -> None:
        self.settings = settings
        self._lock = threading.Lock()
        self._last_ns: int | None = None
        """When the newest keyframe was encoded; None before the first."""
        self._due_ns: int | None = None
        """The time since which the frame loop waits for room for one; None if it does not."""
        self._requested_ns: int | None = None
        """The oldest request that no keyframe has met."""
        self._by_ground = False
        """Of these one is a ground's."""
        self._paid_ns = -(2**63)
        """Requests are paid for up to this time: `_cost_ns` each."""
        self._keyframe_ns = 0
        """The cost of a keyframe, as time of the budget."""
        self._crosses_ns = self.settings.rest_ns
        """After a keyframe, a request of so long may be from before it came."""
        self._losses: dict[int, int] = {}
        """Losses by receiver, as of its last report."""
        self._lossy = False
        """Whether somebody has lost more since the last keyframe."""
        self.sent = 0
        """Keyframes so far."""
        self.served = 0
        """Requests of grounds that were met by a keyframe of their own, or one that was due or fresh."""

    # Anybody

    def due(self, now_ns: int) -> bool:
        """Whether a keyframe is to come: stills are held from now on until it has gone."""
        with self._lock:
            return self._requested_ns is not None or self._due_ns is not None or self._scheduled(now_ns)

    @property
    def made_here(self) -> bool:
        """Whether they come when the edge wants one; a camera makes its own."""
        return self.settings.camera_every_s is None

    @property
    def requested(self) -> bool:
        """Whether a keyframe is to come that somebody or something needs: not even a requested still goes before."""
        with self._lock:
            return self._requested_ns is not None or self._last_ns is None

    @property
    def awaited(self) -> bool:
        """Whether a ground waits for one: it can show no other frame, and each would take of the keyframe's room."""
        with self._lock:
            return self._by_ground

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
            last_ns = self._last_ns
            fresh = last_ns is not None and now_ns - last_ns < self._crosses_ns
            pending = self._requested_ns is not None or self._due_ns is not None
            if not fresh and not pending and last_ns is not None:
                refusal = self._pay(now_ns, last_ns=last_ns)
                if refusal is not None:
                    return refusal
            self.served += 1
            if not fresh:
                self._add(now_ns)
                self._by_ground = True
            return None

    def require(self, now_ns: int) -> None:
        """The edge itself wants one, because something is to change with it; a camera's next one will do."""
        if not self.made_here:
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

    def note_round_trip(self, round_trip_ns: int) -> None:
        """The link's round trip; a request that comes later than that after a keyframe says that it was lost."""
        self._crosses_ns = min(self.settings.rest_ns, round_trip_ns + self.settings.coding_ns)

    # The frame loop

    def now(self, now_ns: int, *, fits: bool) -> bool:
        """Tell whether this very frame is to be the keyframe; ``fits``: the budget's window has room for it."""
        with self._lock:
            if self._due_ns is None:
                self._due_ns = (
                    now_ns if self._requested_ns is None and self._scheduled(now_ns) else self._requested_ns
                )
            if self._last_ns is None:
                return True
            return self._due_ns is not None and (fits or not self._waits(self._due_ns, now_ns))

    def done(self, now_ns: int) -> None:
        """A keyframe has just been encoded; it also answers what was requested meanwhile."""
        with self._lock:
            self._last_ns, self._due_ns, self._requested_ns, self._by_ground = now_ns, None, None, False
            self._lossy = False  # losses before it are no reason any more
            self.sent += 1

    def note_cost(self, keyframe_ns: int) -> None:
        """A keyframe has been sent that takes the whole budget for so long."""
        self._keyframe_ns = keyframe_ns

    def _add(self, now_ns: int) -> None:
        self._requested_ns = now_ns if self._requested_ns is None else self._requested_ns

    def _scheduled(self, now_ns: int) -> bool:
        interval_ns = self.settings.interval_ns
        return self._last_ns is None or (interval_ns > 0 and now_ns - self._last_ns >= interval_ns)

    def _waits(self, due_ns: int, now_ns: int) -> bool:
        if self._requested_ns is not None:
            return now_ns - self._requested_ns < self.settings.patience_ns
        return now_ns - due_ns < self.settings.scheduled_patience_ns

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
