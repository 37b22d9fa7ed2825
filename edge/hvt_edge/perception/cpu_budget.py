"""Decides which parts of perception run when the processor is scarce, by the measured cost of each part.

Capture, coding and sending are not scheduled here: they always come first. Perception has a budget of its own, a
share of the processors (`most_cores`), and no more than video leaves of them. `share_out` gives it out in order.
A measurement over a second does not show delays of single frames, so each frame that video loses halves the
budget, which comes back in a while. Stills are chosen at detections, and are as rare as these.

Time is an argument, except the processor time of each part.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, Literal

from hvt_common.units import SECOND_NS

Part = Literal["track", "detect", "compare", "choose"]
"""Tracking through one frame; detection on the source; detection on the base, for the shadow ground; stills."""

LONGEST_DETECT_S: Final = 5.0
"""If a detection comes later than this, the machine is too slow for the detector."""
_LONGEST_TRACK_S: Final = 0.5
"""Boxes come twice a second, however little processor time there is."""
_MOST_TRACKING: Final = 0.5
_MOST_DETECTING: Final = 0.85
"""Shares of the cores that the earlier parts have left."""
_USUAL_DETECT_S: Final = 0.9
"""A detection that would come more seldom gets an input with a share of its sides, in eighths …"""
_STEPS, _LEAST_SIDES = 8, 0.5
"""… and half of them at least: a vehicle of 12 pixels has 6 then."""
_LEAST_CORES: Final = 0.5
_SHARE: Final = 0.5
"""With fewer than 3 detections a second tracking from a moving camera fails: with 1.5 it holds a third (car10)."""
_IDLE: Final = 0.1
"""Share of the processors given to no part: a process that uses all that its control group allows is halted
for the rest of each tenth of a second, and its video with it."""
_LEAST_LEFT: Final = 1 / 16
"""Least share of the budget, however many frames are lost."""
_BACK_S: Final = 5.0
"""Time in which the budget doubles again."""
_LOSS_NS: Final = SECOND_NS // 4
"""Frames lost within this time count as one loss."""
_START_NS: Final = SECOND_NS
"""Frames lost this early say nothing: the first is the dearest to code, and all other parts begin beside it."""
_MOST_QUEUED: Final = 3
"""Most frames behind the one in hand while detection may begin: they would wait as long again."""
_NEWEST: Final = 0.3
"""Weight of the newest cost in the mean."""


@dataclass(frozen=True, slots=True)
class Plan:
    """Least seconds from one turn of a part to its next; 0: no limit."""

    track_s: float = 0.0
    detect_s: float = 0.0
    compare_s: float = 0.0
    detector_share: float = 1.0
    """Share of its sides that the detector's input keeps."""


def most_cores(processors: float, *, others: float = 0.0) -> float:
    """Cores that perception may take of ``processors``, if the rest of this process takes ``others``."""
    return min(max(_LEAST_CORES, _SHARE * processors), max(0.0, (1 - _IDLE) * processors - others))


def share_out(
    cores: float, costs: Mapping[Part, float], *, fps: float, least_sides: float = _LEAST_SIDES
) -> Plan:
    """The plan for ``cores``; ``costs`` are the core seconds of one turn of each part.

    | order | part | gets | at least |
    |---|---|---|---|
    | 1 | track | each frame, for half of the cores at most | twice a second |
    | 2 | detect, with its stills | .85 of the remaining cores | each 5 s |
    | | with a smaller input if it comes less often than each .9 s | | |
    | 3 | compare | the rest | never |
    """
    track, detect, compare, choose = (
        costs.get(part, 0.0) for part in ("track", "detect", "compare", "choose")
    )
    track_s = _every_s(track, _MOST_TRACKING * cores, longest_s=_LONGEST_TRACK_S)
    left = max(0.0, cores - track * min(fps, 1 / track_s if track_s else fps))
    most_s = max(0.0, _USUAL_DETECT_S * _MOST_DETECTING * left - choose)
    share = (
        1.0
        if detect <= most_s
        else max(least_sides, math.floor(_STEPS * math.sqrt(most_s / detect)) / _STEPS)
    )
    detect_s = _every_s(detect * share**2 + choose, _MOST_DETECTING * left, longest_s=LONGEST_DETECT_S)
    compare_s = _every_s(compare, (1 - _MOST_DETECTING) * left, longest_s=math.inf)
    return Plan(track_s if track_s * fps > 1 else 0.0, detect_s, compare_s, share)


def _every_s(cost_s: float, cores: float, *, longest_s: float) -> float:
    if not cost_s:
        return 0.0
    return min(longest_s, cost_s / cores) if cores else longest_s


