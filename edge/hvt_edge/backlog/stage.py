"""Decides for frames and stills while the link may be down: send, or store.

The edge turns to storing at once and returns with a keyframe. Until that keyframe has gone out frames are still
stored, because the ground could not show them; so no frame is missing between the sent ones and the stored ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from enum import Enum

from hvt_common.protocol.messages import BacklogKind, BacklogStill, Feedback
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.entry import FIRST_STORED, SEGMENT_NS, Entry
from hvt_edge.backlog.worker import IntakeStill, StoreWorker
from hvt_edge.link.transmitter import LEAST_CHUNK_BYTES, Chunk, Transmitter
from hvt_edge.operating import Keyframes

SILENCE_NS = 3 * SECOND_NS // 2
"""Three reports in a row are missing."""
_NO_NEWS_NS = 5 * SECOND_NS
"""Reports come but name no newer frame: small messages pass, or only one direction works, and the video does not."""
_PAUSE_NS = 2 * SECOND_NS
"""After this time without a message sent, and 1.5 times the interval of the last two, a report that names no newer
frame says nothing of the link."""
_LEFT_NS = 15 * SECOND_NS
"""A ground that is silent for this long on a link that Zenoh still has, has left; the remaining subscribers may never
report. As in `hvt_edge.link.pacer`."""
_STEADY_NS = 2 * SECOND_NS
"""How long the link must be back before stored objects are sent: live video comes first."""
_PROBE_NS = SECOND_NS
_RESERVE = 1 / 3
"""Share of the stills' part of a window that stays free for a live one; all of it while one is pending."""
_TRICKLE_BYTES, _TRICKLE_SHARE = 1_400, 1 / 40
"""Size of a chunk that goes without room in the budget, one packet; and the share of the total that belongs to the
backlog, so that other traffic cannot keep it waiting for ever."""
_FINISH_NS, _STUCK_NS, _POLL_S = 60 * SECOND_NS, 6 * SECOND_NS, 0.05
"""How long sending goes on after the end of a clip: in all, and without progress."""


class Outage:
    """Tells whether the link is down. Time is an argument. ``live``: the source is a camera, which cannot wait.

    The link is down if nobody subscribes any more (Zenoh notices that some seconds after the link broke), if a ground
    that used to report is silent (it reports twice a second whatever it receives, so this is noticed much sooner), or
    if its reports have no news.
    """

    def __init__(self, *, live: bool) -> None:
        self._live = live
        self._subscribed = False
        self._linked = False
        self._reported_ns: int | None = None
        self._news_ns = self._grew_ns = self._each_ns = 0
        self._named = self._sent = -1
        self._named_ns = -SILENCE_NS
        """When a report last named a base message."""
        self.reports = False
        """Whether a ground has ever reported on this session: without reports no arrival is known."""

    def reported(self, now_ns: int, *, named: int = -1, sent: int = -1, misses_video: bool = False) -> None:
        """A ground has reported (any thread): ``named`` is the last base message that it received, of those ``sent``.

        A ground that takes no video names none (-1); that is no news while another ground reports video. One that
        ``misses_video`` misses the video: without another one that has it, that is an outage at once.
        """
        again = not self.reports_now(now_ns)
        if sent > self._sent:
            self._each_ns = now_ns - self._grew_ns if self._sent >= 0 else 0
            self._sent, self._grew_ns = sent, now_ns
        elif self._reported_ns is not None and now_ns - self._grew_ns > max(
            _PAUSE_NS, 3 * self._each_ns // 2
        ):
            self._news_ns += now_ns - self._reported_ns
        if named >= 0 or misses_video:
            self._named_ns = now_ns
        alone = now_ns - self._named_ns >= SILENCE_NS
        if (again and not misses_video) or alone or self._named < named <= sent or named == sent:
            self._news_ns = now_ns
        if named <= sent:
            self._named = max(self._named, named)
        self._reported_ns = now_ns
        self.reports = True

    def reports_now(self, now_ns: int) -> bool:
        reported_ns = self._reported_ns
        return reported_ns is not None and now_ns - reported_ns <= SILENCE_NS

    def offline(self, now_ns: int, *, linked: bool) -> bool:
        """Whether the link is away; called before each frame. ``linked``: Zenoh reports a subscriber.

        Before the first subscription only a live source is stored: a clip can be played again.
        """
        if not linked:
            self._linked = False
            return self._subscribed or self._live
        if not self._linked:  # a new path: earlier silence says nothing about it
            self._linked = self._subscribed = True
            self._reported_ns = None
        reported_ns = self._reported_ns
        if reported_ns is not None and now_ns - reported_ns > _LEFT_NS:
            self._reported_ns = reported_ns = None
        if reported_ns is None:
            return False
        return now_ns - reported_ns > SILENCE_NS or now_ns - self._news_ns > _NO_NEWS_NS


