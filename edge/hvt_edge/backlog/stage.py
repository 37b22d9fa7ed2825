"""What the frame loop and the stills ask while the link may be away: send this, or keep it.

The edge goes over to keeping at once and comes back with a keyframe: until that has gone out frames are still kept,
because the ground could not show them. So between what was sent and what was kept no frame is missing.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from enum import Enum
from types import TracebackType
from typing import Protocol, Self

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BacklogKind, BacklogStill, Feedback
from hvt_common.values import AccessUnit, Still
from hvt_edge.backlog.backfill import Chunk
from hvt_edge.backlog.disk import SEGMENT_NS, Folder
from hvt_edge.backlog.entry import FIRST_STORED, Entry
from hvt_edge.backlog.outage import SILENCE_NS, Outage
from hvt_edge.backlog.worker import IntakeStill, IntakeUnit, StoreNumbers, StoreWorker
from hvt_edge.operating.keyframes import KeyframePlan

__all__ = ["BacklogLink", "BacklogStage", "Link", "State", "Stills", "Unsent"]

_SECOND_NS = 1_000_000_000
_STEADY_NS = 2 * _SECOND_NS
"""So long the link is back before anything kept is sent: the picture comes first."""
_PROBE_NS = _SECOND_NS
_RESERVE = 1 / 3
"""Of the stills' share of a window, left for a live one that may come."""
_TRICKLE_BYTES = 1_400
"""Of a piece that goes while live stills wait: one packet."""
_MOST_UTILITIES = 256
_FINISH_NS, _STUCK_NS, _LOOK_S = 60 * _SECOND_NS, 6 * _SECOND_NS, 0.05
"""How long sending goes on after the end of a clip: in all, and without getting on."""


class State(Enum):
    """Where frames and stills go."""

    LIVE = "to the link"
    OFFLINE = "into the store: the link is away"
    RETURNING = "stills to the link; frames into the store, until the keyframe to go on with is made"


class Link(Protocol):
    """The link, as far as it matters here."""

    def listens(self, row: Channel) -> bool:
        """Whether somebody subscribes to this row."""
        ...


class Unsent(Protocol):
    """What was sent and is not acknowledged (`hvt_edge.link.unacknowledged`)."""

    def __len__(self) -> int:
        """How many access units and stills."""
        ...

    def drain(self) -> tuple[list[AccessUnit], list[Still]]:
        """Return and forget it."""
        ...


class Stills(Protocol):
    """Who makes stills (`hvt_edge.stills.stage.StillStage`)."""

    @property
    def live_waits(self) -> bool:
        """Whether a live still waits for room."""
        ...

    def without_base(self, still: Still, *, now_ns: int) -> Still:
        """A still that was sent, as it is without the base stream."""
        ...


class BacklogLink(Protocol):
    """How things leave (`hvt_edge.link.transmitter.Transmitter`)."""

    @property
    def total_bps(self) -> int:
        """The budget as it is now."""
        ...

    @property
    def round_trip_ns(self) -> int:
        """Of the link."""
        ...

    @property
    def unacked(self) -> Unsent | None:
        """What was sent and is not acknowledged."""
        ...

    def backlog_allowance_bytes(self, now_ns: int, *, reserve: float) -> int:
        """Payload that a piece may have now."""
        ...

    def backlog(self, chunk: Chunk, *, now_ns: int) -> int:
        """Send it; return its line bytes, 0 where its room is gone."""
        ...

    def store_base(self, unit: AccessUnit, *, now_ns: int) -> None:
        """A frame is kept and not sent."""
        ...

    def store_still(self, still: Still, *, now_ns: int, counted: bool = True) -> BacklogStill:
        """The still as it is kept."""
        ...


