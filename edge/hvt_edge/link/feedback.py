"""Reports of grounds: which of them steers, and in which order and at which pace the edge processes them."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, replace

from hvt_common.protocol.messages import Feedback, StillResult
from hvt_common.runtime.statistics import Newest
from hvt_edge.perception.shadow import Detected

_OTHER_RECEIVER_NS = 1_000_000_000
_MISSED = 3
"""Base messages: one or two may be lost, or reported a moment later than by another ground."""


@dataclass(frozen=True, slots=True)
class Report:
    """A ground's report with the edge's decisions on it. Pacer, outbox, store and inbox all get the same one."""

    feedback: Feedback
    now_ns: int
    primary: bool
    """It is new and comes from the ground that steers."""
    first: bool = False
    """Another ground steers from now on, or this one began anew: measurements of the old path no longer hold."""


class PrimaryReceiver:
    """Chooses the ground that steers: its reports count where several may report. Thread-safe; time is an argument.

    Several grounds see the same thin link, and the reports of one say nothing of the others. So one is the primary
    receiver: the first that reports, until it is silent for a second, or names nothing new for a second although
    another has had several messages since. At one frame a second there is nothing new for a second, and whichever of
    two healthy grounds reports first would be the only one that has the newest. Report numbers cost a forger
    nothing, so one that is too high silences a receiver for that second and no longer.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._receiver_id: int | None = None
        self._sequence = -1
        self._named = (-1, -1)
        """The highest base and still sequences that it has named."""
        self._reported_ns = 0
        self._progress_ns = 0

    def judge(self, feedback: Feedback, *, sent: tuple[int, int], now_ns: int) -> Report:
        """Decide on a report; ``sent`` are the last sequences of base and stills that went out.

        A report that names a base message never sent does not count. A still never sent comes from a forger that
        sends to the ground: the report counts, without its stills.
        """
        with self._lock:
            if feedback.base_sequence > sent[0]:
                return Report(feedback, now_ns, primary=False)
            if feedback.still_sequence > sent[1]:
                feedback = replace(feedback, still_sequence=-1, missing_stills=())
            first = self._begins(feedback, sent, now_ns)
            if first is None:
                return Report(feedback, now_ns, primary=False)
            if first:
                self._named, self._progress_ns = (-1, -1), now_ns
            named = (
                max(self._named[0], feedback.base_sequence),
                max(self._named[1], feedback.still_sequence),
            )
            if named != self._named:
                self._named, self._progress_ns = named, now_ns
            self._receiver_id, self._sequence, self._reported_ns = (
                feedback.receiver_id,
                feedback.sequence,
                now_ns,
            )
            return Report(feedback, now_ns, primary=True, first=first)

    def forget(self) -> None:
        """No ground can be reached: the next report counts, whichever ground sends it."""
        with self._lock:
            self._receiver_id, self._sequence = None, -1

    def _begins(self, feedback: Feedback, sent: tuple[int, int], now_ns: int) -> bool | None:
        # Whether the receiver begins (anew) with this report; None where the report does not count.
        if self._receiver_id is None:
            return True
        quiet_ns = now_ns - self._reported_ns
        if feedback.receiver_id != self._receiver_id:
            # A ground that reports but never names anything new must not keep the edge from all the others; as long
            # as it has named nothing at all, everything that was sent counts as new.
            there = feedback.base_sequence
            if self._named == (-1, -1) and not feedback.misses_video:
                there = sent[0]
            if there - self._named[0] >= _MISSED:
                quiet_ns = max(quiet_ns, now_ns - self._progress_ns)
            return True if quiet_ns >= _OTHER_RECEIVER_NS else None
        if feedback.sequence > self._sequence:
            return False
        # The report is old, or one was forged with a number that the receiver itself will not reach for years.
        return True if quiet_ns >= _OTHER_RECEIVER_NS else None


_MAX_RESULTS = 1024


