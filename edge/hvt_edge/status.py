"""The edge's own reports: `Info` on request, `Status` once a second, and a line on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from hvt_common import __version__
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import (
    BASE_CODEC,
    MOST_FAILED_PARTS,
    FailedPart,
    Health,
    Info,
    Status,
    fitted_text,
)
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import View
from hvt_edge.config import EdgeConfig
from hvt_edge.health.heartbeat import Heartbeat
from hvt_edge.health.state import EdgeState, LinkState
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating import Levers, LoopClock, Operating

_PART_BYTES, _REASON_BYTES, _LEVERS_BYTES = 24, 160, 120
_LEVERS_REST = 10
_LATE_NS = 2 * SECOND_NS
"""A report that has waited so long for what video leaves goes before the next frame: grounds live by it too."""


@dataclass(eq=False)
class InfoReporter:
    """Answers ``info``; from any thread."""

    config: EdgeConfig
    _: KW_ONLY
    session_id: int
    operating: Operating
    view: View
    class_names: tuple[str, ...]
    channels: tuple[Channel, ...]
    still_codecs: Callable[[], tuple[str, ...]]
    """Those of the stills that are sent now."""
    clock: Callable[[], int]

    def info(self, received_ns: int | None = None) -> bytes:
        """The session's facts for a ground; times are of the clock of the headers."""
        config, view, now = self.config, self.view, self.operating.now
        answered_ns = self.clock()
        info = Info(
            session_id=self.session_id,
            edge=config.edge_id,
            software=__version__,
            started_ns=now.started_ns,
            source_size=view.source_size,
            base_size=view.base_size,
            view_scale=view.scale,
            view_offset_px=view.offset_px,
            fps=config.nominal_fps,
            codec=BASE_CODEC,
            pace=config.pace,
            method=now.method,
            budget_bps=now.budget_bps,
            base_bps=now.base_bps,
            window_ns=config.window_ns,
            class_names=self.class_names,
            received_ns=answered_ns if received_ns is None else received_ns,
            answered_ns=answered_ns,
            still_codecs=self.still_codecs(),
            channels=self.channels,
        )
        return info.pack()


