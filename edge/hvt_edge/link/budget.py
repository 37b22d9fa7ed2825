"""The hard bit budget: how many bytes a still may take now, and when a base frame may go.

No rolling window ever exceeds the total.

Two limits hold for stills at once, both in line bytes (payload, attachment and transport overhead):

* **the share**: stills continuously earn the rate ``B_tot - B_v - metadata``, all that belongs neither to the base
  nor to metadata, and may save up unspent bits, but no more than ``carry_s`` seconds of them (a token bucket). With
  ``borrow_unused`` they may also take the part of ``B_v`` that the base left unused in the last window: base and
  borrowed bits stay within ``B_v`` there;
* **the window**: in every rolling window of ``window_ns``, past or still to come, base and stills together stay
  within ``B_tot``. A still sent now sits in every window that ends up to one window from now, so the
  base frames that will share those windows are counted in advance, each at the time it is due: at the mean rate of
  ``B_v``, or at the most bytes that the base took lately in a stretch of the same length, whichever is more. This
  memory leaves out keyframes, because they come only when the edge decides: before one, stills are held until it
  fits (`keyframe_fits`).

So stills yield where the base overshoots. A base frame that no forecast expects, suddenly large after stills have
taken their share, waits the few milliseconds until the window has room (`earliest_ns`): nothing is dropped, and
the total holds all the same. Only a still that a ground requested borrows from the base itself
(`VideoLoan`): frames are left out for it before they are coded.

All other messages are sent only where the coming frames keep their room: chunks of the backlog by the same forecast
as stills, also while the camera gives no frame, since the next may come at any moment (`backlog_allowance`); tracks,
pose and status by a forecast of their own (`metadata_fits`).
"""

from __future__ import annotations

import math
import threading
from bisect import bisect
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hvt_common.units import SECOND_NS

BASE_ATTACHMENT_BYTES = 44
_MEMORY_WINDOWS = 5
"""Windows of the base's recent behaviour that the forecast looks back on."""
_LEFT_WINDOWS = 3
"""Windows within which a passed-through camera leaves a requested still its room, if it ever does."""
_FORECASTS = 30
"""Most moments of the coming window for which the forecast is made; they bound its cost."""
_ROUNDING = 0.01
"""Rounding error of a frame: rates and times are whole nanoseconds."""

_MOST_SHARE = 0.8
"""Share of a window for requested stills; the rest is for status, tracks, pose and the remaining video."""
_LOAN_PATIENCE = 2
"""Windows for which frames are left out for a still that waits."""
_SPARE_SHARE = 0.05
"""Share of a window that a requested still leaves free for ``status``."""
BASE_PEAK = 1.15
"""Bytes of the fullest window of the base stream over B_v: the VBV's limit, kept also where frames bunch up."""

_MOST_RESENT = 0.25
"""Share of a window for base messages that are sent again: a keyframe at most, or some frames."""

_WHOLE_NS = 2 * SECOND_NS
"""A window of at most this length empties within the three seconds after which live video must be back."""

_PART_MARGIN = 1.03
"""Frames are smaller by this factor where a window can hold one more than its share, as room for ``status``."""

_Floats = npt.NDArray[np.float64]
_Events = Sequence[tuple[int, int]]
"""(time, line bytes), in order of time."""


def frames_bps(base_bps: float, total_bps: float, *, fps: float, window_s: float) -> float:
    """B_v, or the lower rate at which a window holds all frames that fall into it: 3 at 2.5 a second, not 2.5."""
    frames = window_s * fps
    most_bps = total_bps * frames / max(1, math.ceil(frames - _ROUNDING))
    return base_bps if base_bps <= most_bps else most_bps / _PART_MARGIN


@dataclass(frozen=True, slots=True)
class BudgetSettings:
    """Rates in line bits a second; times in nanoseconds."""

    total_bps: int
    base_bps: int
    """B_v, the share of the base stream with its headers, overhead and ``status``."""
    fps: float
    window_ns: int = SECOND_NS
    carry_s: float = 2.0
    metadata_bps: int = 0
    """Rate reserved for messages beside base and stills, such as ``tracks``."""
    borrow_unused: bool = False
    """Whether stills may also take the part of B_v that the base leaves unused."""
    yields: bool = True
    """Whether base frames are left out for a still that a ground requested. A camera's own stream cannot leave any
    out: all frames up to its next keyframe would be lost."""

    @property
    def still_bps(self) -> int:
        return max(0, self.total_bps - self.base_bps - self.metadata_bps)


