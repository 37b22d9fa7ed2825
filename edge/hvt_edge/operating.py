"""The operating point: budget, split, method and frame rate as they are now.

Settings are frozen; what commands, the link and measurements change lives here. Three write:
`hvt_edge.control.commands` what a ground commanded, the frame loop (`hvt_edge.video.reconfigure`) what the link
allows and what x265 was opened for and with, and `hvt_edge.perception.levers` what is worth sending beside the video.
The encoder, the budget, ``info``, status and summary all read the same.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from hvt_common.units import SECOND_NS


@dataclass(frozen=True, slots=True)
class Levers:
    """Which parts are sent beside the video, as far as the settings allow it."""

    tracks: bool = True
    stills: bool = True
    """Those of the method; a still that a ground requests is always sent."""
    says: str = ""
    """Why, in one line for people; empty where nothing is measured."""


@dataclass(frozen=True, slots=True)
class Rates:
    """The rates for which x265 is opened, in line bits a second."""

    total_bps: int
    """B_tot: the budget, or less if the link carries less."""
    base_bps: int
    """B_v."""
    decimation: int
    """Each n-th source frame is coded."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """The rates of one moment, in line bits a second."""

    budget_bps: int
    """B_tot as set or commanded; `total_bps` never exceeds it."""
    video_share: float | None
    """The base stream's share of it, as set or commanded; None: it follows the scene."""
    method: str
    total_bps: int
    """The rate that may be sent now: the budget, or less if the link carries less."""
    base_bps: int
    """B_v: the rate for which x265 was opened."""
    decimation: int
    """Each n-th source frame is coded."""
    highest_budget_bps: int
    """Of all budgets that were in force."""
    preset: str = ""
    """Of x265."""
    preset_says: str = ""
    """Why it is that, in one line for people; empty where nothing had to be given up."""
    levers: Levers = Levers()
    started_ns: int = 0
    """When the first frame was taken; 0 before."""


class Operating:
    """Holds the newest point; thread-safe."""

    def __init__(self, *, budget_bps: int, **beginning: Any) -> None:
        """Begin with the whole budget; ``beginning`` are further fields of `OperatingPoint`."""
        self._point = OperatingPoint(
            budget_bps=budget_bps, total_bps=budget_bps, highest_budget_bps=budget_bps, **beginning
        )
        self._lock = threading.Lock()

    @property
    def now(self) -> OperatingPoint:
        return self._point

    def start(self, now_ns: int) -> None:
        """The first frame is about to be taken."""
        self._set(started_ns=now_ns)

    def command(self, *, budget_bps: int, video_share: float | None, method: str) -> None:
        """Note a ground's command; the rates take effect with the next keyframe."""
        highest_bps = max(self._point.highest_budget_bps, budget_bps)
        self._set(
            budget_bps=budget_bps, video_share=video_share, method=method, highest_budget_bps=highest_bps
        )

    def allow(self, total_bps: int) -> None:
        self._set(total_bps=total_bps)

    def open(self, rates: Rates, *, total_bps: int) -> None:
        """Note the rates for which x265 is opened, and the total that may be sent now."""
        self._set(total_bps=total_bps, base_bps=rates.base_bps, decimation=rates.decimation)

    def encode_with(self, preset: str, says: str) -> None:
        """Use this preset from the next keyframe on; ``says`` is the sentence about it."""
        self._set(preset=preset, preset_says=says)

    def pull(self, levers: Levers) -> None:
        """Decide anew, by the measurements, which parts are sent beside the video."""
        self._set(levers=levers)

    def _set(self, **changes: object) -> None:
        with self._lock:
            self._point = replace(self._point, **changes)  # type: ignore[arg-type]


class LoopClock:
    """The time that the budget's windows go by: the wall clock, or in lockstep the newest frame's capture time.

    ``wait(seconds)`` sleeps; in lockstep nothing is waited for.
    """

    def __init__(
        self, clock: Callable[[], int], *, lockstep: bool, wait: Callable[[float], object] = time.sleep
    ) -> None:
        self._clock = clock
        self._lockstep = lockstep
        self._wait = wait
        self._media_ns = 0

    def __call__(self) -> int:
        return self._media_ns if self._lockstep else self._clock()

    def advance(self, capture_ns: int) -> None:
        """The loop has come to this frame."""
        self._media_ns = capture_ns

    def wait_until(self, at_ns: int) -> None:
        """Sleep until then, as the budget's window makes room."""
        if not self._lockstep and (wait_ns := at_ns - self._clock()) > 0:
            self._wait(wait_ns / SECOND_NS)

    def pause(self, pause_ns: int) -> int:
        """Sleep for so long; return the time then."""
        self.wait_until(self() + pause_ns)
        return self()


def base_rate_bps(total_bps: int, share: float, *, metadata_bps: int) -> int:
    """B_v of so much in all, less the rate of tracks."""
    return round(min(total_bps * share, total_bps - metadata_bps))