class BacklogStage:
    """One for each run in real time. `follow`, `base` and `sent` in the frame loop, `still` in the stills' thread.

    ``on_outcome`` is told of each kept still that arrived. `attend` before the first frame.
    """

    def __init__(
        self,
        open_folder: Callable[[], Folder],
        *,
        session_id: int,
        live: bool,
        link: Link,
        sender: BacklogLink,
        keyframes: KeyframePlan,
        clock: Callable[[], int],
        on_outcome: Callable[[str, str], None],
    ) -> None:
        self._outage = Outage(live=live)
        self._link = link
        self._sender = sender
        self._keyframes = keyframes
        self._clock = clock
        self._on_outcome = on_outcome
        self._session_id = session_id
        self._stills: Stills | None = None
        self.state = State.LIVE
        self._linked = self._finishing = False
        self._back_ns = clock()
        self._segment_ns: int | None = None
        self._keyframe = b""
        self._probed_ns = 0
        self._lost: deque[Still] = deque()
        self._utilities: OrderedDict[int, float] = OrderedDict()
        self.frames = 0
        """Kept and not sent."""
        self.outages = 0
        self._worker = StoreWorker(
            open_folder, self, session_id=session_id, clock=clock, on_sent=self._note_sent
        )

    def attend(self, stills: Stills) -> None:
        """Who makes the stills."""
        self._stills = stills

    # The frame loop

    @property
    def offline(self) -> bool:
        """Whether the link is away."""
        return self.state is State.OFFLINE

    def follow(self, now_ns: int, *, linked: bool) -> bool:
        """Before each frame: notice that the link went or came; return whether it is away.

        Raises what has ended the store's thread.
        """
        self._worker.check()
        self._linked = linked
        offline = self._outage.offline(now_ns, linked=linked) and not self._worker.failed
        if offline and not self.offline:
            self._leave()
        elif self.offline and not offline:
            self.state = State.RETURNING
            self._back_ns = now_ns
            self._keyframes.renew(now_ns)
        return offline

    def keeps(self, *, keyframe: bool) -> bool:
        """Whether the next frame is kept; ``keyframe``: it could be the one to go on with on the link."""
        return self.offline or (self.state is State.RETURNING and not keyframe)

    def wants_keyframe(self, now_ns: int, *, due: bool = False) -> bool:
        """Whether the next frame that is kept should begin a segment; ``due``: the plan has one for now.

        The one to go on with on the link stays due until it can be sent.
        """
        long = self._segment_ns is None or now_ns - self._segment_ns >= SEGMENT_NS
        return long or (due and self.offline)

    def base(self, unit: AccessUnit, *, now_ns: int, sent: bool = False) -> None:
        """Keep a frame; ``sent``: it goes out too."""
        if not sent:
            self.frames += 1
            self._sender.store_base(unit, now_ns=now_ns)
        if unit.keyframe:
            self._keyframe = unit.data
            self._segment_ns = now_ns
        if not self._worker.offer(IntakeUnit(unit, self._keyframe)):
            self._segment_ns = None  # what follows can be shown from a keyframe on only

    def probes(self, now_ns: int) -> bool:
        """Whether this frame is sent too, to show whether the link is back; without the others none can show it."""
        if not (self.offline and self._linked) or now_ns - self._probed_ns < _PROBE_NS:
            return False
        self._probed_ns = now_ns
        return True

    def resume(self) -> None:
        """The keyframe to go on with has been made: it and what follows is sent."""
        self._swallow()  # stills that went out while the link was going, or coming
        self._worker.end_segment()
        self.state = State.LIVE

    def sent(self, unit: AccessUnit) -> None:
        """A frame is sent."""
        if unit.keyframe:
            self._keyframe = unit.data

    def _leave(self) -> None:
        """The link has gone: what it has swallowed is kept first."""
        self.outages += 1
        self._worker.interrupt()
        self._swallow()
        self._segment_ns = None
        self.state = State.OFFLINE

    def _swallow(self) -> None:
        """What no report has named is taken for lost, and is to be kept."""
        if self._sender.unacked is None:
            return
        units, stills = self._sender.unacked.drain()
        self._lost.extend(stills)
        if self.state is State.LIVE:  # else these were to show whether the link is back, and are kept already
            for unit in units:
                self._worker.offer(IntakeUnit(unit, self._keyframe))

    # The end of the run

    def finish(
        self, *, follow: Callable[[int], object], stop: threading.Event, note: Callable[[str], None]
    ) -> None:
        """After the last frame of a recorded source: send what is kept, for as long as that gets on.

        ``follow(now_ns)`` is what else goes before each frame, `follow` included. No still is made any more.
        """
        self._finishing = True
        began_ns = progress_ns = self._clock()
        before, said = self.numbers.acknowledged_bytes, False
        while not stop.is_set() and self._unfinished():
            now_ns = self._clock()
            follow(now_ns)
            if self.state is State.RETURNING:
                self.resume()
            if now_ns - began_ns > SILENCE_NS:
                self._end_unacked()
            self.store_lost(now_ns)
            if not said and not self.numbers.empty:
                note("sending what was kept while the link was away; Ctrl-C leaves it for the next start")
                said = True
            stop.wait(_LOOK_S)
            acknowledged = self.numbers.acknowledged_bytes
            progress_ns, before = (now_ns, acknowledged) if acknowledged > before else (progress_ns, before)
            if now_ns > min(began_ns + _FINISH_NS, progress_ns + _STUCK_NS):
                return

    def _unfinished(self) -> bool:
        """Whether anything was admitted that may not have arrived."""
        kept = self._worker.waiting or not self.numbers.empty
        return bool(kept or self._lost or self.state is not State.LIVE or self._unnamed)

    @property
    def _unnamed(self) -> bool:
        """Whether something is not acknowledged, by a ground that does acknowledge."""
        unacked = self._sender.unacked
        return unacked is not None and self._outage.heard and len(unacked) > 0

    def _end_unacked(self) -> None:
        """The run ends: what no report has named by now is kept, and comes as what was kept."""
        if self._unnamed:
            self._swallow()
            self._worker.end_segment()

    # The stills' thread

    def note_utility(self, still: Still, utility: float) -> None:
        """A still goes out: should it be lost, this is what it is worth."""
        self._utilities[still.sequence] = utility
        while len(self._utilities) > _MOST_UTILITIES:
            self._utilities.popitem(last=False)

    def store_lost(self, now_ns: int) -> None:
        """Keep the stills that an outage has swallowed; after that thread's end, in whichever ends the run."""
        while self._lost:
            still = self._lost.popleft()
            utility = self._utilities.get(still.sequence, 0.0)
            if self._stills is not None:
                still = self._stills.without_base(still, now_ns=now_ns)
            self.still(still, utility=utility, now_ns=now_ns, counted=False)

    def still(self, still: Still, *, utility: float, now_ns: int, counted: bool = True) -> None:
        """Keep a still; ``counted``: it takes from the budget what sending it would have taken."""
        kept = self._sender.store_still(still, now_ns=now_ns, counted=counted)
        self._worker.offer(IntakeStill(still.sequence, still.capture_ns, utility, kept))

    # What comes back

    def hear(self, feedback: Feedback, *, now_ns: int) -> None:
        """A ground has reported on this session (any thread)."""
        self._outage.reported(now_ns)
        if feedback.backlog:
            self._worker.hear(feedback.backlog, receiver_id=feedback.receiver_id)

    def send_video(self) -> bool:
        """Somebody wants the video before the stills; False where nothing is kept."""
        self._worker.video_first()
        return not self.numbers.empty

    @property
    def numbers(self) -> StoreNumbers:
        """What is kept and what was done."""
        return self._worker.numbers

    def text(self) -> str:
        """For the status line; empty where nothing is kept."""
        numbers = self.numbers
        return "" if numbers.empty else f"kept {numbers.stills} stills, {numbers.video_s:.0f} s"

    def send_no_more(self) -> None:
        """Before the last word to the ground, which says how much there was."""
        self._worker.send_no_more()

    def close(self) -> None:
        """Keep what no ground has acknowledged, and leave the store in order; after the last word to the ground."""
        try:
            self._end_unacked()
            self.store_lost(self._clock())
        finally:
            self._worker.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _note_sent(self, entry: Entry) -> None:
        # One of a lower number was swallowed by an outage and counted when it was sent; a former run has its own
        # account.
        own = entry.session_id == self._session_id and entry.number >= FIRST_STORED
        if own and entry.kind is BacklogKind.STILL:
            self._on_outcome("sent", "stored")

    # How pieces leave (`hvt_edge.backlog.worker.ChunkSender`)

    def may_send(self, now_ns: int) -> bool:
        """Whether the link is there and steady, a ground reports, and no keyframe is to come."""
        if self.state is not State.LIVE or not self._linked or now_ns - self._back_ns < _STEADY_NS:
            return False
        if not self._outage.hears(now_ns):
            return False  # of who only listens nobody would know what has arrived
        # While a keyframe is to come nothing else takes its room; after the last frame none comes.
        return self._link.listens(Channel.BACKLOG) and (self._finishing or not self._keyframes.due(now_ns))

    def room_bytes(self, now_ns: int, *, live_waits: bool) -> int:
        """Payload that a piece may have now."""
        if live_waits:
            return min(_TRICKLE_BYTES, self._sender.backlog_allowance_bytes(now_ns, reserve=0.0))
        return self._sender.backlog_allowance_bytes(now_ns, reserve=0.0 if self._finishing else _RESERVE)

    def live_waits(self) -> bool:
        """Whether a live still waits for room; after the last frame none goes any more."""
        return not self._finishing and self._stills is not None and self._stills.live_waits

    def send(self, chunk: Chunk, *, now_ns: int) -> int:
        """Send it."""
        return self._sender.backlog(chunk, now_ns=now_ns)

    @property
    def round_trip_ns(self) -> int:
        """Of the link."""
        return self._sender.round_trip_ns

    @property
    def total_bps(self) -> int:
        """What may be sent in all."""
        return self._sender.total_bps
