"""Schedules keyframes: at the start, on a long schedule, and on request.

A keyframe is the largest message there is, so it is announced: while one is due stills are held, and it is sent as
soon as it fits the budget's window. A scheduled one may wait ``scheduled_patience_ns`` for that, a requested one
``patience_ns``, so that a ground that joins late sees a picture within a second.
"""

from __future__ import annotations

from hvt_edge.operating.keyframes import KeyframeRequests, KeyframeState
from hvt_edge.video.encoder_settings import usual_keyframe_bytes

_KEYFRAME_SHARE = 0.005


class KeyframePlan:
    """Decides frame by frame; the frame loop's alone. Others see what it publishes to ``requests``."""

    def __init__(self, requests: KeyframeRequests) -> None:
        self._requests = requests
        self._settings = requests.settings
        self._last_ns: int | None = None
        self._due_ns: int | None = None
        self._requested_ns: int | None = None
        self._sent = 0

    def now(self, now_ns: int, *, fits: bool) -> bool:
        """Tell whether this very frame is to be the keyframe; ``fits``: the budget's window has room for it."""
        requested_ns = self._requests.take()
        if requested_ns is not None:
            self._due_ns = requested_ns if self._due_ns is None else self._due_ns
            self._requested_ns = requested_ns if self._requested_ns is None else self._requested_ns
        if self._due_ns is None and self._scheduled(now_ns):
            self._due_ns = now_ns
        self._publish()
        if self._last_ns is None:
            return True
        return self._due_ns is not None and (fits or not self._waits(self._due_ns, now_ns))

    def done(self, now_ns: int) -> None:
        """A keyframe has just been encoded; it also answers what was requested meanwhile."""
        self._requests.take()
        self._last_ns, self._due_ns, self._requested_ns = now_ns, None, None
        self._sent += 1
        self._publish()

    def _scheduled(self, now_ns: int) -> bool:
        return KeyframeState(self._settings.interval_ns, self._last_ns).due(now_ns)

    def _waits(self, due_ns: int, now_ns: int) -> bool:
        if self._requested_ns is not None:
            return now_ns - self._requested_ns < self._settings.patience_ns
        return now_ns - due_ns < self._settings.scheduled_patience_ns

    def _publish(self) -> None:
        self._requests.publish(
            KeyframeState(
                self._settings.interval_ns,
                self._last_ns,
                self._due_ns,
                self._sent,
                requested=self._requested_ns is not None,
            )
        )


def keyframe_interval_s(size: tuple[int, int], base_bps: int) -> float:
    """The default time between scheduled keyframes: 10 s, up to 60 s where the rate is thin.

    A keyframe that the VBV lets through at a low rate is far coarser than the frames before it, and the picture takes
    seconds to recover: at 200 kbps and 1280x720 the objects found fell from 62 to 6. Grounds that join or lose
    something request theirs anyhow; the schedule only lets a viewer jump within a recording. So its bytes
    are held to half a percent of the stream.
    """
    return min(60.0, max(10.0, 8 * usual_keyframe_bytes(size) / (_KEYFRAME_SHARE * base_bps)))
