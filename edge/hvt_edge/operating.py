"""The operating point: the present budget, split, method and frame rate; and the keyframes that are due.

Settings are frozen; values that commands, the link and measurements change live here. Three modules write:
`hvt_edge.control` the ground's commands, the frame loop (`hvt_edge.video.reconfigure`) the link's rate and the
settings of the open x265, and `hvt_edge.perception.auto` which parts are worth sending beside the video.
The encoder, the budget, ``info``, status and summary all read the same.

A keyframe comes at the start, on a long schedule, and on request of grounds, of the link, of the store: any thread
requests one, the frame loop decides (`Keyframes.now`). It is the largest message there is, so it is announced: while
one is due stills are held, and it is sent as soon as it fits the budget's window. A scheduled one may wait
``scheduled_patience_ns`` for that, a requested one ``patience_ns``, so that a ground that joins late sees a picture
within a second.

A ground's requests are limited by a token bucket, so that no client can make the stream all keyframes: a request
costs the time in which a keyframe's bytes are ``request_share`` of the budget. After reported losses it is free: on
a lossy link a refused keyframe is a dark screen.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS

_MOST_RECEIVERS = 16
"""Number of receivers whose losses are remembered: ids cost a sender nothing."""
FIRST_SHARE = 0.85
"""The base's share of the budget until the scene is known: between the best on a car park (0.9) and on small
objects (0.8) at 200 kbps."""


@dataclass(frozen=True, slots=True)
class AutoDecisions:
    """Which parts are sent beside the video, as far as the settings allow it."""

    tracks: bool = True
    stills: bool = True
    """Stills of the method; a still that a ground requests is always sent."""
    says: str = ""
    """The reason, in a line for the user; empty where nothing is measured."""


@dataclass(frozen=True, slots=True)
class Rates:
    """The rates for which x265 is opened, in line bits a second."""

    total_bps: int
    """B_tot: the budget, or less if the link carries less."""
    base_bps: int
    """B_v."""
    decimation: int
    """Each n-th source frame is coded."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The rates of one moment, in line bits a second."""

    budget_bps: int
    """B_tot as set or commanded; `total_bps` never exceeds it."""
    video_share: float | None
    """The base stream's share of it, as set or commanded; None: it follows the scene."""
    method: str
    total_bps: int
    """The rate that may be sent now: the budget, or less if the link carries less."""
    base_bps: int
    """B_v: the rate for which x265 was opened."""
    decimation: int
    """Each n-th source frame is coded."""
    highest_budget_bps: int
    """The highest of all budgets that were in force."""
    preset: str = ""
    preset_says: str = ""
    """The reason for the preset, in a line for the user; empty where nothing had to be given up."""
    decisions: AutoDecisions = AutoDecisions()
    started_ns: int = 0
    """When the first frame was taken; 0 before."""


class Operating:
    """Holds the newest point; thread-safe."""

    def __init__(self, *, budget_bps: int, **beginning: Any) -> None:
        """Begin with the whole budget; ``beginning`` are further fields of `OperatingPoint`."""
        self._point = OperatingPoint(
            budget_bps=budget_bps, total_bps=budget_bps, highest_budget_bps=budget_bps, **beginning
        )
        self._lock = threading.Lock()

    @property
    def now(self) -> OperatingPoint:
        return self._point

    def set(self, **changes: Any) -> None:
        """Set these fields of `OperatingPoint`; a budget, a share or a preset takes effect with the next keyframe."""
        with self._lock:
            now = replace(self._point, **changes)
            self._point = replace(now, highest_budget_bps=max(now.highest_budget_bps, now.budget_bps))


@dataclass(eq=False)
class LoopClock:
    """The time of the budget's windows: the wall clock, or in lockstep the newest frame's capture time.

    ``wait(seconds)`` sleeps; in lockstep nothing is waited for.
    """

    clock: Callable[[], int]
    _: KW_ONLY
    lockstep: bool
    wait: Callable[[float], object] = time.sleep
    _media_ns: int = 0

    def __call__(self) -> int:
        return self._media_ns if self.lockstep else self.clock()

    def advance(self, capture_ns: int) -> None:
        self._media_ns = capture_ns

    def wait_until(self, at_ns: int) -> None:
        """Sleep until the time at which the budget's window has room."""
        if not self.lockstep and (wait_ns := at_ns - self.clock()) > 0:
            self.wait(wait_ns / SECOND_NS)

    def pause(self, pause_ns: int) -> int:
        """Sleep for ``pause_ns``; return the time after it."""
        self.wait_until(self() + pause_ns)
        return self()


