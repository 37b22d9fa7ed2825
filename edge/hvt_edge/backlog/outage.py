"""Whether the link is down. Time is an argument.

It is down if nobody subscribes any more (Zenoh notices that some seconds after the link broke), or if a ground that
used to report is silent (it reports twice a second whatever it receives, so this is noticed much sooner).
"""

from __future__ import annotations

from hvt_common.units import SECOND_NS

_MS = 1_000_000
SILENCE_NS = 1_500 * _MS
"""Three reports in a row that did not come."""
_LEFT_NS = 15 * SECOND_NS
"""Who is silent for so long on a link that Zenoh still has, has left; others may subscribe
that never report. The same as in `hvt_edge.link.pacer`."""


class Outage:
    """For one run of an edge. ``live``: the source is a camera, which waits for nobody."""

    def __init__(self, *, live: bool) -> None:
        self._live = live
        self._subscribed = False
        self._linked = False
        self._reported_ns: int | None = None
        self.reports = False
        """Whether a ground ever reported on this session: without reports nobody knows what has arrived."""

    def reported(self, now_ns: int) -> None:
        """A ground has reported on this session (any thread)."""
        self._reported_ns = now_ns
        self.reports = True

    def reports_now(self, now_ns: int) -> bool:
        reported_ns = self._reported_ns
        return reported_ns is not None and now_ns - reported_ns <= SILENCE_NS

    def offline(self, now_ns: int, *, linked: bool) -> bool:
        """Whether the link is away; called before each frame. ``linked``: Zenoh reports a subscriber.

        Before anybody ever subscribed, only a live source is stored: a clip plays again.
        """
        if not linked:
            self._linked = False
            return self._subscribed or self._live
        if not self._linked:  # a new path: the silence of before says nothing about it
            self._linked = self._subscribed = True
            self._reported_ns = None
        reported_ns = self._reported_ns
        if reported_ns is not None and now_ns - reported_ns > _LEFT_NS:
            self._reported_ns = reported_ns = None
        return reported_ns is not None and now_ns - reported_ns > SILENCE_NS
