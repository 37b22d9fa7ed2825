"""``--encoder passthrough``: the camera's own units in place of an encoder's, measured before the flight and in it.

The camera's units cannot be made smaller. If the link's rate fell below their need, the next keyframe would have no
room, or the frames behind it. Then nothing arrives, and a rate that grows with arrivals never grows again. So the
camera's fullest window is the floor.

A link that carries less must not get a queue for it (`LeastLink`): the pacer declares long overdue messages lost.

A unit builds on the one before it. So if one is not sent, for want of room in the budget's window or on the link,
all units up to the camera's next keyframe are left out: no ground could show them. The camera is never commanded.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, replace

from hvt_codecs.passthrough.stream import CameraStream
from hvt_common.errors import UserError
from hvt_common.protocol.edge_words import FrameGroup
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import State
from hvt_edge.link.budget import BASE_PEAK
from hvt_edge.video.qualification import Allowed, Measured, line_bytes
from hvt_edge.video.reconfigure import EncoderReconfiguration
from hvt_edge.video.stage import Action, BaseStage, FrameDecision, FrameInputs, decide

_LONG_KEYFRAMES_S = 4.0
"""Longest keyframe interval without a note at the start: a ground that joins, or has lost frames, waits for it."""


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


@dataclass(eq=False)
class LeastLink:
    """Tells when all sent bytes have left: reported, or carried by now by a link of the least rate.

    The keyframe with which the stream begins anew waits until then. Time is an argument. ``unreported_bytes()``
    counts all units that no ground has reported; 0 too where none reports.
    """

    least_bps: int
    _: KW_ONLY
    unreported_bytes: Callable[[], int]
    _queued_bytes: float = 0.0
    """The bytes that a link of the least rate would still hold."""
    _drained_ns: int = 0

    def sent(self, size_bytes: int, *, now_ns: int) -> None:
        self._drain(now_ns)
        self._queued_bytes += size_bytes

    def is_free(self, now_ns: int) -> bool:
        """Whether no sent bytes are in flight any more."""
        self._drain(now_ns)
        return self._queued_bytes <= 0

    def _drain(self, now_ns: int) -> None:
        drained = self.least_bps * max(0, now_ns - self._drained_ns) / 8 / SECOND_NS
        self._drained_ns = max(self._drained_ns, now_ns)
        self._queued_bytes = min(max(0.0, self._queued_bytes - drained), self.unreported_bytes())


@dataclass(eq=False)
class CameraRates:
    """Called before each of the camera's keyframes for the link, in place of `EncoderReconfiguration`.

    A ground's command takes effect from there on, before room is checked. The pacer's floor becomes the camera's
    need, up to the budget. ``share`` is the base's first share, ``least_bps`` is ``--min-budget``, and
    ``surveyed_bytes`` the fullest window before the flight.
    """

    reconfiguration: EncoderReconfiguration
    _: KW_ONLY
    share: float
    least_bps: int
    surveyed_bytes: int
    window_s: float

    def __post_init__(self) -> None:
        self._window = FullestWindow(round(self.window_s * SECOND_NS))
        self._newest_bytes = self._former_bytes = 0
        self._since_ns: int | None = None

    def observe(self, unit: AccessUnit) -> None:
        """Note each unit of the camera, sent or not."""
        at_ns = unit.capture_ns
        size_bytes = line_bytes(len(unit.data), self.reconfiguration.edge_id)
        held_bytes = self._window.add(size_bytes, at_ns=at_ns)
        if self._since_ns is None or not 0 <= at_ns - self._since_ns < _MEMORY_NS:
            self._former_bytes, self._newest_bytes, self._since_ns = self._newest_bytes, 0, at_ns
        self._newest_bytes = max(self._newest_bytes, held_bytes)

    def at_keyframe(self, now_ns: int) -> None:
        """Called before a keyframe is sent, once it was observed."""
        change = self.reconfiguration
        change(1, now_ns)  # which may take a command
        if (pacer := change.pacer) is None:
            return
        before_bps, now = pacer.rate_bps, change.operating.now
        needs_bps = needed_bps(
            max(self.surveyed_bytes, self._former_bytes, self._newest_bytes),
            window_s=self.window_s,
            share=now.video_share or self.share,
            metadata_bps=change.metadata_bps,
        )
        pacer.set_ceiling(now.budget_bps, floor_bps=min(now.budget_bps, max(self.least_bps, needs_bps)))
        if pacer.rate_bps != before_bps:
            change(1, now_ns)
        change.track_link(now_ns)


_PART = "passthrough"
_PATIENCE_NS = SECOND_NS // 2
"""Longest wait of a unit for room: a large keyframe leaves none for a moment, and a waiting unit is not lost."""
_POLL_NS = SECOND_NS // 100


@dataclass(eq=False)
class PassthroughStage(BaseStage):
    """A `BaseStage` whose frames are due, and are keyframes, as the camera's units are.

    ``pause(ns)`` sleeps and returns the time; None in lockstep, where nothing is waited for. ``rates`` note each
    unit, and change before a keyframe's room on the link is checked, so that another budget takes effect there: a
    budget lowered too far could otherwise never be raised again. ``least_link`` holds a keyframe that follows a
    break. ``local_copy`` has all units of the camera, sent or not.
    """

    rates: CameraRates | None = None
    least_link: LeastLink | None = None
    pause: Callable[[int], int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._sent_index = self._stored_index = self._copied_index = -2
        """Indices of the frames sent last, stored last, copied last."""
        self._paused_ns = 0
        self._held_by: FrameGroup = "unreadable"
        """Why the chain of units is broken: until the next keyframe is sent, no unit can be shown."""
        self.left_out = 0
        """Units that were neither sent nor stored."""

    def decide(self, frame: Frame, *, now_ns: int) -> FrameDecision:
        """Decide on this frame's unit; once for each, in order. Waits for a moment where there is no room now."""
        unit, backlog = unit_of(frame), self.backlog
        keyframe = unit.keyframe
        link = State.LIVE if backlog is None else backlog.state
        if self.rates is not None:
            self.rates.observe(unit)
            if keyframe and link is not State.OFFLINE:
                self.rates.at_keyframe(now_ns)
        after_sent = self._sent_index == frame.index - 1
        after_stored = backlog is not None and backlog.segment_open and self._stored_index == frame.index - 1
        wanted = keyframe or (after_sent if link is State.LIVE else link is State.OFFLINE)
        if link is not State.LIVE:
            self._held_by = "link"
        decision = decide(
            FrameInputs(
                due=keyframe or (after_sent if link is State.LIVE else after_stored),
                keyframe_due=keyframe,
                admitted=wanted and self._admitted(unit, now_ns, live=link is State.LIVE),
                link=link,
                segment_due=keyframe,
                probe_due=backlog is not None and backlog.probe_due(now_ns, keyframe=keyframe),
            )
        )
        if not decision.codes:
            self.left_out += 1
            return FrameDecision(Action.HOLD, held_by=self._held_by)
        if keyframe:
            self.failures.works(_PART)
        return replace(decision, meets_plan=keyframe)  # the camera's next keyframe will do

    def encode(
        self, frame: Frame, decision: FrameDecision, *, now_ns: int, tracks: Tracks | None = None
    ) -> AccessUnit | None:
        """The unit as decided; None where it is left out."""
        self._copy(unit_of(frame))
        unit = super().encode(frame, decision, now_ns=now_ns, tracks=tracks)
        if unit is None:
            return None
        if decision.to_store:
            self._stored_index = unit.frame_index
        else:
            self._sent_index = unit.frame_index
        self._held_by = "unreadable"  # a gap in the numbers: frames between were lost before they came here
        return unit

    @property
    def budget_waited_ns(self) -> int:
        return self._paused_ns + super().budget_waited_ns

    def _note_sent(self, unit: AccessUnit, line_bytes: int, *, now_ns: int) -> None:
        super()._note_sent(unit, line_bytes, now_ns=now_ns)
        if self.least_link is not None:
            self.least_link.sent(line_bytes, now_ns=now_ns)

    def _leave_out(self, unit: AccessUnit) -> None:
        self._sent_index, self._held_by = -2, "budget"
        self._note_left_out(unit)

    def _admitted(self, unit: AccessUnit, now_ns: int, *, live: bool) -> bool:
        # Whether the unit may be sent now; where the link is ``live``, now or a moment later.
        until_ns = now_ns + (_PATIENCE_NS if live else 0)
        begins = live and self._sent_index != unit.frame_index - 1
        while True:
            wait_ns = self.transmitter.base_unit_wait_ns(unit, now_ns=now_ns)
            in_time = wait_ns is not None and now_ns + wait_ns <= until_ns
            free = not begins or self.least_link is None or self.least_link.is_free(now_ns)
            # The link is always queried: there lost messages are given up.
            admitted = self.admits(now_ns, round(self.transmitter.budget.base_step_bytes), 0)
            if admitted and in_time and free:
                return True
            if wait_ns is None or self.pause is None or now_ns + _POLL_NS > until_ns:
                if live:
                    self._held_by = self.holder(now_ns) if free else "link"
                    self._note_left_out(unit)
                return False
            before_ns = now_ns
            now_ns = self.pause(_POLL_NS)
            self._paused_ns += 0 if in_time and not wait_ns else now_ns - before_ns

    def _note_left_out(self, unit: AccessUnit) -> None:
        what = f"{'a keyframe' if unit.keyframe else 'a frame'} of {len(unit.data) / 1000:.1f} kB"
        full = "the link has no room" if self._held_by == "link" else "the budget's window has no room"
        self.failures.failed(_PART, f"{full} for {what}: nothing is sent up to the camera's next keyframe")

    def _copy(self, unit: AccessUnit) -> None:
        unbroken = unit.keyframe or self._copied_index == unit.frame_index - 1
        if unbroken and self._copied_index != unit.frame_index:
            super()._copy(unit)
            self._copied_index = unit.frame_index
