"""``--encoder passthrough``: the camera's own units in place of an encoder's, measured before the flight and in it.

The camera's units cannot be made smaller. If the link's rate fell below their need, the next keyframe would have no
room, or the frames behind it. Then nothing arrives, and a rate that grows with arrivals never grows again. So the
camera's fullest window is the floor.

A link that carries less must not get a queue for it (`LeastLink`): the pacer declares long overdue messages lost.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import AccessUnit, Frame
from hvt_edge.link.budget import BASE_PEAK
from hvt_edge.source.contract import CameraStream
from hvt_edge.video.encoders.qualification import Allowed, Measured, line_bytes
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.x265 import Region

_LONG_KEYFRAMES_S = 4.0
"""Longest keyframe interval without a note at the start: a ground that joins, or has lost frames, waits for it."""


class Passthrough:
    """An `Encoder` that encodes nothing. The camera decides on keyframes, whatever is requested."""

    mean_qp = math.nan

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        del keyframe
        assert not regions, "config.check() refuses regions with another encoder than x265"
        return unit_of(frame)


def unit_of(frame: Frame) -> AccessUnit:
    unit = frame.camera_unit
    assert unit is not None, "the source was opened for passthrough"
    return AccessUnit(frame.index, frame.capture_ns, unit.data, keyframe=unit.keyframe)


def measure_camera(stream: CameraStream, *, window_s: float, edge_id: str) -> Measured:
    """The fullest window of the surveyed camera by its own times, and its largest keyframe; line bytes."""
    window, largest = FullestWindow(round(window_s * SECOND_NS)), 0
    for unit in stream.units:
        size = line_bytes(unit.size_bytes, edge_id)
        window.add(size, at_ns=round(unit.at_s * SECOND_NS))
        largest = max(largest, size if unit.keyframe else 0)
    return Measured(window.most_bytes, largest)


def check_camera(name: str, stream: CameraStream, limit: Allowed, *, budget_bps: int, edge_id: str) -> str:
    """The measurement as a sentence. Raises `UserError` with the figure if it does not fit the budget."""
    found = measure_camera(stream, window_s=limit.window_s, edge_id=edge_id)
    rate = bitrate_text(round(8 * found.window_bytes / limit.window_s))
    takes = (
        f"{rate} in its fullest {limit.window_s:g} s (largest keyframe {found.keyframe_bytes / 1000:.1f} kB)"
    )
    if found.window_bytes > limit.window_bytes:
        leaves = bitrate_text(round(8 * limit.window_bytes / limit.window_s))
        raise UserError(
            f"source {name} makes {takes}, and --budget {bitrate_text(budget_bps)} leaves {leaves} for it: "
            "re-encode it with --encoder x265, lower the camera's rate, or raise --budget"
        )
    return f"source {name} is passed through: {stream.fps:g} fps, {takes}"


def about_keyframes(name: str, stream: CameraStream) -> str:
    """The cost of a camera's rare keyframes, as a sentence; empty if there are enough."""
    if stream.keyframe_s <= _LONG_KEYFRAMES_S:
        return ""
    return (
        f"source {name} goes {stream.keyframe_s:.0f} s without a keyframe, and a ground that joins or has lost "
        "something waits so long for a picture: set the camera to one each second or two"
    )


_MARGIN = 1.1
"""The flight has a fuller window than the survey, and ``status`` needs room beside it."""
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
        """Add one unit; return the bytes of the window that ends with it."""
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
    """The least budget whose windows have room for such a window, as `RollingBudget` counts, plus a margin."""
    base_bps = _MARGIN * 8 * window_bytes / window_s
    return math.ceil(max(base_bps / (BASE_PEAK * share), base_bps + metadata_bps))


class LeastLink:
    """Tells when all sent bytes have left: reported, or carried by now by a link of the least rate.

    The keyframe with which the stream begins anew waits until then. Time is an argument. ``unreported_bytes()``
    counts all units that no ground has reported; 0 too where none reports.
    """

    def __init__(self, least_bps: int, *, unreported_bytes: Callable[[], int]) -> None:
        self._least_bps = least_bps
        self._unreported_bytes = unreported_bytes
        self._queued_bytes = 0.0
        """The bytes that a link of the least rate would still hold."""
        self._drained_ns = 0

    def sent(self, size_bytes: int, *, now_ns: int) -> None:
        self._drain(now_ns)
        self._queued_bytes += size_bytes

    def is_free(self, now_ns: int) -> bool:
        """Whether no sent bytes are in flight any more."""
        self._drain(now_ns)
        return self._queued_bytes <= 0

    def _drain(self, now_ns: int) -> None:
        drained = self._least_bps * max(0, now_ns - self._drained_ns) / 8 / SECOND_NS
        self._drained_ns = max(self._drained_ns, now_ns)
        self._queued_bytes = min(max(0.0, self._queued_bytes - drained), self._unreported_bytes())


class CameraRates:
    """Called before each of the camera's keyframes for the link, in place of `EncoderReconfiguration`.

    A ground's command takes effect from there on, before room is checked. The pacer's floor becomes the camera's
    need, up to the budget. ``needed(window_bytes)`` returns that rate;
    ``least_bps`` is ``--min-budget``, and ``surveyed_bytes`` the fullest window before the flight.
    """

    def __init__(
        self,
        reconfiguration: EncoderReconfiguration,
        *,
        needed: Callable[[int], int],
        least_bps: int,
        surveyed_bytes: int,
        window_ns: int,
    ) -> None:
        self._reconfiguration = reconfiguration
        self._needed, self._least_bps, self._surveyed_bytes = needed, least_bps, surveyed_bytes
        self._window = FullestWindow(window_ns)
        self._newest_bytes = self._former_bytes = 0
        self._since_ns: int | None = None

    def observe(self, unit: AccessUnit) -> None:
        """Note each unit of the camera, sent or not."""
        at_ns = unit.capture_ns
        size_bytes = line_bytes(len(unit.data), self._reconfiguration.edge_id)
        held_bytes = self._window.add(size_bytes, at_ns=at_ns)
        if self._since_ns is None or not 0 <= at_ns - self._since_ns < _MEMORY_NS:
            self._former_bytes, self._newest_bytes, self._since_ns = self._newest_bytes, 0, at_ns
        self._newest_bytes = max(self._newest_bytes, held_bytes)

    def at_keyframe(self, now_ns: int) -> None:
        """Called before a keyframe is sent, once it was observed."""
        self._reconfiguration(1, now_ns)  # which may take a command
        pacer = self._reconfiguration.pacer
        if pacer is None:
            return
        before_bps, budget_bps = pacer.rate_bps, self._reconfiguration.operating.now.budget_bps
        fullest_bytes = max(self._surveyed_bytes, self._former_bytes, self._newest_bytes)
        floor_bps = min(budget_bps, max(self._least_bps, self._needed(fullest_bytes)))
        pacer.set_ceiling(budget_bps, floor_bps=floor_bps)
        if pacer.rate_bps != before_bps:
            self._reconfiguration(1, now_ns)
        self._reconfiguration.track_link(now_ns)
