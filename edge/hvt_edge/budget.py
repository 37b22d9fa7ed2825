"""The hard bit budget: what a still may cost now, and when a base frame may go.

No rolling window ever exceeds the total.

Two limits hold for stills at once, both in line bytes (payload, attachment and transport overhead):

* **the share**: stills earn ``B_r = B_tot - B_v`` all the time and may save up what they do not spend, but no
  more than ``carry_s`` seconds of it (a token bucket);
* **the window**: in every rolling window of ``window_ns``, past or still to come, base and stills together stay
  within ``B_tot``. A still sent now sits in every window that ends up to one window from now, so the
  base frames that will share those windows are counted in advance: at the mean rate of ``B_v``, or
  what the base did in any stretch of the same length lately, whichever is more. Keyframes are no part of
  that memory, because they come only when the edge decides: before one, stills are held until it
  fits (`keyframe_fits`).

So stills yield where the base overshoots. What no forecast sees, a base frame that is suddenly large after stills
have taken their share, waits the few milliseconds until the window has room (`earliest_ns`): nothing is dropped, and
the total holds all the same.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

__all__ = ["BudgetSettings", "RollingBudget"]

_SECOND_NS = 1_000_000_000
_MEMORY_WINDOWS = 5
"""How many windows of the base's recent behaviour the forecast looks back on."""


@dataclass(frozen=True, slots=True)
class BudgetSettings:
    """Rates in line bits a second; times in nanoseconds."""

    total_bps: int
    base_bps: int
    """B_v, the share of the base stream with its metadata and overhead."""
    fps: float
    window_ns: int = _SECOND_NS
    carry_s: float = 2.0


class RollingBudget:
    """Admits stills. Time is an argument and never goes back."""

    def __init__(self, settings: BudgetSettings) -> None:
        self._settings = settings
        self._total = settings.total_bps * settings.window_ns / 8 / _SECOND_NS
        self._step_ns = round(_SECOND_NS / settings.fps)
        self._steps = max(1, round(settings.window_ns / self._step_ns))
        self._events: deque[tuple[int, int]] = deque()
        self._last_ns = 0
        self._base_steps: deque[int] = deque(maxlen=self._steps * _MEMORY_WINDOWS)
        self._burst = np.zeros(self._steps + 1)
        self._tokens = self._cap = (settings.total_bps - settings.base_bps) * settings.carry_s / 8
        self._tokens_ns: int | None = None

    @property
    def base_step_bytes(self) -> float:
        """What one base frame takes on average at B_v, in line bytes."""
        return self._settings.base_bps / 8 / self._settings.fps

    def record_base(self, line_bytes: int, *, now_ns: int, keyframe: bool = False) -> None:
        """Count one base message (or metadata that rides beside it)."""
        self._record(line_bytes, now_ns)
        self._last_ns = max(self._last_ns, now_ns)
        self._base_steps.append(round(self.base_step_bytes) if keyframe else line_bytes)
        self._burst = self._recent_bursts()

    def record_metadata(self, line_bytes: int, *, now_ns: int) -> None:
        """Count a message that belongs to neither stream, such as ``status``."""
        self._record(line_bytes, now_ns)

    def record_still(self, line_bytes: int, *, now_ns: int) -> None:
        """Count one still; it was admitted by `still_room` at this very time."""
        self._refill(now_ns)
        self._tokens -= line_bytes
        self._record(line_bytes, now_ns)

    def earliest_ns(self, line_bytes: int, *, now_ns: int) -> int:
        """Return when a message of so many line bytes may go: now, or as soon as its window has room.

        Messages keep their order: never before what was recorded last. A message that no window can hold goes one
        window from now at the latest.
        """
        now_ns = max(now_ns, self._last_ns)
        window_ns = self._settings.window_ns
        held = sum(size for at_ns, size in self._events if at_ns > now_ns - window_ns)
        for at_ns, size in sorted(self._events):
            if held + line_bytes <= self._total:
                break
            if at_ns > now_ns - window_ns:
                held -= size
                now_ns = at_ns + window_ns
        return now_ns

    def still_room(self, now_ns: int) -> int:
        """Return how many line bytes a still may take now; 0 where it has to wait."""
        self._refill(now_ns)
        return max(0, int(min(self._tokens, self._window_room(now_ns))))

    def keyframe_fits(self, keyframe_bytes: int, *, now_ns: int) -> bool:
        """Tell whether a keyframe of this many line bytes, sent now, leaves every window within the total."""
        return self._window_room(now_ns) + self.base_step_bytes >= keyframe_bytes

    def _record(self, line_bytes: int, now_ns: int) -> None:
        self._events.append((now_ns, line_bytes))
        # Twice the window: a still may be asked about a little before a base message that waits.
        while self._events[0][0] <= now_ns - 2 * self._settings.window_ns:
            self._events.popleft()

    def _refill(self, now_ns: int) -> None:
        if self._tokens_ns is not None:
            earned = (self._settings.total_bps - self._settings.base_bps) / 8
            self._tokens += earned * (now_ns - self._tokens_ns) / _SECOND_NS
            self._tokens = min(self._cap, self._tokens)
        self._tokens_ns = now_ns

    def _window_room(self, now_ns: int) -> float:
        """The least room over every window that would contain a message sent now.

        The window that ends ``k`` base frames from now holds the past bytes younger than the window less
        ``k`` frames, and ``k`` frames of the base to come.
        """
        ages = np.array([now_ns - at_ns for at_ns, _ in self._events], np.int64)
        sizes = np.array([size for _, size in self._events], np.float64)
        steps = np.arange(self._steps + 1)
        spans_ns = self._settings.window_ns - steps * self._step_ns
        past = np.array([sizes[ages < span].sum() for span in spans_ns])
        return float((self._total - past - self._burst).min())

    def _recent_bursts(self) -> npt.NDArray[np.float64]:
        """Bytes that ``k`` base frames in a row may take, for k = 0 … frames in a window."""
        sums = np.concatenate([[0.0], np.cumsum(self._base_steps)])
        mean = np.arange(self._steps + 1, dtype=np.float64) * self.base_step_bytes
        longest = min(self._steps, len(self._base_steps))
        for count in range(1, longest + 1):
            mean[count] = max(mean[count], float((sums[count:] - sums[:-count]).max()))
        return mean