class VideoLoan:
    """A requested still borrows from the video for a second or two: frames are left out before they are coded.

    In a window of the budget's bytes a still of N bytes has room once N bytes of video have left it, so no frame is
    coded while one waits. After it, for as long as it is in the window, the video has N bytes less: frames are left
    out evenly at that share, in place of a second hole where the window is full. Requested stills never take more
    than `_MOST_SHARE` of a window in all. A still that does not go within `_LOAN_PATIENCE` windows gives way to the
    video for as long before it is tried again: a ground with the right to command cannot stop the video.

    Pure: time is an argument. One still waits at a time.
    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._wanted: tuple[int, int] | None = None
        self._taken: deque[tuple[int, int]] = deque()
        """(time, line bytes) of the requested stills of the last window."""
        self._due = 0.0
        """Fraction of a frame that is due to be left out since the last one was."""

    def want(self, line_bytes: int | None, *, now_ns: int) -> None:
        """A requested still of about ``line_bytes`` waits; a repeated call updates the size. None: none waits."""
        since_ns = now_ns if self._wanted is None else self._wanted[1]
        self._wanted = None if line_bytes is None else (line_bytes, since_ns)

    def take(self, line_bytes: int, *, now_ns: int) -> None:
        self._wanted = None
        self._taken.append((now_ns, line_bytes))

    def left_bytes(self, window_bytes: float, *, now_ns: int) -> float:
        return _MOST_SHARE * window_bytes - self._taken_bytes(now_ns)

    def waits(self, window_bytes: float, *, now_ns: int) -> bool:
        """Whether a requested still waits for which frames are to be left out."""
        if self._wanted is None:
            return False
        line_bytes, since_ns = self._wanted
        patience_ns = _LOAN_PATIENCE * self._window_ns
        in_time = (now_ns - since_ns) % (2 * patience_ns) <= patience_ns
        return in_time and line_bytes <= self.left_bytes(window_bytes, now_ns=now_ns)

    def leaves_out(self, window_bytes: float, *, now_ns: int) -> bool:
        """Whether the frame that is due now is left out; call once for each frame that would otherwise be coded."""
        if self.waits(window_bytes, now_ns=now_ns):
            return True
        share = self._taken_bytes(now_ns) / window_bytes
        self._due = self._due + share if share else 0.0
        if self._due < 1:
            return False
        self._due -= 1
        return True

    def _taken_bytes(self, now_ns: int) -> int:
        while self._taken and self._taken[0][0] <= now_ns - self._window_ns:
            self._taken.popleft()
        return sum(size for _, size in self._taken)


class RollingBudget:
    """Admits stills. Time is an argument.

    Callers that query or record hold `lock`; the methods that the frame loop calls besides take it themselves. The
    clocks of two threads may differ a little, and a base message may be recorded for a later time: the order of the
    calls does not matter as long as no time is more than a window behind another.
    """

    def __init__(self, settings: BudgetSettings) -> None:
        self.lock = threading.RLock()
        self._total = settings.total_bps * settings.window_ns / 8 / SECOND_NS
        self._sent: list[tuple[int, int, int]] = []
        """(time, line bytes, total then), in order of time."""
        self._events: list[tuple[int, int]] = []
        """(time, line bytes as they count under the present total), in the same order."""
        self._base_events: deque[tuple[int, int]] = deque()
        self._lent: deque[tuple[int, float]] = deque()
        """(time, bytes that a still borrowed from the base's unused share)."""
        self._used: deque[tuple[int, float]] = deque()
        """(time, bytes not open to a requested still) after each recent base frame, where the base does not yield."""
        self._resent: deque[tuple[int, int]] = deque()
        """(time, line bytes) of the base messages that were sent again in the last window."""
        self._query_ns: int | None = None
        self._last_ns = 0
        self._last_base_ns: int | None = None
        self._base_ended = False
        self._old_peak = (0, 0.0)
        """(end time, bytes in a window): after a change, frames of the former rate are still in the window."""
        self._adopt(settings)
        self._tokens = self._cap
        self._tokens_ns: int | None = None
        self._loan_ns = min(settings.window_ns, SECOND_NS)
        """The stretch of time over which the base yields."""
        self._loan = VideoLoan(self._loan_ns)

    def _adopt(self, settings: BudgetSettings) -> None:
        # Take over settings with the same total and window; behaviour of the base at another rate is forgotten.
        self._settings = settings
        self._step_ns = round(SECOND_NS / settings.fps)
        steps = max(1, math.ceil(float(settings.window_ns) / self._step_ns - _ROUNDING))
        self._forecasts = np.unique(
            np.linspace(0, steps, min(steps, _FORECASTS) + 1).round().astype(np.int64)
        )
        window_s, fps = settings.window_ns / SECOND_NS, settings.fps
        self.base_step_bytes = (
            frames_bps(settings.base_bps, settings.total_bps, fps=fps, window_s=window_s) / 8 / fps
        )
        """The mean of one base frame at the rate that x265 was opened for, in line bytes."""
        self._base_peak = BASE_PEAK * max(steps, window_s * fps) * self.base_step_bytes
        self._base_steps: deque[int] = deque(maxlen=steps * _MEMORY_WINDOWS)
        self._note_bursts()
        self._cap = settings.still_bps * settings.carry_s / 8

    def set_total(self, total_bps: int, base_bps: int, fps: float, *, now_ns: int) -> None:
        """Another total from now on. The base stream's rate may stay above it until x265 is opened anew.

        Bytes sent under a higher total still count: messages wait until the window has room. In a window of more than
        `_WHOLE_NS` they count in proportion to the new total; otherwise it would be full for all its seconds.
        """
        with self.lock:
            settings = self._settings
            self._refill(now_ns)
            self._settings = replace(settings, total_bps=total_bps)
            self._total = total_bps * settings.window_ns / 8 / SECOND_NS
            self._events = [(at_ns, self._counted(size, then_bps)) for at_ns, size, then_bps in self._sent]
            # From the next coded frame, a keyframe, on.
            if (base_bps, fps) != (settings.base_bps, settings.fps):
                until_ns = max(now_ns, self._last_ns) + settings.window_ns
                self._old_peak = (until_ns, max(self._base_peak, self._peak_at(now_ns)))
                self._used.clear()
                self._adopt(replace(self._settings, base_bps=base_bps, fps=fps))
            self._cap = self._settings.still_bps * settings.carry_s / 8
            self._tokens = min(self._cap, self._tokens)

    @property
    def total_bps(self) -> int:
        return self._settings.total_bps

    @property
    def most_still_bytes(self) -> int:
        """The most line bytes that `still_allowance` ever gives, while the base keeps to its share."""
        window_s = self._settings.window_ns / SECOND_NS
        borrowed = self._settings.base_bps * window_s / 8 if self._settings.borrow_unused else 0.0
        return int(min(self._cap + borrowed, self._settings.still_bps * window_s / 8))

    def record_base(
        self, line_bytes: int, *, now_ns: int, keyframe: bool = False, stored: bool = False
    ) -> None:
        """Count one base message; ``now_ns`` is the time for which `earliest_ns` lets it go.

        A ``stored`` message uses up the base's share, so that no still borrows it, and nothing of the line.
        """
        self._base_events.append((now_ns, line_bytes))
        while self._base_events[0][0] <= now_ns - 2 * self._settings.window_ns:
            self._base_events.popleft()
        if not stored:
            self.record_other(line_bytes, now_ns)
            self._last_ns = max(self._last_ns, now_ns)
        self._last_base_ns = max(self._last_base_ns or now_ns, now_ns)
        self._base_steps.append(round(self.base_step_bytes) if keyframe else line_bytes)
        self._note_bursts()
        if not self._settings.yields:
            self._note_used(now_ns)

    def end_base(self) -> None:
        """The source has given its last frame: from now on no room is reserved for frames."""
        self._base_ended = True

    def record_metadata(self, line_bytes: int, *, now_ns: int) -> None:
        """Count a message of neither stream, such as ``status``; no later message goes before it."""
        self.record_other(line_bytes, now_ns)
        self._last_ns = max(self._last_ns, now_ns)

    def record_still(self, line_bytes: int, *, now_ns: int) -> None:
        """Count one still; it was admitted by `still_allowance` at this very time."""
        self._refill(now_ns)
        # Borrow the base's unused share first: it expires a window later, saved tokens do not.
        borrowed = min(float(line_bytes), self._borrowable(now_ns))
        if borrowed > 0:
            self._lent.append((now_ns, borrowed))
        self._tokens -= line_bytes - borrowed
        self.record_other(line_bytes, now_ns)

    def holds(self, line_bytes: int) -> bool:
        """Tell whether an empty window has room for a message of ``line_bytes``."""
        return line_bytes <= self._total

    def fits(self, line_bytes: int, *, now_ns: int) -> bool:
        """Tell whether a message of ``line_bytes``, sent now, leaves every window within the total.

        Another thread may have sent since a still or a chunk was admitted, and taken its room.
        """
        return line_bytes + self._spent(self._events, now_ns) <= self._total

    def resend_ns(self, line_bytes: int, *, now_ns: int) -> int | None:
        """Return when a base message may be sent again (`earliest_ns`); None beyond the share of such messages."""
        while self._resent and self._resent[0][0] <= now_ns - self._settings.window_ns:
            self._resent.popleft()
        if line_bytes + sum(size for _, size in self._resent) > _MOST_RESENT * self._total:
            return None
        return self.earliest_ns(line_bytes, now_ns=now_ns)

    def record_resent(self, line_bytes: int, *, now_ns: int) -> None:
        """Count a base message sent again; ``now_ns`` is the time for which `resend_ns` lets it go."""
        self._resent.append((now_ns, line_bytes))
        self.record_other(line_bytes, now_ns)

    def metadata_fits(self, line_bytes: int, *, now_ns: int, before_frames: bool = False) -> bool:
        """Tell whether a message of neither stream, sent now, leaves the coming base frames their room.

        The next frame may be as large as any lately, those after it count with their mean size: with the fullest
        window of the base nothing would ever go beside it. ``before_frames``: the message has waited long enough, and
        only has to fit itself.
        """
        unspent, _ = self._unspent(now_ns)
        if before_frames:
            return bool(line_bytes <= unspent[0])
        steps = self._base_steps
        mean_bytes = sum(steps) / len(steps) if steps else self.base_step_bytes
        left = unspent - self._forecasts * mean_bytes
        return bool(line_bytes <= min(left.min(), (unspent - self._burst)[1]))

    def earliest_ns(self, line_bytes: int, *, now_ns: int, base: bool = False) -> int:
        """Return when a message of ``line_bytes`` may go: now, or as soon as its window has room.

        A ``base`` message also keeps every window of the base stream within `BASE_PEAK` times B_v. Messages keep
        their order: none goes before the base message or metadata recorded last. The wait beyond that is at most
        about one window, also for a message that no window can hold (`holds`), which must not go.
        """
        self._note_query(now_ns)
        at_ns = max(now_ns, self._last_ns)
        latest_ns = at_ns + self._settings.window_ns
        if base:
            at_ns = self._first_fit_ns(self._base_events, self._peak_at(at_ns), line_bytes, at_ns)
            at_ns = min(latest_ns, at_ns)
        at_ns = self._first_fit_ns(self._events, self._total, line_bytes, at_ns)
        return at_ns if self.holds(line_bytes) else min(latest_ns, at_ns)

    def _first_fit_ns(self, events: _Events, limit: float, line_bytes: int, at_ns: int) -> int:
        window_ns = self._settings.window_ns
        inside = [event for event in events if event[0] > at_ns - window_ns]
        held = sum(size for _, size in inside)
        for event_ns, size in inside:
            if held + line_bytes <= limit:
                break
            held -= size
            at_ns = max(at_ns, event_ns + window_ns)
        return at_ns

    def still_allowance(self, now_ns: int) -> int:
        """Return how many line bytes a still may take now; 0 where it has to wait."""
        self._refill(now_ns)
        return max(0, int(min(self._tokens + self._borrowable(now_ns), self._window_allowance(now_ns))))

    # Requested stills

    @property
    def most_requested_bytes(self) -> int:
        """The most line bytes that `requested_allowance` gives at the present rates."""
        most = _MOST_SHARE * self._loan_bytes
        if not self._settings.yields:  # where the camera takes the whole window, none may ever go
            most = min(most, self._total - self._burst[-1] - self._spare, self._most_left())
        return max(0, int(most))

    def requested_allowance(self, now_ns: int) -> int:
        """Return how many line bytes a requested still may take now: all that are free in the window that ends now.

        The coming base frames wait for their room, or are left out (`leaves_out`).
        """
        free = self._requested_free(now_ns)
        return max(0, int(min(free, self._loan.left_bytes(self._loan_bytes, now_ns=now_ns))))

    def _requested_free(self, now_ns: int, events: _Events | None = None) -> float:
        self._note_query(now_ns)
        events = self._events if events is None else events
        free = self._total - self._spent(events, now_ns) - self._spare
        return free if self._settings.yields else min(free, self._window_allowance(now_ns, events))

    def _note_used(self, now_ns: int) -> None:
        # At new rates the base's behaviour is known after a window. Other messages are no part of it, and go again
        # behind a requested still.
        if now_ns >= self._old_peak[0]:
            self._used.append((now_ns, self._total - self._requested_free(now_ns, self._base_events)))
            while self._used[0][0] <= now_ns - _LEFT_WINDOWS * self._settings.window_ns:
                self._used.popleft()

    def _most_left(self) -> float:
        # The most room that the camera has lately left a requested still: a still that needs more never goes. In the
        # first window the camera's keyframe, which comes seldom, may leave none.
        if not self._used or self._used[-1][0] - self._used[0][0] < self._settings.window_ns:
            return math.inf
        return self._total - min(used for _, used in self._used)

    def record_requested(self, line_bytes: int, *, now_ns: int) -> None:
        """Count a requested still, admitted by `requested_allowance`: saved tokens pay first, the base the rest."""
        self._refill(now_ns)
        saved = min(float(line_bytes), max(0.0, self._tokens))
        self._tokens -= saved
        self._lent.append((now_ns, line_bytes - saved))
        self._loan.take(line_bytes, now_ns=now_ns)
        self.record_other(line_bytes, now_ns)

    def want_requested(self, line_bytes: int | None, *, now_ns: int) -> None:
        """A requested still of about ``line_bytes`` waits for its room; None: none waits any more."""
        self._loan.want(line_bytes, now_ns=now_ns)

    def yielding(self, now_ns: int) -> bool:
        """Whether a requested still waits for which frames are left out: the room that they free belongs to it."""
        with self.lock:
            return self._settings.yields and self._loan.waits(self._loan_bytes, now_ns=now_ns)

    def leaves_out(self, now_ns: int) -> bool:
        """Whether the base frame that is due now is left out for a requested still; call once for each frame."""
        with self.lock:
            return self._settings.yields and self._loan.leaves_out(self._loan_bytes, now_ns=now_ns)

    @property
    def _loan_bytes(self) -> float:
        return self._total * self._loan_ns / self._settings.window_ns

    @property
    def _spare(self) -> float:
        return _SPARE_SHARE * self._loan_bytes + self._settings.metadata_bps * self._loan_ns / 8 / SECOND_NS

    def backlog_allowance(self, now_ns: int, *, reserve: float | None) -> int:
        """The line bytes of the backlog that may go now: those that neither base nor stills will likely need.

        For the base of a quiet scene only the mean of its recent and its full rate is expected: otherwise, where
        stills have little, no chunk would ever fit. ``reserve`` stays free of a window, as a share of the stills'
        part of one; None: all free bytes may go now, and the coming frames wait for them.
        A camera that is silent may give its next frame at any moment: its room stays free until `end_base`.
        """
        settings = self._settings
        alone = reserve is None or self._base_ended
        likely = self._likely_burst
        free = self._unspent(now_ns)[0][0] if alone else self._window_allowance(now_ns, burst=likely)
        reserved = (reserve or 0.0) * settings.still_bps * settings.window_ns / 8 / SECOND_NS
        return max(0, int(free - reserved))

    def keyframe_fits(self, keyframe_bytes: int, *, now_ns: int, awaited: bool = False) -> bool:
        """Tell whether a keyframe of this many line bytes, sent now, leaves every window within the total.

        Where it is ``awaited``, or no base frame has gone out for a window, only the keyframe is expected.
        """
        with self.lock:
            last_ns = self._last_base_ns
            alone = awaited or last_ns is None or now_ns - last_ns > self._settings.window_ns
            free = self._unspent(now_ns)[0][0] if alone else self._window_allowance(now_ns)
            return bool(free + self.base_step_bytes >= keyframe_bytes)

    def record_other(self, line_bytes: int, now_ns: int) -> None:
        """Count a message that is admitted at this very time and has no share, such as a chunk of the backlog."""
        sent = (now_ns, line_bytes, self._settings.total_bps)
        index = bisect(self._sent, sent)
        self._sent.insert(index, sent)
        self._events.insert(index, sent[:2])
        # Twice the window before the caller's time: a still may be queried while a base message waits for later.
        oldest_ns = min(now_ns, self._query_ns or now_ns) - 2 * self._settings.window_ns
        while self._events[0][0] <= oldest_ns:
            del self._events[0], self._sent[0]

    def _spent(self, events: _Events, now_ns: int) -> int:
        return sum(size for at_ns, size in events if at_ns > now_ns - self._settings.window_ns)

    def _counted(self, line_bytes: int, then_bps: int) -> int:
        if self._settings.window_ns <= _WHOLE_NS:
            return line_bytes
        return math.ceil(line_bytes * min(1.0, self._settings.total_bps / then_bps))

    def _note_query(self, now_ns: int) -> None:
        self._query_ns = max(now_ns, self._query_ns or now_ns)

    def _refill(self, now_ns: int) -> None:
        if self._tokens_ns is not None:
            earned = self._settings.still_bps / 8
            self._tokens += earned * (now_ns - self._tokens_ns) / SECOND_NS
            self._tokens = min(self._cap, self._tokens)
        self._tokens_ns = now_ns

    def _peak_at(self, at_ns: int) -> float:
        # The most base bytes that a window which ends at ``at_ns`` may hold.
        until_ns, old_peak = self._old_peak
        return max(old_peak, self._base_peak) if at_ns < until_ns else self._base_peak

    def _borrowable(self, now_ns: int) -> float:
        # The part of B_v that neither the base nor a still has taken in the window that ends now.
        settings = self._settings
        if not settings.borrow_unused or self._last_base_ns is None:
            return 0.0
        oldest_ns = now_ns - settings.window_ns
        while self._lent and self._lent[0][0] <= oldest_ns - settings.window_ns:
            self._lent.popleft()  # each stays one more window, for a thread whose clock is behind
        borrowed = sum(size for at_ns, size in self._lent if at_ns > oldest_ns)
        # Up to the last frame, unless the next is overdue, and half a frame short of the window: between two frames,
        # or where they jitter, a frame that is yet to come would count as unused share.
        last_ns = max(self._last_base_ns, now_ns - self._step_ns)
        first_ns = last_ns - settings.window_ns + self._step_ns // 2
        taken = sum(size for at_ns, size in self._base_events if at_ns > first_ns)
        return max(0.0, settings.base_bps * settings.window_ns / 8 / SECOND_NS - taken - borrowed)

    def _window_allowance(
        self, now_ns: int, events: _Events | None = None, *, burst: _Floats | None = None
    ) -> float:
        # The least room over every window that would contain a message sent now, beside base and metadata.
        unspent, ahead_ns = self._unspent(now_ns, events)
        beside = self._settings.metadata_bps / 8 / SECOND_NS * ahead_ns
        return float((unspent - (self._burst if burst is None else burst) - beside).min())

    def _unspent(self, now_ns: int, events: _Events | None = None) -> tuple[_Floats, npt.NDArray[np.int64]]:
        # The fullest windows end with a base frame: the window of the ``k``-th from now holds past bytes younger than
        # the window less the time until then, and ``k`` forecast frames. The first, ``k`` = 0, also holds messages
        # recorded for later, so the room is never more than any window has.
        self._note_query(now_ns)
        due_ns = max(now_ns, (self._last_base_ns or now_ns - self._step_ns) + self._step_ns)
        # A hair later than due, so that by rounding no frame more falls into the window than its rate has.
        ahead_ns = due_ns - now_ns + (self._forecasts - 1) * self._step_ns + round(_ROUNDING * self._step_ns)
        ahead_ns[0] = 0
        spans_ns = np.maximum(self._settings.window_ns - ahead_ns, 0)
        events = self._events if events is None else events
        times_ns = np.array([at_ns for at_ns, _ in events], np.int64)
        upto = np.cumsum([0, *(size for _, size in events)])
        spent = upto[-1] - upto[np.searchsorted(times_ns, now_ns - spans_ns, side="right")]
        return self._total - spent, ahead_ns

    def _note_bursts(self) -> None:
        # Bytes that ``k`` base frames in a row may take, for each ``k`` of the forecast; and the mean of that and of
        # the most that they took lately.
        upto = np.cumsum([0, *self._base_steps])
        usual = self._forecasts * self.base_step_bytes
        taken = np.array(
            [
                float((upto[k:] - upto[:-k]).max()) if 0 < k < len(upto) else usual[at]
                for at, k in enumerate(self._forecasts)
            ]
        )
        self._burst: _Floats = np.maximum(usual, taken)
        self._likely_burst = (self._burst + taken) / 2 if self._settings.yields else self._burst
