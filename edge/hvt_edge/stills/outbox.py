"""One outbox holds each still through its whole life, from the pending crop to the report that names it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

from hvt_common.units import SECOND_NS
from hvt_edge.backlog.entry import FIRST_STORED
from hvt_edge.link.stills import Still
from hvt_edge.stills.policy.base import Request

AGAIN = "again"
"""The reason of a still whose crop was sent before, and the parameter that names the first still's sequence."""
_MIB = 2**20


class StillState(Enum):
    """The state of a still; `Outbox` has the table."""

    PENDING = "waits for its allowance"
    SENT = "sent, and not named by any report"
    ACKNOWLEDGED = "received by the primary receiver"
    LOST = "sent before the link went away, and not acknowledged"
    STORED = "in the backlog"
    EXPIRED = "given up"


@dataclass(frozen=True, slots=True)
class OutboxSettings:
    """Bounds, and the times after which a still is overdue."""

    max_pending: int = 8
    """Limit for the method; requested stills have their own bound."""
    max_pending_ns: int = SECOND_NS
    """A crop that has waited longer shows a past the operator no longer needs."""
    max_on_demand_ns: int = 10 * SECOND_NS
    max_sent: int = 64
    max_sent_bytes: int = 2 * _MIB
    max_crop_bytes: int = 8 * _MIB
    max_sent_ns: int = 4 * SECOND_NS
    least_wait_ns: int = SECOND_NS
    wait_round_trips: int = 3
    """A still is overdue after this many round trips, and after ``least_wait_ns`` at the earliest."""


@dataclass(slots=True, eq=False)
class OutboxStill:
    """One still. Only the outbox changes its state."""

    job: Still | None
    """The crop to be coded; for a sent still the crop to be coded again, None where that is impossible."""
    request: Request | None
    utility: float
    """The method's score; infinite if a ground requested it."""
    since_ns: int | None
    """The time since which it is pending; None until the sending thread has seen it."""
    again: bool = False
    """The ground could not decode the first still of this crop."""
    state: StillState = StillState.PENDING
    coded: Still | None = None
    sent_ns: int = 0
    copies: int = 0

    @property
    def still(self) -> Still:
        assert self.coded is not None, f"{self.state}: it is not coded"
        return self.coded

    @property
    def crop(self) -> Still:
        assert self.job is not None, f"{self.state}: its crop is gone"
        return self.job

    @property
    def track_id(self) -> int:
        return (self.coded or self.crop).header.track_id

    @property
    def track_ids(self) -> set[int]:
        return {self.track_id, *(one.track_id for one in self.crop.header.also)}


