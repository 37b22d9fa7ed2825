"""Whether a hole in the base stream is worth a wait for what the edge sends again, and how long. Pure.

It is not where the edge has no room to fill it, where the round trip is too long, nor on a link where nothing came
again of late: a keyframe, which a hole costs otherwise, would only be later.
"""

from __future__ import annotations

from hvt_common.protocol.messages import MAX_MISSING_BASE

RESEND_UNITS, RESEND_WAIT_NS = 24, 700_000_000
"""So many units, and so long, wait at most behind a hole that the edge was told of."""
_SLACK_NS = 120_000_000
"""Beyond the round trip, for the first: a resent unit waits behind what the link already holds."""
_MOST_INTERVAL_NS, _MOST_HOLE_NS = 160_000_000, 210_000_000
"""From one unit to the next, and of all of a hole: more would be more of a second's bytes than are sent again."""
_UNANSWERED, _UNANSWERED_NS, _MOST_UNANSWERED_NS = 3, 20_000_000_000, 640_000_000_000
"""After so many holes in a row for which nothing came again none waits for so long; then one, and twice as long."""


class Repair:
    """What is known of the present session's resent units. ``now_ns`` is the `Reassembler`'s clock."""

    def __init__(self) -> None:
        self.round_trip_ns: int | None = None
        """To the edge and back; None where nobody tells it what is missing."""
        self.interval_ns = 0
        """About the time between two units."""
        self._newest = (0, 0)
        """The highest sequence, and when it came."""
        self._took_ns: tuple[int, int] | None = None
        """How old a hole is when its unit comes that was sent again, and by how much that differs: of late, mean."""
        self._unanswered, self._until_ns, self._pause_ns = 0, 0, _UNANSWERED_NS
        """Holes without one; the time until which none waits; for how long none will."""

    def begin(self, sequence: int, now_ns: int) -> None:
        """The first unit of a session comes."""
        self.interval_ns, self._newest = 0, (sequence, now_ns)

    def came(self, sequence: int, now_ns: int) -> None:
        """Another unit comes."""
        if (units := sequence - self._newest[0]) > 0:
            self.interval_ns = (3 * self.interval_ns + (now_ns - self._newest[1]) // units) // 4
            self._newest = sequence, now_ns

    def came_again(self, late_ns: int) -> None:
        """A unit comes that was sent again, so long after its hole was seen."""
        mean_ns, differs_ns = self._took_ns or (late_ns, late_ns // 4)
        differs_ns = (3 * differs_ns + abs(late_ns - mean_ns)) // 4
        self._took_ns = (7 * mean_ns + late_ns) // 8, differs_ns
        self._unanswered, self._until_ns, self._pause_ns = 0, 0, _UNANSWERED_NS

    def unanswered(self, age_ns: int, now_ns: int) -> None:
        """A hole that waited ends unfilled; it was so old."""
        if age_ns < self.usual_ns:
            return
        self._unanswered += 1
        if self._unanswered >= _UNANSWERED:
            self._until_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, _MOST_UNANSWERED_NS)

    def waits(self, count: int, since_ns: int) -> bool:
        """Whether a hole of so many units waits, behind which the first has come at ``since_ns``."""
        return (
            self.round_trip_ns is not None
            and self.round_trip_ns + _SLACK_NS <= RESEND_WAIT_NS
            and 0 < count <= MAX_MISSING_BASE
            and self.interval_ns <= _MOST_INTERVAL_NS
            and count * self.interval_ns <= _MOST_HOLE_NS
            and since_ns >= self._until_ns
        )

    @property
    def usual_ns(self) -> int:
        """How long that usually takes: then a keyframe is wanted as well."""
        usual_ns = (self.round_trip_ns or 0) + _SLACK_NS
        if self._took_ns is not None:
            mean_ns, differs_ns = self._took_ns
            usual_ns = mean_ns + max(2 * differs_ns, mean_ns // 8)
        return min(RESEND_WAIT_NS, usual_ns)
