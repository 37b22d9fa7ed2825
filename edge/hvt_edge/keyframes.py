"""When the next base frame becomes a keyframe: at the start, on a long schedule, and when a ground asks.

A keyframe is the largest message there is, so it is announced: while one is due, stills are held, and it is sent
as soon as it fits the budget's window. A scheduled one can wait until it does; one that a ground asked for waits
``patience_ns`` at the most, so that a ground that joins late sees a picture within a second.
"""

from __future__ import annotations

from dataclasses import dataclass

from hvt_edge.encode import keyframe_floor_bytes

__all__ = ["KeyframePlan", "KeyframeSettings", "keyframe_interval_s"]

_SECOND_NS = 1_000_000_000
_KEYFRAME_SHARE = 0.005


@dataclass(frozen=True, slots=True)
class KeyframeSettings:
    """Times in nanoseconds; ``interval_ns`` of 0 sends keyframes on demand only."""

    interval_ns: int = 10 * _SECOND_NS
    patience_ns: int = 3 * _SECOND_NS // 5
    scheduled_patience_ns: int = 2 * _SECOND_NS
    rest_ns: int = 3 * _SECOND_NS // 10
    """After a keyframe, requests are taken as answered by it for so long: they crossed it on the way. With the
    second request of a ground (0.3 s after the first) and the patience it stays under a second."""


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
        self.requests = 0
        self.sent = 0

    def request(self, now_ns: int) -> bool:
        """A ground wants a keyframe; False where the newest one is so fresh that it serves."""
        self.requests += 1
        if self._last_ns is not None and now_ns - self._last_ns < self._settings.rest_ns:
            return False
        if self._due_ns is None:
            self._due_ns = now_ns
        if self._asked_ns is None:
            self._asked_ns = now_ns
        return True

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
        self.sent += 1

    def _patient(self, now_ns: int) -> bool:
        settings = self._settings
        if self._asked_ns is not None:
            return now_ns - self._asked_ns < settings.patience_ns
        return self._due_ns is not None and now_ns - self._due_ns < settings.scheduled_patience_ns