def base_rate_bps(total_bps: int, share: float, *, metadata_bps: int) -> int:
    """B_v of this total, at most all but the rate of tracks."""
    return round(min(total_bps * share, total_bps - metadata_bps))


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Times in nanoseconds; ``interval_ns`` of 0 sends keyframes on demand only."""

    interval_ns: int = 10 * SECOND_NS
    patience_ns: int = 3 * SECOND_NS // 5
    scheduled_patience_ns: int = 2 * SECOND_NS
    rest_ns: int = 3 * SECOND_NS // 10
    """Longest time after a keyframe for which it answers new requests: they crossed it on the way. With
    the second request of a ground (0.3 s after the first) and the patience it stays under a second."""
    coding_ns: int = SECOND_NS // 10
    """Time to code a keyframe and put it on the line: with the round trip, a request crosses it for as long."""
    burst: int = 6
    """Requests in a row: losses come in bursts."""
    refill_ns: int = 7 * SECOND_NS // 10
    """After the burst, least time between two requests, where losses were reported too; 0 for no limit. On a link
    that loses one frame in twenty, two seconds would show half of the frames that 0.7 s shows."""
    request_share: float = 0.35
    """Share of the budget for requested keyframes without reported losses."""
    camera_every_s: float | None = None
    """The usual time between the camera's own keyframes, which makes none on request; None: the edge makes them."""


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
        """Whether one of the open requests is a ground's."""
        self._paid_ns = -(2**63)
        """Requests are paid for up to this time: `_cost_ns` each."""
        self._keyframe_ns = 0
        """The cost of a keyframe, as time of the budget."""
        self._crosses_ns = self.settings.rest_ns
        """For this long after a keyframe, a request may have been sent before it arrived."""
        self._losses: Newest[int, int] = Newest(_MOST_RECEIVERS)
        """Losses by receiver, as of its last report."""
        self._lossy = False
        """Whether a receiver has lost more since the last keyframe."""
        self.sent = 0
        self.served = 0
        """Requests of grounds that were met by a keyframe of their own, or one that was due or fresh."""

    # Any thread

    def due(self, now_ns: int) -> bool:
        """Whether a keyframe is due: stills are held from now on until it is sent."""
        with self._lock:
            return self._requested_ns is not None or self._due_ns is not None or self._scheduled(now_ns)

    @property
    def made_here(self) -> bool:
        """Whether the edge makes the keyframes; a camera makes its own."""
        return self.settings.camera_every_s is None

    @property
    def requested(self) -> bool:
        """Whether a keyframe is due on request or at the start: not even a requested still goes before it."""
        with self._lock:
            return self._requested_ns is not None or self._last_ns is None

    @property
    def awaited(self) -> bool:
        """Whether a ground waits for one: it can show no other frame, and each would use the keyframe's room."""
        with self._lock:
            return self._by_ground

    def request(self, now_ns: int) -> str | None:
        """A ground requests a keyframe; return the reason for a refusal, in a sentence, or None where it is served.

        A request that costs no keyframe of its own is always served: one is due already, or the newest one is so
        fresh that it crossed the request on the way.
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
        """The edge itself needs one, because a setting changes with it; a camera's next one will do."""
        if not self.made_here:
            return
        with self._lock:
            self._add(now_ns)

    def report_losses(self, receiver_id: int, count: int) -> None:
        """A receiver reports its total of lost or damaged messages; after an increase its next request is free.

        It counts from 0 again after it has declared the link lost.
        """
        with self._lock:
            before = self._losses.get(receiver_id, 0)
            self._losses[receiver_id] = count
            self._lossy |= count > before

    def note_round_trip(self, round_trip_ns: int) -> None:
        """Note the link's round trip; a request that comes later than that after a keyframe means it was lost."""
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
        """A keyframe has just been encoded; it also answers requests made meanwhile."""
        with self._lock:
            self._last_ns, self._due_ns, self._requested_ns, self._by_ground = now_ns, None, None, False
            self._lossy = False  # losses before it are no reason any more
            self.sent += 1

    def note_cost(self, keyframe_ns: int) -> None:
        """Note the cost of a keyframe that was sent, as time of the whole budget."""
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
        # Take a token; return the reason where there is none. After a loss a request is free.
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
