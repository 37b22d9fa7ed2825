"""From the access units of one edge, as the link delivers them, to those that a decoder may get.

After one lost P frame an HEVC decoder shows nothing, or garbage, until the next keyframe, and says so to
nobody. So the rule is strict: the decoder gets runs that start with a keyframe and have no hole, in order,
each unit once. Everything else is skipped and counted, and `Reassembler.wants_keyframe` says when to ask.

Four things are decided here:

*Reordering.* Zenoh keeps the order of a key on one link; on several links a unit may come late. A hole counts as lost
when it is twice as old as any was whose unit came late: at once where none of `ORDERLY_UNITS` was. At most
`REORDER_WAIT_NS`, and `REORDER_UNITS` units, are waited for. A keyframe never waits: units missing before it no
longer matter.

*Repair.* An edge sends units again that a report calls `missing`. A hole waits for that, and where it does not come
in the time that it usually takes, at first a round trip and some, for a keyframe as well: whichever is first
(`Repair`).

*Sessions.* An edge that restarts has a new session id and counts from 0. It is adopted with a keyframe, once
the present session has been silent for `SILENCE_NS` (or three of its own frames), and not more than once in
`ADOPTION_INTERVAL_NS`: late units of the old session or a flood of invented ids cannot make the picture jump to
and fro. Where the present session still goes on `DUPLICATE_AFTER_NS` after another first came, that is no
restart but a second edge of the same name: a *duplicate*, which is shown only when the first has been silent for
`DUPLICATE_SILENCE_NS`. A session that was left may come back, but only beyond where it had been. One that the edge
does not know (`Reassembler.disown`) is nobody's, and the one before it goes on.

*Plausibility.* A sequence number or frame index that is further ahead than `MAX_RATE_HZ` allows since the last
progress (plus some slack) does not count, so that one flipped bit cannot make all that follows look old. If
nothing else comes for `RESTART_SILENCE_NS` it was we who were wrong, and the next keyframe starts afresh. So it is
where nothing comes but old numbers that have not been here: somebody else has counted on in the edge's name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

from hvt_common.protocol.messages import MAX_MISSING_BASE, BaseHeader, Flags
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS

T = TypeVar("T")
Verdict = Literal["decode", "skip", "duplicate", "stale", "foreign", "implausible"]
"""What to do with an access unit. skip: fresh, but a unit before it is lost, or no keyframe has come yet;
stale: older than a unit that was given up or shown; foreign: of a session that is not the present one; implausible:
its numbers cannot be true."""

REORDER_UNITS = 2
REORDER_WAIT_NS = 100_000_000
RESEND_UNITS, RESEND_WAIT_NS = 24, 700_000_000
"""The most units that wait behind a hole that the edge was told of, and the longest wait."""
_SLACK_NS = 120_000_000
"""Beyond the round trip, for the first: a resent unit waits behind the bytes that the link already holds."""
_MOST_INTERVAL_NS, _MOST_HOLE_NS = 160_000_000, 210_000_000
"""From one unit to the next, and of all of a hole: more would be more of a second's bytes than are sent again."""
_UNANSWERED, _UNANSWERED_NS, _MOST_UNANSWERED_NS = 3, 20_000_000_000, 640_000_000_000
"""After 3 holes in a row without a resent unit no hole waits for 20 s; then one does, and the pause doubles."""
_MUCH_SOONER = 1.25
ORDERLY_UNITS = 30
SILENCE_NS = 500_000_000
ADOPTION_INTERVAL_NS = 1_000_000_000
DUPLICATE_AFTER_NS = 1_000_000_000
DUPLICATE_SILENCE_NS = 5_000_000_000
RESTART_SILENCE_NS = 2_000_000_000
MAX_RATE_HZ = 240
SEQUENCE_SLACK = 64
FRAME_SLACK = 4096  # after an outage a backlog comes at once, with holes for the frames that the edge dropped
_WINDOW_MASK = (1 << SEQUENCE_SLACK) - 1
_REMEMBERED_SESSIONS = 16
_REQUEST_INTERVALS_NS = (300_000_000, 300_000_000, 300_000_000, 600_000_000, 1_000_000_000)
_FRESH_NS = 100_000_000
"""An edge takes a request this soon behind a keyframe for answered by it (`KeyframeSettings.coding_ns`)."""