@dataclass(eq=False, kw_only=True)
class StatusReporter:
    """Sends ``status`` and makes the status line, from the state that it has made; in the frame loop."""

    heartbeat: Heartbeat
    operating: Operating
    session_id: int
    ledger: Ledger
    transmitter: Transmitter
    failures: Failures
    loop_clock: LoopClock

    def __post_init__(self) -> None:
        self._sequence = 0
        self._pending: tuple[EdgeState, str] | None = None
        """The report of the newest second, not sent yet."""
        self._due_ns: int | None = None
        """The time since which a report waits."""
        self._reported: Levers | None = None
        self._reported_sequence = 0

    def send(self, phase: Literal["running", "ended"]) -> None:
        """Make the report of this second, and send it as soon as it leaves video its room; the last one waits."""
        state = self.heartbeat.beat(phase)
        # Once: the transmitter makes a report twice, first for its size.
        self._pending = (state, self._levers_text(state.levers))
        self._due_ns = self.loop_clock() if self._due_ns is None else self._due_ns
        self.send_pending(last=phase == "ended")

    def send_pending(self, *, last: bool = False) -> None:
        """Before each frame: a report that found no room is tried again."""
        if self._pending is None:
            return
        (state, levers), now_ns = self._pending, self.loop_clock()
        late = self._due_ns is not None and now_ns - self._due_ns >= _LATE_NS
        if self.transmitter.status(
            lambda at_ns: self._status(state, levers, at_ns), now_ns=now_ns, before_frames=late, last=last
        ):
            self._pending = self._due_ns = None
            self._sequence += 1

    def _levers_text(self, levers: Levers) -> str:
        # Where a lever was moved, and now and then: on a thin link a sentence a second is not free.
        sent = self._reported
        moved = sent is None or (levers.tracks, levers.stills) != (sent.tracks, sent.stills)
        if not levers.says or (not moved and self._sequence - self._reported_sequence < _LEVERS_REST):
            return ""
        self._reported, self._reported_sequence = levers, self._sequence
        return fitted_text(levers.says, _LEVERS_BYTES)

    def _status(self, state: EdgeState, levers: str, at_ns: int) -> Status:
        # In lockstep no field depends on this machine's speed: the same input gives the same bytes.
        account = self.ledger.summary(state.duration_s)
        worst, frames, transmitter = account.worst_window_bps, state.frames, self.transmitter
        measured, reported_s = not state.lockstep, state.link.reported_s
        return Status(
            session_id=self.session_id,
            sequence=self._sequence,
            state=state.state,
            send_ns=at_ns,
            media_ns=max(0, at_ns - self.operating.now.started_ns),
            last_base_sequence=transmitter.base_sequence,
            last_still_sequence=transmitter.still_sequence,
            base_bytes=account.base_bytes,
            roi_bytes=account.roi_bytes,
            backlog_bytes=account.backlog_bytes,
            meta_bytes=account.meta_bytes,
            overhead_bytes=account.overhead_bytes,
            base_messages=account.messages["base"],
            roi_messages=account.messages["roi"],
            backlog_messages=account.messages["backlog"],
            meta_messages=account.messages["meta"],
            worst_window_bps=(worst.base, worst.roi, worst.total),
            sent=account.outcomes["sent"],
            deferred=account.outcomes["deferred"],
            dropped=account.outcomes["dropped"],
            health=Health(
                frames_captured=frames.account.came,
                frames_encoded=frames.encoded,
                frames_dropped=frames.account.dropped,
                keyframes=state.keyframes,
                tracks=state.tracks,
                base_queue=0,  # the base stream has no queue: frames are dropped before they are encoded
                still_queue=state.stills_pending,
                encode_ms=(state.encode_ms or 0.0) if measured else 0.0,
                detect_ms=(state.perception_ms or 0.0) if measured else 0.0,
                feedback_age_ms=round(1000 * reported_s) if measured and reported_s is not None else -1,
                frames_dropped_cpu=frames.account.groups.get("processor", 0),
                frames_unanalyzed=frames.unanalyzed,
                cores_needed=(state.cores_needed or 0.0) if measured else 0.0,
                cores_free=(state.cores_free or 0.0) if measured else 0.0,
            ),
            failed=tuple(
                FailedPart(
                    part=one.part[:_PART_BYTES],
                    reason=fitted_text(one.reason, _REASON_BYTES),
                    failures=one.count,
                    failed_ns=one.failed_ns,
                    working=one.working,
                )
                for one in self.failures.parts[:MOST_FAILED_PARTS]
            ),
            levers=levers,
            frames=frames.account.as_counts(),
            coded_fps=frames.account.coded_fps,
            auto_fps=frames.account.auto_fps,
        )


def status_text(state: EdgeState, *, paused_s: float = 0.0) -> str:
    """The status line; ``paused_s``: by how much a clip is played longer than it is."""
    operating, link, backlog = state.operating, state.link, state.backlog
    parts = [
        f"{state.edge} {state.duration_s:6.1f} s",
        f"{bitrate_text(state.total_bps or 0)} of {bitrate_text(operating.allowed_bps)}",
        f"auto, {state.method}" if operating.profile == "auto" else state.method,
        str(state.frames.account),
        f"stills {state.stills_sent}, {state.stills_pending} pending",
        f"tracks {state.tracks}",
        _link_text(link),
    ]
    if backlog is not None and (backlog.stills or backlog.segments):
        parts.append(f"kept {backlog.stills} stills, {backlog.video_s:.0f} s")
    if state.levers.says:
        parts.append(state.levers.says)
    if state.detection_slow:
        parts.append(f"boxes {state.boxes_age_s:.1f} s old: detection is too slow")
    if paused_s:
        parts.append(f"clip {paused_s:.0f} s longer: slow machine")
    parts += [f"{one.part.upper()} FAILED" for one in state.failed]
    return "  ".join(parts)


def _link_text(link: LinkState) -> str:
    if link.ground:
        return "a ground listens"
    if link.watched:
        return "somebody watches who reports nothing"
    return "no link" if link.trouble else "no ground listens"