class CpuBudget:
    """Admits turns, and measures their cost. With infinite ``processors``, as in lockstep, it admits every turn.

    The frame loop reports frames and costs, perception's thread takes the other turns: each value has one writer.
    """

    def __init__(
        self,
        *,
        fps: float = math.inf,
        processors: float = math.inf,
        spent_ns: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self._fps, self._processors = fps, processors
        self._others = _SHARE * processors if math.isfinite(processors) else 0.0
        """Cores used by the rest of this process. A mean: a detection that ends in the next second counts there."""
        self._spent_ns = spent_ns
        self._costs: dict[Part, float] = {}
        self._had_ns: dict[Part, int] = {}
        self._perceived_ns = 0
        self._measured: tuple[int, int] | None = None
        self._lost, self._lost_ns, self._left = 0, 0, 1.0
        self._waits_ns: int | None = None
        """The first frame since the detector last ran, or was last not due."""
        self._newest_ns = 0
        self.reduces = True
        """Whether the detector's input may be reduced now."""
        self.detector_share = 1.0
        """Share of its sides that the detector's input keeps at the detection that was admitted last."""
        self.queued = 0
        self.keyframe_soon = False
        """The detector waits until a due keyframe is coded: video takes longer for it than for any other frame."""

    @property
    def plan(self) -> Plan:
        if math.isinf(self._processors):
            return Plan()
        cores = most_cores(self._processors, others=self._others)
        least_sides = _LEAST_SIDES if self.reduces else 1.0
        return share_out(cores * self._left, self._costs, fps=self._fps, least_sides=least_sides)

    @property
    def too_slow(self) -> bool:
        """Whether the detector has not run for so long that its boxes are useless."""
        waits_ns = self._waits_ns
        return waits_ns is not None and self._newest_ns - waits_ns > (LONGEST_DETECT_S + 1) * SECOND_NS

    def admits_frame(self, at_ns: int, *, lost: int, late: bool) -> bool:
        """Whether perception gets the frame of that capture time; ``lost``: frames that video has lost so far.

        No frame is admitted while the loop is ``late`` itself.
        """
        self._waits_ns = at_ns if self._waits_ns is None else self._waits_ns
        if not self._newest_ns:
            self._lost_ns = at_ns + _START_NS - _LOSS_NS
        if at_ns > self._newest_ns:
            grown = (at_ns - self._newest_ns) / SECOND_NS / _BACK_S if self._newest_ns else 0.0
            self._left = 1.0 if grown > -math.log2(self._left) else self._left * 2**grown
            self._newest_ns = at_ns
        if lost > self._lost and at_ns - self._lost_ns >= _LOSS_NS:
            self._left, self._lost_ns = max(_LEAST_LEFT, self._left / 2), at_ns
        self._lost = lost
        return not late and self._take("track", self.plan.track_s, at_ns)

    def admits_detection(self, at_ns: int, *, due: bool = True) -> bool:
        """Whether the detector searches the source of that frame, if a detection is ``due``."""
        plan = self.plan
        admitted = due and self._has_time and self._take("detect", plan.detect_s, at_ns)
        if admitted:
            self.detector_share = plan.detector_share
        if admitted or not due:
            self._waits_ns = None
        return admitted

    def admits_comparison(self, at_ns: int) -> bool:
        """Whether the detector also searches the base of that frame."""
        return self._has_time and self._take("compare", self.plan.compare_s, at_ns)

    @property
    def _has_time(self) -> bool:
        # For parts that take longer than the time between two frames.
        waits = self.keyframe_soon and math.isfinite(self._processors)
        return self.queued < _MOST_QUEUED and not waits

    def _take(self, part: Part, every_s: float, at_ns: int) -> bool:
        # Frame times are given: the frame nearest to the plan is taken, not the first one after.
        had_ns, early_s = self._had_ns.get(part), 0.5 / self._fps
        if had_ns is not None and at_ns - had_ns < (every_s - early_s) * SECOND_NS:
            return False
        self._had_ns[part] = at_ns
        return True

    @contextmanager
    def spending(self, part: Part) -> Iterator[None]:
        """Measure the cost of a turn of this part, in processor time of the calling thread."""
        began_ns = self._spent_ns()
        yield
        took_ns = self._spent_ns() - began_ns
        self._perceived_ns += took_ns
        cost_s = took_ns / SECOND_NS
        if part == "detect":  # of the full input, about
            cost_s /= self.detector_share**2
        before_s = self._costs.get(part, cost_s)
        self._costs[part] = before_s + _NEWEST * (cost_s - before_s)

    def measure(self, cores: float, *, now_ns: int) -> None:
        """Add a measurement: the cores that this process took since the last one, about a second ago."""
        before, self._measured = self._measured, (now_ns, self._perceived_ns)
        if before is None or now_ns <= before[0]:
            return
        perceived = (self._perceived_ns - before[1]) / (now_ns - before[0])
        self._others += _NEWEST * (max(0.0, cores - perceived) - self._others)