@dataclass(frozen=True, slots=True)
class Arrival(Generic[T]):
    """One access unit and its verdict. A unit that waited comes out later, in a later call's list."""

    verdict: Verdict
    header: BaseHeader
    message: T
    received_ns: int
    """``now_ns`` of the call that brought it."""
    starts_run: bool = False
    """A keyframe after a gap or of a new session: flush the decoder before it."""
    starts_session: bool = False
    """The first unit of another session, or of one whose count was lost: reset whatever counts frames."""
    lost_before: int = 0
    """How many units were given up just before this one; above 0 it is the end of a gap."""
    duplicate: bool = False
    """Foreign, and the present session goes on beside it: two edges of one name."""


@dataclass(slots=True)
class StreamCounters:
    """Counts of one session, and of units that came between it and the one before."""

    gaps: int = 0
    """Holes in the sequence that were given up."""
    lost: int = 0
    """Units missing in those holes."""
    resent: int = 0
    """Units that were lost, and came when the edge sent them again."""
    duplicates: int = 0
    replayed: int = 0
    """Verdict stale: late or replayed."""
    corrupt: int = 0
    """Reported by the caller: the header could not be read, or the CRC was wrong."""
    keyframe_requests: int = 0


class Repair:
    """Whether a hole is worth a wait for the edge to send it again, and how long.

    It is not where the edge has no room to fill it, where the round trip is too long, nor on a link where nothing
    came again of late: a keyframe, which a hole costs otherwise, would only be later.
    """

    def __init__(self) -> None:
        self.round_trip_ns: int | None = None
        """To the edge and back; None where nobody reports missing units to it."""
        self.begin(0, 0)

    def begin(self, sequence: int, now_ns: int) -> None:
        self.interval_ns = 0
        """About the time between two units."""
        self._newest = (sequence, now_ns)
        """The highest sequence, and when it came."""
        self.mean_ns = self._differs_ns = 0
        """How old a hole is when its unit comes that was sent again, and by how much that differs: of late, mean; 0
        before the first."""
        self._unanswered, self._until_ns, self._pause_ns = 0, 0, _UNANSWERED_NS
        """Holes without one; the time until which none waits; for how long none will."""

    def came(self, sequence: int, now_ns: int) -> None:
        if (units := sequence - self._newest[0]) > 0:
            step_ns = min((now_ns - self._newest[1]) // units, 2 * _MOST_INTERVAL_NS)  # more is a pause
            self.interval_ns = (3 * self.interval_ns + step_ns) // 4
            self._newest = sequence, now_ns

    def came_again(self, late_ns: int) -> None:
        """A unit that was sent again fills a hole that waits, and is so old."""
        if not self.mean_ns:
            self.mean_ns, self._differs_ns = late_ns, late_ns // 4
        self._differs_ns = (3 * self._differs_ns + abs(late_ns - self.mean_ns)) // 4
        self.mean_ns = (7 * self.mean_ns + late_ns) // 8
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
        """Whether a hole of ``count`` units waits, behind which the first has come at ``since_ns``."""
        return (
            self.round_trip_ns is not None
            and self.round_trip_ns + _SLACK_NS <= min(RESEND_WAIT_NS, RESEND_UNITS * self.interval_ns)
            and 0 < count <= MAX_MISSING_BASE
            and self.interval_ns <= _MOST_INTERVAL_NS
            and count * self.interval_ns <= _MOST_HOLE_NS
            and since_ns >= self._until_ns
        )

    @property
    def usual_ns(self) -> int:
        """How long that usually takes: then a keyframe is wanted as well."""
        usual_ns = (self.round_trip_ns or 0) + _SLACK_NS
        if self.mean_ns:
            usual_ns = self.mean_ns + max(2 * self._differs_ns, self.mean_ns // 8)
        return min(RESEND_WAIT_NS, usual_ns)


class Reassembler(Generic[T]):
    """Order, gaps, duplicates and sessions of the base stream of one edge.

    ``now_ns`` is any clock that does not go back (monotonic); the same one in all calls.
    """

    def __init__(self) -> None:
        self.repair = Repair()
        self.counters = StreamCounters()
        self._session: int | None = None
        self._adopted_ns: int | None = None
        self._left: Newest[int | None, int] = Newest(_REMEMBERED_SESSIONS)
        """Session id → the sequence it had reached."""
        self._outsiders: Newest[int | None, int] = Newest(_REMEMBERED_SESSIONS)
        """Session id → when it first came."""
        self._disowned: Newest[int | None, None] = Newest(_REMEMBERED_SESSIONS)
        self._first = 0
        self._next = 0
        self._last_frame = -1
        self._recent = 0  # bit i: the sequence _next - 1 - i has been here
        self._held: dict[int, Arrival[T]] = {}
        self._synced = False
        self._progress_ns = 0
        self._unshown = False  # something came since the last progress that could not be used
        self._hole_ns = 0  # when the newest hole that was given up was first seen
        self._late_ns = 0  # how old a hole ever was when its unit came
        self._taken = 0
        self._quiet_until_ns = 0  # no request goes before
        self._requested_ns = self._answer_ns = 0  # when the first of this gap went; how long answers take
        self._requests_in_gap = 0

    def accept(self, header: BaseHeader, message: T, *, now_ns: int) -> list[Arrival[T]]:
        """Take the message of an access unit whose CRC is right; return all that is now settled, in order."""
        unit = Arrival("decode", header, message, now_ns)
        if header.session_id in self._disowned:
            return [self._judged(unit, "foreign")]
        if self._adopted_ns is None or header.session_id != self._session:
            duplicate = self._is_duplicate(header.session_id, now_ns)
            patience_ns = DUPLICATE_SILENCE_NS
            if not duplicate:
                patience_ns = min(patience_ns, max(SILENCE_NS, 3 * self.repair.interval_ns))
            return self._accept_outsider(unit, "foreign", patience_ns=patience_ns, duplicate=duplicate)
        self._note_late(header, now_ns)
        if self._first <= header.sequence < self._next or header.sequence in self._held:
            if now_ns - self._progress_ns < RESTART_SILENCE_NS or self._has_been(header.sequence):
                return [self._judged(unit, "duplicate" if self._has_been(header.sequence) else "stale")]
            return self._accept_outsider(unit, "stale", patience_ns=RESTART_SILENCE_NS)
        if not self._plausible(header, now_ns):
            return self._accept_outsider(unit, "implausible", patience_ns=RESTART_SILENCE_NS)
        self.repair.came(header.sequence, now_ns)
        self._held[header.sequence] = unit
        return self.overdue(now_ns=now_ns)

    @property
    def missing(self) -> tuple[int, ...]:
        """The sequences behind which newer units wait, where it may help that the edge sends them again."""
        if not self._held or not self._synced:
            return ()
        newest, since_ns = max(self._held), min(unit.received_ns for unit in self._held.values())
        if not self.repair.waits(newest + 1 - self._next - len(self._held), since_ns):
            return ()
        return tuple(one for one in range(self._next, newest) if one not in self._held)

    def named(self, now_ns: int) -> tuple[int, ...]:
        """Those to tell the edge: not before they are as late as units usually are that come by themselves."""
        return self.missing if self._hole_age_ns(now_ns) >= self._reorder_ns else ()

    @property
    def newest_held(self) -> Arrival[T] | None:
        """The newest unit that waits behind a hole."""
        return self._held[max(self._held)] if self._held else None

    def corrupt(self) -> None:
        """Count a message of the base stream that could not be read or whose CRC was wrong."""
        self.counters.corrupt += 1
        self._unshown = True

    def decoder_failed(self) -> None:
        """The decoder showed nothing for a unit it was given: skip to the next keyframe."""
        self._synced = False

    def disown(self) -> None:
        """The session that was adopted last is nobody's: skip it, and go on with the next keyframe of any other."""
        self._disowned[self._session] = None
        self._held.clear()
        self._outsiders.clear()
        self._adopted_ns, self._synced, self._unshown = None, False, True

    def wants_keyframe(self, now_ns: int) -> bool:
        """Whether to ask the edge for a keyframe now: something comes, and nothing can be shown of it.

        Before anything has come it is False: an edge starts with a keyframe anyway. The requests of one gap
        are 0.3 s apart, from the fourth on 0.6 and 1 s, but an answer's usual time at the least; `keyframe_requested`
        notes each.
        """
        if now_ns < self._quiet_until_ns:
            return False
        if self._adopted_ns is None:
            return self._unshown
        if not self._synced or (self._held and self._hole_age_ns(now_ns) >= self._alone_ns):
            return True
        return self._unshown and now_ns - self._progress_ns >= SILENCE_NS

    def keyframe_requested(self, now_ns: int) -> None:
        self.counters.keyframe_requests += 1
        self._requests_in_gap += 1
        if self._requests_in_gap == 1:
            self._requested_ns = now_ns
        interval_ns = _REQUEST_INTERVALS_NS[min(self._requests_in_gap, len(_REQUEST_INTERVALS_NS) - 1)]
        self._quiet_until_ns = now_ns + max(interval_ns, 5 * self._answer_ns // 4)

    # Within the session: a hole waits, then is given up.

    def overdue(self, *, now_ns: int) -> list[Arrival[T]]:
        """Units that need not wait any longer behind a hole: at most `REORDER_UNITS` wait, or `RESEND_UNITS`."""
        released: list[Arrival[T]] = []
        keyframe = max((one for one, unit in self._held.items() if unit.header.keyframe), default=-1)
        while self._held:
            first = min(self._held)
            lost = first - self._next
            if (
                lost
                and first > keyframe
                and len(self._held) <= (RESEND_UNITS if self.missing else REORDER_UNITS)
                and self._hole_age_ns(now_ns) < (RESEND_WAIT_NS if self.missing else self._reorder_ns)
            ):
                break
            if lost:
                if self.missing:
                    self.repair.unanswered(self._hole_age_ns(now_ns), now_ns)
                self._give_up(lost, now_ns)
            verdict = self._take(unit := self._held.pop(first))
            released.append(self._judged(unit, verdict, lost_before=lost))
        return released

    def _give_up(self, lost: int, now_ns: int) -> None:
        self._hole_ns = now_ns - self._hole_age_ns(now_ns)
        self.counters.gaps += 1
        self.counters.lost += lost
        self._recent = self._recent << min(lost, SEQUENCE_SLACK) & _WINDOW_MASK
        self._next += lost
        self._synced = False

    def _take(self, unit: Arrival[T]) -> Verdict:
        header = unit.header
        self._recent = (self._recent << 1 | 1) & _WINDOW_MASK
        self._next = header.sequence + 1
        self._taken += 1
        self.counters.resent += bool(header.flags & Flags.RESENT)
        if header.frame_index <= self._last_frame:  # two units that waited contradict each other
            self._synced = False
            return "implausible"
        self._last_frame = header.frame_index
        self._progress_ns = max(self._progress_ns, unit.received_ns)  # it may have waited
        self._unshown = False
        if not self._synced and not header.keyframe:
            return "skip"
        return "decode"

    def _has_been(self, sequence: int) -> bool:
        # Whether this old number is known to have come; of those long ago nothing is known.
        age = self._next - 1 - sequence  # negative: waiting behind a hole, so it is here already
        return age < 0 or (age < SEQUENCE_SLACK and bool(self._recent >> age & 1))

    def _plausible(self, header: BaseHeader, now_ns: int) -> bool:
        ahead = (now_ns - self._progress_ns) * MAX_RATE_HZ // 1_000_000_000
        steps = header.sequence - self._next, header.frame_index - self._last_frame
        return 0 <= steps[0] <= SEQUENCE_SLACK + ahead and 0 < steps[1] <= FRAME_SLACK + ahead

    def _hole_age_ns(self, now_ns: int) -> int:
        return max((now_ns - unit.received_ns for unit in self._held.values()), default=0)

    @property
    def _reorder_ns(self) -> int:
        return REORDER_WAIT_NS if self._taken < ORDERLY_UNITS else min(REORDER_WAIT_NS, 2 * self._late_ns)

    @property
    def _alone_ns(self) -> int:
        # How long a hole waits before a keyframe is wanted: no longer where that is there much sooner.
        slow = 0 < _MUCH_SOONER * self._answer_ns < self.repair.mean_ns
        return self._reorder_ns if slow or not self.missing else max(self._reorder_ns, self.repair.usual_ns)

    def _note_late(self, header: BaseHeader, now_ns: int) -> None:
        # The unit of a hole comes after all, before or after that was given up: of use is a resent one before alone.
        sequence = header.sequence
        if self._held and self._next <= sequence < max(self._held) and sequence not in self._held:
            late_ns = self._hole_age_ns(now_ns)
            if header.flags & Flags.RESENT:
                self.repair.came_again(late_ns)
                return
        elif max(self._first, self._next - SEQUENCE_SLACK) <= sequence < self._next and not self._has_been(
            sequence
        ):
            late_ns = now_ns - self._hole_ns
        else:
            return
        if not header.flags & Flags.RESENT:
            self._late_ns = max(self._late_ns, late_ns)

    # Between sessions.

    def _is_duplicate(self, session_id: int, now_ns: int) -> bool:
        if self._adopted_ns is None:
            return False
        since_ns = self._outsiders.setdefault(session_id, now_ns)
        self._outsiders.move_to_end(session_id)
        return self._progress_ns - since_ns > DUPLICATE_AFTER_NS

    def _accept_outsider(
        self, unit: Arrival[T], refusal: Verdict, *, patience_ns: int, duplicate: bool = False
    ) -> list[Arrival[T]]:
        # A unit that does not continue the session: adopted with a keyframe when the session is silent.
        header, now_ns = unit.header, unit.received_ns
        if header.sequence < self._left.get(header.session_id, 0) or header.flags & Flags.RESENT:
            return [self._judged(unit, "stale")]
        if self._adopted_ns is None:
            too_soon, refusal = False, "skip"
        else:
            newest = self.newest_held
            came_ns = self._progress_ns if newest is None else newest.received_ns
            silent_ns, adopted_ns = now_ns - came_ns, now_ns - self._adopted_ns
            too_soon = silent_ns < patience_ns or adopted_ns < ADOPTION_INTERVAL_NS
        if not (too_soon and duplicate):  # while the first edge goes on, nothing of the second is missed
            self._unshown = True
        if too_soon or not header.keyframe:
            return [self._judged(unit, refusal, duplicate=duplicate and too_soon)]
        resolved = [self._judged(one, "skip") for _, one in sorted(self._held.items())]
        self._adopt(header, now_ns)
        verdict = self._take(unit)
        return [*resolved, self._judged(unit, verdict, starts_session=True)]

    def _adopt(self, header: BaseHeader, now_ns: int) -> None:
        self._held.clear()
        self._synced = False
        if self._adopted_ns is not None and header.session_id != self._session:
            self._left[self._session] = self._next
            self._left.move_to_end(self._session)
        self._left.pop(header.session_id, None)
        self._session, self._adopted_ns = header.session_id, now_ns
        self._outsiders.clear()
        self._progress_ns = now_ns
        self.repair.begin(header.sequence, now_ns)
        self._first = self._next = header.sequence
        self._last_frame, self._recent = header.frame_index - 1, 0

    def _judged(self, unit: Arrival[T], verdict: Verdict, **more: Any) -> Arrival[T]:
        self.counters.duplicates += verdict == "duplicate"
        self.counters.replayed += verdict == "stale"
        starts_run = verdict == "decode" and not self._synced
        if verdict == "decode":
            if starts_run and self._requests_in_gap:
                self._quiet_until_ns = unit.received_ns + _FRESH_NS
                answer_ns = min(unit.received_ns - self._requested_ns, SECOND_NS)
                more_ns = answer_ns - self._answer_ns  # more, too, where a request was lost, and seldom
                self._answer_ns += more_ns // 4 if more_ns > 0 and self._answer_ns else more_ns
            self._synced = True
            self._requests_in_gap = 0
        return replace(unit, verdict=verdict, starts_run=starts_run, **more)