class FeedbackInbox:
    """Filled from Zenoh's callback, emptied by the frame loop.

    In real time results are taken as they come. In lockstep the loop waits until the ground is done with frame
    ``n - k`` and all its stills, and takes exactly those: the moment at which a result counts follows from the input
    alone, and the same input gives the same stills.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._results: deque[StillResult] = deque(maxlen=_MAX_RESULTS)
        self._last_frame_index = -1
        # In order of arrival; a ground may answer for a still that was never sent.
        self._answered: Newest[int, None] = Newest(2 * _MAX_RESULTS)
        self._known: Newest[tuple[int, int, bool], None] = Newest(2 * _MAX_RESULTS)
        self._done_sequence = -1
        self._detected: Newest[int, Detected] = Newest(_MAX_RESULTS)
        """Reports by frame, in order of arrival."""
        self._base_messages = 0
        self._roi_messages = 0
        self.received_ns: int | None = None

    def on_report(self, report: Report) -> None:
        """Process one report of any ground (any thread)."""
        feedback = report.feedback
        with self._changed:
            self.received_ns = report.now_ns
            self._last_frame_index = max(self._last_frame_index, feedback.last_frame_index)
            self._base_messages = max(self._base_messages, feedback.base_messages)
            self._roi_messages = max(self._roi_messages, feedback.roi_messages)
            for result in feedback.stills:
                self._note(result)
            if report.primary and feedback.objects_detected >= 0:
                index = feedback.last_frame_index
                self._detected[index] = Detected(feedback.receiver_id, index, feedback.objects_detected)
            self._changed.notify_all()

    def _note(self, result: StillResult) -> None:
        # One ground may be unable to show a still that another has classified: a result does not silence a request.
        sequence = result.still_sequence
        key = (sequence, -1 if result.again else result.track_id, result.again)
        if sequence > self._done_sequence and key not in self._known:
            self._known[key] = self._answered[sequence] = None
            self._results.append(result)

    def take(self) -> list[StillResult]:
        with self._changed:
            results = list(self._results)
            self._results.clear()
            return results

    def take_up_to(self, sequence: int) -> list[StillResult]:
        """Return and forget the results of stills up to this one, in their order; later ones for them are ignored."""
        with self._changed:
            self._done_sequence = max(self._done_sequence, sequence)
            for answered in [one for one in self._answered if one <= self._done_sequence]:
                del self._answered[answered]
            for known in [one for one in self._known if one[0] <= self._done_sequence]:
                del self._known[known]
            ready = sorted(
                (one for one in self._results if one.still_sequence <= sequence),
                key=lambda one: (one.still_sequence, one.again, one.track_id),
            )
            self._results = deque(
                (one for one in self._results if one.still_sequence > sequence), maxlen=_MAX_RESULTS
            )
            return ready

    def take_detected(self, *, up_to: int | None = None) -> Detected | None:
        """Return the newest report of the ground's own detector, and forget it; None where there is none.

        ``up_to``: reports of later frames than this stay for a later call.
        """
        with self._changed:
            due = [one for one in self._detected if up_to is None or one <= up_to]
            newest = self._detected[max(due)] if due else None
            for one in due:
                del self._detected[one]
            return newest

    def wait_for(self, *, frame_index: int, stills: set[int], timeout_s: float) -> bool:
        """Wait until a ground is done with this frame and has answered these stills; False after the time-out."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._last_frame_index >= frame_index and stills <= self._answered.keys(), timeout_s
            )

    def wait_for_end(
        self, *, base: int, roi: int, frame_index: int, still_sequence: int, timeout_s: float
    ) -> bool:
        """Wait until a ground has everything; False after the time-out.

        Either it has received ``base`` and ``roi`` messages, or, where it joined late, it is done with this frame and
        has answered this still (-1 for none).
        """

        def complete() -> bool:
            counted = self._base_messages >= base and self._roi_messages >= roi
            answered = still_sequence < 0 or still_sequence in self._answered
            return counted or (self._last_frame_index >= frame_index >= 0 and answered)

        with self._changed:
            return self._changed.wait_for(complete, timeout_s)
