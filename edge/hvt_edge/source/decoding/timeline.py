"""Times of decoded frames as a player gives them: every frame once, in order. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from statistics import median
from typing import Any

LONG_STEP_S = Fraction(10)
"""A step of more than this, and than three usual ones, is a jump where a container may have some (MPEG-TS)."""
LONG_PAUSE_S = Fraction(3600)
"""The same in other containers, where a recorder that waits for motion leaves pauses (ffplay, max_frame_duration)."""
_LONG_STEPS = 3
_FEW = 8
"""After this many stamps that do not rise, the stream has none."""
_SAME = Fraction(2, 100)
_ROUNDED_S = Fraction(1, 1000)
"""Matroska, FLV and ASF round times to milliseconds, and files made from them keep these in finer units."""


@dataclass(frozen=True, slots=True)
class Stamps:
    """The time stamps of a stream's first packets, in decoding order."""

    period_s: Fraction
    """The usual step from one frame to the next."""
    usable: bool
    """Whether they rise at all; else frames follow each other by ``period_s``."""
    ordered: bool = True
    """Whether they are presentation times; else decoding times, as in AVI: the n-th frame shown has the n-th."""
    long_s: Fraction = LONG_STEP_S
    """A longer step is a jump."""
    whole: bool = True
    """Whether the first picture that is shown is not damaged."""

    def timeline(self, stream: Any) -> Timeline:
        quantum_s = stream.time_base if self.usable else None
        return Timeline(self.period_s, quantum_s=quantum_s, long_s=self.long_s)

    def slack_s(self, stream: Any) -> Fraction:
        """The time by which rounding may have made a stamp late."""
        return max(_ROUNDED_S, Fraction(stream.time_base or 0)) if self.usable else Fraction(0)


def surveyed(
    packets: Sequence[tuple[Fraction | None, Fraction | None]], *, said_fps: Fraction | None, reorders: bool
) -> Stamps:
    """From (presentation, decoding) seconds of packets; ``reorders``: the decoder has B-frames to sort.

    ``said_fps`` is the container's rate. It counts if the stamps agree with it within 2 %, and if there are none.
    """
    said_s = 1 / (said_fps or Fraction(25))
    shown = [one for one, _ in packets if one is not None]
    either = (one if two is None else two for one, two in packets)
    coded = [one for one in either if one is not None]
    steps = [later - earlier for earlier, later in pairwise(coded)]
    rising = [step for step in steps if step > 0]
    if not rising:
        return Stamps(said_s, usable=len(coded) > 0 and len(coded) < _FEW)
    usual_s = Fraction(median(rising))
    most_s = max(LONG_STEP_S, _LONG_STEPS * usual_s)
    near = [step for step in steps if 0 <= step <= most_s]
    # Of stamps in whole seconds the mean gives the rate, of uneven ones the median.
    usual_s = min(usual_s, sum(near, Fraction(0)) / len(near)) if near else said_s
    if abs(usual_s / said_s - 1) < _SAME:
        usual_s = said_s
    unsorted = reorders and len(shown) >= _FEW and all(a < b for a, b in pairwise(shown))
    return Stamps(usual_s, usable=True, ordered=not unsorted and len(shown) * 2 > len(packets))


class Timeline:
    """One reading of a stream, whose stamps are whole ``quantum_s``.

    A stamp that steps back, or by more than ``long_s`` and three usual steps, follows its predecessor as usual.

    Such a step is a clock that was set or ran over, a damaged stamp, or two recordings put together. Two frames of
    one time are both shown: the second comes a little later.
    """

    def __init__(
        self, period_s: Fraction, *, quantum_s: Fraction | None = None, long_s: Fraction = LONG_STEP_S
    ) -> None:
        # A mended step is a whole number of quanta, like the steps around it; a frame that came a little
        # late would be passed over at the next instant of the base.
        self._period_s = period_s if not quantum_s else max(1, math.floor(period_s / quantum_s)) * quantum_s
        self._most_s = max(long_s, _LONG_STEPS * period_s)
        self._stamp_s: Fraction | None = None
        self._at_s: Fraction | None = None
        self._offset_s = Fraction(0)
        self._former_s: Fraction | None = None
        self.jumps: list[tuple[Fraction, Fraction]] = []
        """Place of each repair in the presentation, and the size of the step; seconds."""

    @property
    def says(self) -> str:
        """The repairs, in a sentence; empty for none."""
        if not self.jumps:
            return ""
        at_s, step_s = self.jumps[0]
        times = "" if len(self.jumps) == 1 else f", the first of {len(self.jumps)} jumps"
        return (
            f"its time stamps jump by {float(step_s):+.3f} s at {float(at_s):.3f} s{times}: the frames go on as "
            "before, and --source-fps N ignores all its time stamps"
        )

    def at(self, stamp_s: Fraction | None) -> Fraction:
        """The time of the next frame, in seconds; ``stamp_s`` is None where it has none."""
        at_s = self._next(stamp_s)
        if stamp_s is not None:
            self._stamp_s = stamp_s
        self._at_s = at_s
        return at_s

    def _next(self, stamp_s: Fraction | None) -> Fraction:
        if self._at_s is None:
            return Fraction(0) if stamp_s is None else stamp_s
        if stamp_s is None:
            return self._at_s + self._period_s
        expected_s = self._at_s + self._period_s
        if self._stamp_s is None:  # the first frame with a stamp
            self._offset_s = expected_s - stamp_s
            return expected_s
        step_s, near_s = stamp_s - self._stamp_s, _LONG_STEPS * self._period_s
        if step_s > self._most_s or step_s < -near_s:
            self.jumps.append((self._at_s, step_s))
            self._former_s, self._offset_s = self._offset_s, expected_s - stamp_s
        elif self._former_s is not None and step_s > near_s >= abs(stamp_s + self._former_s - expected_s):
            self._offset_s = self._former_s  # frames between came late: around damage, or by damaged stamps
        at_s = stamp_s + self._offset_s
        return at_s if at_s > self._at_s else self._at_s + self._period_s / 2