class State(Enum):
    """The destination of frames and stills."""

    LIVE = "to the link"
    OFFLINE = "into the store: the link is away"
    RETURNING = "stills to the link; frames into the store, until the keyframe to go on with is made"


class BacklogStage:
    """One for each run in real time.

    `store_still` is for the threads of stills, `on_feedback` for any, the rest for the frame loop.

    ``has_subscriber()``: a ground subscribes to ``backlog``. ``stills_pending()``: a live still waits for its
    allowance; ``stills_in_flight()``: how many were sent that no report has named. The outbox handles stills lost in
    an outage: it takes its own for lost whenever `breaks` has grown.
    """

    def __init__(
        self,
        store: Store,
        line: Transmitter,
        *,
        live: bool,
        has_subscriber: Callable[[], bool],
        stills_pending: Callable[[], bool],
        stills_in_flight: Callable[[], int],
        keyframes: Keyframes,
        clock: Callable[[], int],
        failures: Failures,
    ) -> None:
        self._outage = Outage(live=live)
        self._line = line
        self._has_subscriber = has_subscriber
        self._stills_pending, self._stills_in_flight = stills_pending, stills_in_flight
        self._keyframes = keyframes
        self._clock = clock
        self.state = State.LIVE
        self._linked = self._finishing = False
        self._back_ns = clock()
        self._segment_ns: int | None = None
        self._probed_ns = self._trickle_ns = 0
        self._unseen = False
        """Whether the newest report says that its ground has had no picture."""
        self.frames = 0
        """Frames stored to be sent later; they include those also sent as probes of whether the link is back."""
        self.max_bytes = store.max_bytes
        self.breaks = 0
        """How often the messages in flight have been declared lost."""
        self.worker = StoreWorker(
            store,
            session_id=line.session_id,
            clock=clock,
            allowance=self.chunk_allowance,
            send=self.send_chunk,
            round_trip_ns=lambda: line.round_trip_ns,
            failures=failures,
            on_sent=self._note_sent,
        )

    # The frame loop

    @property
    def offline(self) -> bool:
        return self.state is State.OFFLINE

    def before_frame(self, now_ns: int, *, linked: bool) -> bool:
        """Called before each frame: whether the link is down. Raises the error that has ended the store's thread."""
        self.worker.check()
        self._linked = linked
        offline = self._outage.offline(now_ns, linked=linked) and not self.worker.failed
        if offline and not self.offline:
            self._leave()
        elif self.offline and not offline:
            self.state = State.RETURNING
            self._back_ns = now_ns
            self._keyframes.require(now_ns)
        return offline

    def segment_due(self, now_ns: int) -> bool:
        """Whether the next stored frame should be a keyframe that begins a segment."""
        return self._segment_ns is None or now_ns - self._segment_ns >= SEGMENT_NS

    @property
    def segment_open(self) -> bool:
        """Whether the open segment continues from a keyframe without a gap."""
        return self._segment_ns is not None

    def base(self, unit: AccessUnit, *, now_ns: int, sent: bool = False) -> bool:
        """Store a frame; ``sent``: it is sent too. False where the store does not take it."""
        if sent:
            self._probed_ns = now_ns
        if unit.keyframe:
            self._segment_ns = now_ns
        taken = self.worker.offer(unit)
        self.frames += taken
        if not taken:
            self._segment_ns = None  # later frames can be shown only from the next keyframe on
        return taken

    def probe_due(self, now_ns: int, *, keyframe: bool) -> bool:
        """Whether the next frame should be sent too: without any, no ground can show that the link is back.

        A ground that has seen nothing can show it by a ``keyframe`` alone.
        """
        due = now_ns - self._probed_ns >= _PROBE_NS
        return self.offline and self._linked and (due or (keyframe and self._unseen))

    @property
    def awaits_keyframe(self) -> bool:
        """Whether a ground that has seen no picture needs one: in the store it would be none for it."""
        return self.offline and self._linked and self._unseen

    def resume(self) -> None:
        """Send the keyframe that was made for the restart, and all later frames."""
        self._lose_in_flight()  # stills that were sent while the link went down or came back
        self.worker.intake.end_segment()
        self.state = State.LIVE

    def _leave(self) -> None:
        # The link has gone: messages in flight are stored first.
        self.worker.intake.signal(interrupted=True)
        self._lose_in_flight()
        self._segment_ns = None
        self.state = State.OFFLINE

    def _lose_in_flight(self) -> None:
        units = self._line.in_flight.take()
        self.breaks += 1
        if self.state is State.LIVE:  # else these were probes of the link, and are stored already
            whole = True
            for unit in units:  # without one that the disk refuses, none up to a keyframe can be decoded
                whole = (whole or unit.keyframe) and self.worker.offer(unit)

    # The end of the run

    def finish(
        self, *, before_frame: Callable[[int], None], stop: threading.Event, note: Callable[[str], None]
    ) -> None:
        """After the last frame of a recorded source: send stored objects, for as long as there is progress.

        ``before_frame(now_ns)`` does all that comes before a frame: it calls `before_frame` here, and lets the outbox
        store lost stills. No still is made any more.
        """
        self._finishing = True
        began_ns = progress_ns = self._clock()
        before, noted = self.worker.numbers.acknowledged_bytes, False
        before_frame(began_ns)
        while not stop.is_set() and self._unfinished():
            now_ns = self._clock()
            before_frame(now_ns)
            if self.state is State.RETURNING:
                self.resume()
            if now_ns - began_ns > SILENCE_NS:
                self.end_in_flight()
            if not noted and not self.worker.numbers.empty:
                note("sending what was kept while the link was away; Ctrl-C leaves it for the next start")
                noted = True
            stop.wait(_POLL_S)
            acknowledged = self.worker.numbers.acknowledged_bytes
            progress_ns, before = (now_ns, acknowledged) if acknowledged > before else (progress_ns, before)
            if now_ns > min(began_ns + _FINISH_NS, progress_ns + _STUCK_NS):
                return

    def _unfinished(self) -> bool:
        stored = not (self.worker.intake.idle and self.worker.numbers.empty)
        return bool(stored or self.state is not State.LIVE or self._unnamed)

    @property
    def _unnamed(self) -> bool:
        # Whether a message is unacknowledged, by a ground that does acknowledge.
        return self._outage.reports and bool(len(self._line.in_flight) or self._stills_in_flight())

    def end_in_flight(self) -> None:
        """The run ends: messages that no report has named are stored, and sent from the store."""
        if self._unnamed:
            self._lose_in_flight()
            self.worker.intake.end_segment()

    # The threads of stills

    def store_still(self, still: BacklogStill, *, number: int, capture_ns: int, utility: float) -> None:
        self.worker.offer(IntakeStill(number, capture_ns, utility, still))

    # Reports

    def on_feedback(self, feedback: Feedback, *, now_ns: int) -> None:
        named = feedback.base_sequence
        # After the last frame no later one can show that an earlier one was lost.
        sent = named if self._finishing and not feedback.misses_video else self._line.base_sequence
        self._unseen = feedback.misses_video
        self._outage.reported(now_ns, named=named, sent=sent, misses_video=feedback.misses_video)
        if feedback.backlog:
            self.worker.intake.on_acknowledged(feedback.backlog, receiver_id=feedback.receiver_id)

    def send_video(self) -> bool:
        """A ground requested the video before the stills; returns False where nothing is stored."""
        self.worker.intake.signal(video_first=True)
        return not self.worker.numbers.empty

    def wait_for_end(self, *, timeout_s: float) -> bool:
        """After `StoreWorker.send_no_more`: wait until a ground has all sent bytes; False after the time-out."""
        until_ns = self._clock() + round(timeout_s * SECOND_NS)
        while self.worker.numbers.unacknowledged_bytes:
            if self._clock() >= until_ns:
                return False
            time.sleep(_POLL_S)
        return True

    def close(self) -> None:
        """Store unacknowledged messages and close the store; called after the last report."""
        try:
            self.end_in_flight()
        finally:
            self.worker.close()

    def _note_sent(self, entry: Entry) -> None:
        # A lower number was lost in an outage and counted when it was sent; another run has its own ledger.
        own = entry.session_id == self._line.session_id and entry.number >= FIRST_STORED
        if own and entry.kind is BacklogKind.STILL:
            self._line.outcome("sent", "stored")

    # How chunks leave

    def chunk_allowance(self, now_ns: int) -> int:
        """Limit of a chunk now. 0: the link is full or not steady, no ground reports, or a keyframe is due."""
        if self.state is not State.LIVE or not self._linked or now_ns - self._back_ns < _STEADY_NS:
            return 0
        if not self._outage.reports_now(now_ns):
            return 0  # a ground that only listens acknowledges nothing
        # While a keyframe is due nothing else takes its room; after the last frame none is due.
        if not self._has_subscriber() or not (self._finishing or not self._keyframes.due(now_ns)):
            return 0
        reserve = 0.0 if self._finishing else 1.0 if self._stills_pending() else _RESERVE
        limit_bytes = self._line.backlog_allowance_bytes(now_ns, reserve=reserve)
        if self._finishing or limit_bytes >= LEAST_CHUNK_BYTES:
            return limit_bytes  # after the last frame no still is sent any more
        if now_ns < self._trickle_ns:
            return 0
        return min(_TRICKLE_BYTES, self._line.backlog_allowance_bytes(now_ns, reserve=None))

    def send_chunk(self, chunk: Chunk) -> int:
        """Send it; its line bytes, 0 where its room is gone. Without room in the budget the next one has to wait."""
        now_ns = self._clock()
        line_bytes = self._line.backlog(chunk, now_ns=now_ns)
        if line_bytes:
            pause_s = 8 * line_bytes / (_TRICKLE_SHARE * self._line.budget.total_bps)
            self._trickle_ns = now_ns + round(pause_s * SECOND_NS)
        return line_bytes