class Outbox:
    """Every still of a run, bounded in number, bytes and age. Thread-safe; time is an argument.

    ============  =================================================  =======================================
    state         event                                              then
    ============  =================================================  =======================================
    PENDING       a newer still of its track (`offer`)               EXPIRED, ``replaced``
    PENDING       too many pending, and this the least useful        EXPIRED, ``queue_full``
    PENDING       it waits too long (`expire`)                       EXPIRED, ``stale``
    PENDING       coding gives no still, or the run ends             EXPIRED
    PENDING       coded, the link carries it (`sent`)                SENT
    PENDING       coded, the link is away (`stored`)                 STORED
    SENT          no report names it in time (`overdue`)             SENT, as a second copy (`sent_again`)
    SENT          a report names it (`on_report`)                    ACKNOWLEDGED
    SENT          the link goes away, or the run ends (`lose`)       LOST
    SENT          newer ones need its space                          EXPIRED
    SENT, ACK.    the ground cannot decode it (`on_undecodable`)     as before, and its crop PENDING once more
    ACKNOWLEDGED  its crop is too old to be coded again              EXPIRED
    LOST          handed over without the base (`stored`)            STORED
    ============  =================================================  =======================================

    Pending stills of the method are ordered by utility, at most one of each track; requested stills wait
    in a queue of their own, first come first served. ``reports``: whether reports count. In lockstep they do not,
    because their arrival times must not decide which stills are sent.
    """

    def __init__(self, settings: OutboxSettings = OutboxSettings(), *, reports: bool = True) -> None:
        self.settings = settings
        self._reports = reports
        self._lock = threading.RLock()
        self.turn = threading.RLock()
        """Held from a still's numbering until it is sent: two threads send, and numbers must rise."""
        self._pending: dict[int, OutboxStill] = {}
        self._on_demand: deque[OutboxStill] = deque()
        self._sent: dict[int, OutboxStill] = {}
        """The stills by sequence, in the order of sending: not acknowledged, or with a crop to be coded again."""
        self._undecodable: set[int] = set()
        self._next_sequences = {False: 0, True: FIRST_STORED}
        """Number of the next still: for the link, and for the backlog."""
        self._reported_ns = 0
        self._round_trip_ns = 0

    # Pending

    def __len__(self) -> int:
        return len(self._pending)

    def __contains__(self, track_id: int) -> bool:
        with self._lock:
            return any(track_id in pending.track_ids for pending in self._pending.values())

    @property
    def pending(self) -> tuple[OutboxStill, ...]:
        with self._lock:
            return tuple(self._pending.values())

    @property
    def on_demand(self) -> OutboxStill | None:
        """The first requested still; None where none is pending."""
        with self._lock:
            return self._on_demand[0] if self._on_demand else None

    @property
    def on_demand_pending(self) -> int:
        return len(self._on_demand)

    @property
    def any_pending(self) -> bool:
        """Whether a still waits for its allowance, requested ones included."""
        return bool(self._pending or self._on_demand)

    def admits(self, request: Request, *, now_ns: int) -> bool:
        """Whether a still of this request would stay in the outbox if it were offered now."""
        with self._lock:
            if len(self._pending) < self.settings.max_pending or request.candidate.track_id in self._pending:
                return True
            least = min(map(_order, self._pending.values()))
        return (request.score, -now_ns, -request.candidate.track_id) > least

    def offer(self, new: OutboxStill) -> list[tuple[OutboxStill, str]]:
        """Add a pending still; return the stills that had to leave for it, with the reason.

        An older still leaves where the new one shows its leading track; a track that is only an extra in an older
        still is removed from that one.
        """
        left: list[tuple[OutboxStill, str]] = []
        with self._lock:
            for older in self.pending:
                if older.track_id in new.track_ids:
                    left.append(self._expire(older, "replaced"))
                elif older.track_ids & new.track_ids:
                    _take_off(older, new.track_ids)
            self._pending[new.track_id] = new
            if len(self._pending) > self.settings.max_pending:
                left.append(self._expire(min(self._pending.values(), key=_order), "queue_full"))
        return left

    def offer_on_demand(self, new: OutboxStill) -> None:
        """Add a requested still; the caller bounds their number."""
        with self._lock:
            self._on_demand.append(new)

    def best(self) -> OutboxStill | None:
        with self._lock:
            return max(self._pending.values(), key=_order, default=None)

    def expire(self, now_ns: int) -> list[tuple[OutboxStill, str]]:
        with self._lock:
            old = [one for one in self.pending if now_ns - _since_ns(one) > self.settings.max_pending_ns]
            return [self._expire(one, "stale") for one in old]

    def expire_on_demand(self, now_ns: int) -> list[tuple[OutboxStill, str]]:
        with self._lock:
            for one in self._on_demand:
                one.since_ns = now_ns if one.since_ns is None else one.since_ns
            most_ns = self.settings.max_on_demand_ns
            old = [one for one in self._on_demand if now_ns - _since_ns(one) > most_ns]
            return [self._expire(one, "stale") for one in old]

    def give_up(self, pending: OutboxStill) -> None:
        with self._lock:
            self._expire(pending, "")

    def clear(self) -> list[tuple[OutboxStill, str]]:
        """The run ends: give up all pending stills."""
        with self._lock:
            return [self._expire(one, "ended") for one in (*self._on_demand, *self.pending)]

    # Coded

    def sequence(self, *, store: bool) -> int:
        """The number of the next still: for the link, or for the backlog; valid within one `turn`."""
        return self._next_sequences[store]

    def sent(self, pending: OutboxStill, still: Still, *, now_ns: int, resend: Still | None = None) -> None:
        """Note that it is sent. ``resend`` is its crop, for a ground that cannot decode the still."""
        settings = self.settings
        with self._lock:
            self._leave_pending(pending)
            self._next_sequences[False] += 1
            pending.state, pending.coded = StillState.SENT, still
            pending.sent_ns, pending.copies, pending.job = now_ns, 1, resend
            if self._reports or resend is not None:
                self._sent[still.header.sequence] = pending
            for one in tuple(self._sent.values()):
                if self.crop_bytes <= settings.max_crop_bytes:
                    break
                self._drop_crop(one)
            while len(self._sent) > settings.max_sent or self.sent_bytes > settings.max_sent_bytes:
                self._forget(next(iter(self._sent.values())))

    def stored(self, one: OutboxStill, still: Still) -> None:
        """It goes to the backlog: a pending still while the link is away, or a lost one."""
        with self._lock:
            if one.state is StillState.PENDING:
                self._leave_pending(one)
                self._next_sequences[True] += 1
            one.state, one.coded, one.job = StillState.STORED, still, None

    def sent_again(self, sent: OutboxStill) -> None:
        sent.copies += 1

    @property
    def unacknowledged(self) -> int:
        with self._lock:
            return len(self._unnamed())

    @property
    def sent_bytes(self) -> int:
        return sum(len(one.still.data) for one in self._unnamed())

    @property
    def crop_bytes(self) -> int:
        """The bytes of the pixels of sent stills."""
        return sum(one.job.size_bytes for one in self._sent.values() if one.job is not None)

    def on_report(
        self, still_sequence: int, missing: Sequence[int], *, now_ns: int, round_trip_ns: int = 0
    ) -> bool:
        """The primary receiver has all stills up to a sequence but those ``missing``; return whether any are new."""
        if not self._reports:
            return False
        with self._lock:
            self._reported_ns, self._round_trip_ns = now_ns, round_trip_ns
            named = [
                one
                for sequence, one in self._sent.items()
                if one.state is StillState.SENT and sequence <= still_sequence and sequence not in missing
            ]
            for one in named:
                one.state = StillState.ACKNOWLEDGED
                if one.job is None:
                    del self._sent[one.still.header.sequence]
        return bool(named)

    def on_undecodable(self, sequence: int) -> None:
        """A ground lacks the base frame of this still: code it again. Unknown numbers are ignored."""
        with self._lock:
            if sequence in self._sent and self._sent[sequence].job is not None:
                self._undecodable.add(sequence)

    def offer_undecodable(self, now_ns: int) -> list[tuple[OutboxStill, str]]:
        """Make the crops of undecodable stills pending again, each once, unless a newer still of the track is.

        Returns the stills that had to leave for them, as `offer` does.
        """
        left: list[tuple[OutboxStill, str]] = []
        with self._lock:
            for one in tuple(self._sent.values()):
                if now_ns - one.sent_ns > self.settings.max_sent_ns:
                    self._drop_crop(one)
            for sequence in sorted(self._undecodable):
                sent = self._sent[sequence]
                job, request = sent.crop, sent.request
                assert request is not None, "what a ground requests never builds on the base"
                self._drop_crop(sent)
                if job.header.track_id in self or not self.admits(request, now_ns=now_ns):
                    continue
                job = job.with_header(reason=AGAIN, parameters={**job.header.parameters, AGAIN: sequence})
                again = OutboxStill(job, request, sent.utility, now_ns, again=True)
                left += self.offer(again)
        return left

    def overdue(self, now_ns: int) -> list[OutboxStill]:
        """Stills to be sent again, most useful first: each once, while it is young.

        A still is overdue only if a report could have named it: without reports no arrival is known.
        """
        settings = self.settings
        wait_ns = max(settings.least_wait_ns, settings.wait_round_trips * self._round_trip_ns)
        with self._lock:
            overdue = [
                one
                for one in self._unnamed()
                if one.copies == 1
                and self._reported_ns - one.sent_ns >= wait_ns
                and now_ns - one.sent_ns <= settings.max_sent_ns
            ]
        return sorted(overdue, key=lambda one: -one.utility)

    def lose(self) -> list[OutboxStill]:
        """The link is down: declare stills that no report has named lost; most useful first."""
        with self._lock:
            lost = self._unnamed()
            for one in lost:
                one.state = StillState.LOST
                del self._sent[one.still.header.sequence]
                self._undecodable.discard(one.still.header.sequence)
        return sorted(lost, key=lambda one: -one.utility)

    def _unnamed(self) -> list[OutboxStill]:
        # Sent, and not acknowledged; none where reports do not count.
        return [one for one in self._sent.values() if one.state is StillState.SENT] if self._reports else []

    def _expire(self, pending: OutboxStill, reason: str) -> tuple[OutboxStill, str]:
        self._leave_pending(pending)
        pending.state = StillState.EXPIRED
        return pending, reason

    def _leave_pending(self, pending: OutboxStill) -> None:
        if pending in self._on_demand:
            self._on_demand.remove(pending)
        elif self._pending.get(pending.track_id) is pending:
            del self._pending[pending.track_id]

    def _drop_crop(self, sent: OutboxStill) -> None:
        sent.job = None
        self._undecodable.discard(sent.still.header.sequence)
        if sent.state is StillState.ACKNOWLEDGED or not self._reports:
            self._forget(sent)

    def _forget(self, sent: OutboxStill) -> None:
        sent.state, sent.job = StillState.EXPIRED, None
        del self._sent[sent.still.header.sequence]
        self._undecodable.discard(sent.still.header.sequence)


def _take_off(pending: OutboxStill, track_ids: set[int]) -> None:
    # The still no longer names these tracks; the crop stays as it is.
    job, request = pending.crop, pending.request
    assert request is not None, "only stills of the method show several tracks"
    named = tuple(one for one in job.header.also if one.track_id not in track_ids)
    pending.job = job.with_header(also=named)
    pending.request = replace(
        request, also=tuple(one for one in request.also if one.track_id not in track_ids)
    )


def _order(pending: OutboxStill) -> tuple[float, int, int]:
    # Ties go to the older still, then to the older track: the order is the same in every run.
    return pending.utility, -_since_ns(pending), -pending.track_id


def _since_ns(pending: OutboxStill) -> int:
    assert pending.since_ns is not None, "it has been met"
    return pending.since_ns
