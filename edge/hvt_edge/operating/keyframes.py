"""When the next base frame becomes a keyframe: at the start, on a long schedule, and when a ground asks.

A keyframe is the largest message there is, so it is announced: while one is due, stills are held, and it is sent
as soon as it fits the budget's window. A scheduled one can wait until it does; one that a ground asked for waits
``patience_ns`` at the most, so that a ground that joins late sees a picture within a second.

Requests are paid for out of a purse, so that whoever may command cannot make the stream all keyframes: one costs
the time in which its bytes are ``asked_share`` of the budget. Where reports tell of losses none is needed: on a lossy
link a refused keyframe is a dark screen.
"""

from __future__ import annotations

from dataclasses import dataclass

from hvt_edge.video.x265 import keyframe_floor_bytes

__all__ = ["KeyframePlan", "KeyframeSettings", "keyframe_interval_s"]

_SECOND_NS = 1_000_000_000
_KEYFRAME_SHARE = 0.005
_MOST_RECEIVERS = 16
"""Whose losses are remembered: ids cost a sender nothing."""


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Times in nanoseconds; ``interval_ns`` of 0 sends keyframes on demand only."""

    interval_ns: int = 10 * _SECOND_NS
    patience_ns: int = 3 * _SECOND_NS // 5
    scheduled_patience_ns: int = 2 * _SECOND_NS
    rest_ns: int = 3 * _SECOND_NS // 10
    """After a keyframe, requests are taken as answered by it for so long: they crossed it on the way. With the
    second request of a ground (0.3 s after the first) and the patience it stays under a second."""
    burst: int = 6
    """So many may be asked for in a row: losses come in bursts."""
    refill_ns: int = 7 * _SECOND_NS // 10
    """After that one in so long at the most, where losses were reported too; 0 for no limit. On a link that loses one
    frame in twenty, two seconds would show half of what 0.7 s shows."""
    asked_share: float = 0.35
    """Of the budget, for keyframes that nobody needs as far as the edge can tell."""


def keyframe_interval_s(size: tuple[int, int], base_bps: int) -> float:
    """How long to go without a scheduled keyframe where nobody says: 10 s, up to 60 s where the rate is thin.

    A keyframe that the VBV lets through at a low rate is far coarser than the frames before it, and the picture takes
    seconds to recover: at 200 kbps and 1280x720 the objects found fell from 62 to 6. Grounds that join or lose
    something ask for theirs anyhow; the schedule only lets a viewer jump within a recording. So its bytes
    are kept to half a percent of the stream.
    """
    return min(60.0, max(10.0, 8 * keyframe_floor_bytes(size) / (_KEYFRAME_SHARE * base_bps)))


class KeyframePlan:
    """Decides frame by frame; time is an argument."""

    def __init__(self, settings: KeyframeSettings = KeyframeSettings()) -> None:
        self._settings = settings
        self._last_ns: int | None = None
        self._due_ns: int | None = None
        self._asked_ns: int | None = None
        self._spent_ns = -(2**63)
        """Asked keyframes are paid for up to this time: `_price_ns` each."""
        self._takes_ns = 0
        """What a keyframe takes of the budget, as time."""
        self._losses: dict[int, int] = {}
        """By receiver, as its last report counted them."""
        self._lossy = False
        """Whether somebody has lost more since the last keyframe."""
        self.requests = 0
        """Those that were served, by a keyframe of their own or one that was due or fresh."""
        self.sent = 0

    def request(self, now_ns: int) -> str | None:
        """A ground wants a keyframe; return why it gets none now, in a sentence, or None where it is served.

        What costs no keyframe of its own is always served: one is due already, or the newest one is so fresh that it
        crossed the request on the way.
        """
        fresh = self._last_ns is not None and now_ns - self._last_ns < self._settings.rest_ns
        if not fresh and self._due_ns is None and self._last_ns is not None:
            refusal = self._pay(now_ns, last_ns=self._last_ns)
            if refusal is not None:
                return refusal
        self.requests += 1
        if not fresh:
            self.renew(now_ns)
        return None

    def note_losses(self, receiver_id: int, count: int) -> None:
        """A receiver reports so many lost or damaged messages in all; it may ask for a keyframe without paying."""
        before = self._losses.get(receiver_id, 0)
        if count <= before:
            return
        if receiver_id not in self._losses and len(self._losses) >= _MOST_RECEIVERS:
            del self._losses[next(iter(self._losses))]
        self._losses[receiver_id] = count
        self._lossy = True

    def renew(self, now_ns: int) -> None:
        """The edge itself wants one, because something is to change with it."""
        self._due_ns = now_ns if self._due_ns is None else self._due_ns
        self._asked_ns = now_ns if self._asked_ns is None else self._asked_ns

    def due(self, now_ns: int) -> bool:
        """Tell whether a keyframe is to come: stills are held from now on until it has gone."""
        if self._last_ns is None:
            return True
        interval_ns = self._settings.interval_ns
        if self._due_ns is None and interval_ns and now_ns - self._last_ns >= interval_ns:
            self._due_ns = now_ns
        return self._due_ns is not None

    def now(self, now_ns: int, *, fits: bool) -> bool:
        """Tell whether this very frame is to be the keyframe; ``fits``: the budget's window has room for it."""
        if not self.due(now_ns):
            return False
        return fits or not self._patient(now_ns)

    def done(self, now_ns: int) -> None:
        """A keyframe has just been encoded."""
        self._last_ns, self._due_ns, self._asked_ns = now_ns, None, None
        self._lossy = False
        self.sent += 1

    def note_cost(self, takes_ns: int) -> None:
        """A keyframe has been sent that takes the whole budget for so long."""
        self._takes_ns = takes_ns

    @property
    def _price_ns(self) -> int:
        return max(self._settings.refill_ns, round(self._takes_ns / self._settings.asked_share))

    def _pay(self, now_ns: int, *, last_ns: int) -> str | None:
        """Take the price out of the purse; why not, where it is empty. After a loss nobody pays."""
        settings, price_ns = self._settings, self._price_ns
        if settings.refill_ns == 0 or (self._lossy and now_ns - last_ns >= settings.refill_ns):
            return None
        spent_ns = max(self._spent_ns, now_ns - settings.burst * price_ns) + price_ns
        if spent_ns > now_ns:
            return (
                f"the last keyframe came {(now_ns - last_ns) / _SECOND_NS:.1f} s ago, after many others: ask again "
                f"in {(spent_ns - now_ns) / _SECOND_NS:.1f} s"
            )
        self._spent_ns = spent_ns
        return None

    def _patient(self, now_ns: int) -> bool:
        settings = self._settings
        if self._asked_ns is not None:
            return now_ns - self._asked_ns < settings.patience_ns
        return self._due_ns is not None and now_ns - self._due_ns < settings.scheduled_patience_ns
