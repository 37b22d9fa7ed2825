"""The rates of a camera whose own units are sent, measured before and in flight; rates at its keyframes.

Nobody can make its units smaller. Were the link's rate taken below what they need, the next keyframe would have no
room, or nothing behind it. Then nothing arrives, and a rate that grows with what arrives never grows again. So the
camera's fullest window is the floor.

A link that carries less must not get a queue for it (`LeastLink`): the pacer takes for lost what is overdue for long.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit
from hvt_edge.link.budget import BASE_PEAK
from hvt_edge.link.pacer import Pacer
from hvt_edge.operating import Operating
from hvt_edge.video.encoders.qualification import line_bytes
from hvt_edge.video.reconfigure import EncoderReconfiguration

_MARGIN = 1.1
"""The flight has a fuller window than was seen, and ``status`` goes beside."""
_MEMORY_NS = 30 * SECOND_NS
"""Time for which a fuller window is remembered, at most twice: a camera that stalled may have bunched its units."""


class FullestWindow:
    """The fullest window of units that come in order. Pure; line bytes, and times in nanoseconds."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._inside: deque[tuple[int, int]] = deque()
        self._held = 0
        self.most_bytes = 0
        """Bytes of the fullest window so far."""

    def add(self, size_bytes: int, *, at_ns: int) -> int:
        """Take in one unit; return the bytes of the window that ends with it."""
        if self._inside and at_ns < self._inside[-1][0]:  # its clock was set back
            self._inside.clear()
            self._held = 0
        self._inside.append((at_ns, size_bytes))
        self._held += size_bytes
        while self._inside[0][0] <= at_ns - self._window_ns:
            self._held -= self._inside.popleft()[1]
        self.most_bytes = max(self.most_bytes, self._held)
        return self._held


def needed_bps(window_bytes: int, *, window_s: float, share: float, metadata_bps: int) -> int:
    """The least budget whose windows have room for one so full, as `RollingBudget` counts, and some more."""
    base_bps = _MARGIN * 8 * window_bytes / window_s
    return math.ceil(max(base_bps / (BASE_PEAK * share), base_bps + metadata_bps))


class LeastLink:
    """Whether all that was sent has left: it is reported, or a link of the least rate would have carried it by now.

    So long a keyframe waits with which the stream begins anew. Time is an argument. ``unreported_bytes()`` is of all
    units that no ground has reported; 0 too where none reports.
    """

    def __init__(self, least_bps: int, *, unreported_bytes: Callable[[], int]) -> None:
        self._least_bps = least_bps
        self._unreported_bytes = unreported_bytes
        self._queued_bytes = 0.0
        """The bytes that such a link would still hold."""
        self._drained_ns = 0

    def sent(self, size_bytes: int, *, now_ns: int) -> None:
        """Count line bytes that go out."""
        self._drain(now_ns)
        self._queued_bytes += size_bytes

    def is_free(self, now_ns: int) -> bool:
        """Whether nothing of it is on its way any more."""
        self._drain(now_ns)
        return self._queued_bytes <= 0

    def _drain(self, now_ns: int) -> None:
        drained = self._least_bps * max(0, now_ns - self._drained_ns) / 8 / SECOND_NS
        self._drained_ns = max(self._drained_ns, now_ns)
        self._queued_bytes = min(max(0.0, self._queued_bytes - drained), self._unreported_bytes())


class CameraRates:
    """Called before each of the camera's keyframes for the link, in place of `EncoderReconfiguration`.

    What a ground has commanded holds from there on, before it is asked whether there is room. The floor of ``pacer``
    becomes what the camera needs, as far as the budget goes. ``needed(window_bytes)`` says how much that is;
    ``least_bps`` is ``--min-budget``, and ``surveyed_bytes`` the fullest window before the flight.
    """

    def __init__(
        self,
        reconfiguration: EncoderReconfiguration,
        *,
        operating: Operating,
        pacer: Pacer | None,
        needed: Callable[[int], int],
        least_bps: int,
        surveyed_bytes: int,
        window_ns: int,
        edge_id: str,
    ) -> None:
        self._reconfiguration = reconfiguration
        self._operating = operating
        self._pacer = pacer
        self._needed, self._least_bps, self._surveyed_bytes = needed, least_bps, surveyed_bytes
        self._edge_id = edge_id
        self._window = FullestWindow(window_ns)
        self._newest_bytes = self._former_bytes = 0
        self._since_ns: int | None = None

    def observe(self, unit: AccessUnit) -> None:
        """Take in each unit of the camera, sent or not."""
        at_ns = unit.capture_ns
        held_bytes = self._window.add(line_bytes(len(unit.data), self._edge_id), at_ns=at_ns)
        if self._since_ns is None or not 0 <= at_ns - self._since_ns < _MEMORY_NS:
            self._former_bytes, self._newest_bytes, self._since_ns = self._newest_bytes, 0, at_ns
        self._newest_bytes = max(self._newest_bytes, held_bytes)

    def __call__(self, decimation: int, now_ns: int) -> None:
        """The next unit is a keyframe, and was observed."""
        self._reconfiguration(decimation, now_ns)  # which may take a command
        if self._pacer is None:
            return
        before_bps, budget_bps = self._pacer.rate_bps, self._operating.now.budget_bps
        fullest_bytes = max(self._surveyed_bytes, self._former_bytes, self._newest_bytes)
        floor_bps = min(budget_bps, max(self._least_bps, self._needed(fullest_bytes)))
        self._pacer.set_ceiling(budget_bps, floor_bps=floor_bps)
        if self._pacer.rate_bps != before_bps:
            self._reconfiguration(decimation, now_ns)
        self._reconfiguration.track_link(now_ns)
