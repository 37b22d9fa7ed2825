"""What the edge reports of itself: `Info` on request, `Status` once a second, and a line on the terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

from hvt_common import __version__
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import (
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
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.operating.keyframes import KeyframeRequests
from hvt_edge.operating.point import Levers, LoopClock, Operating
from hvt_edge.stills.stage import StillStage

__all__ = ["InfoReporter", "StatusReporter"]

_MILLION = 1_000_000
_PART_BYTES, _REASON_BYTES, _LEVERS_BYTES = 24, 160, 120
_LEVERS_REST = 10


@dataclass(eq=False)
class InfoReporter:
    """Answers ``info``; from any thread."""

    config: EdgeConfig
    _: KW_ONLY
    session_id: int
    operating: Operating
    view: View
    class_names: tuple[str, ...]
    clock: Callable[[], int]

    def info(self, received_ns: int | None = None) -> bytes:
        """What a ground needs to know of the session; times are of the clock that the headers go by."""
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
            codec="hevc",
            pace=config.pace,
            method=now.method,
            budget_bps=now.budget_bps,
            base_bps=now.base_bps,
            window_ns=config.window_ns,
            class_names=self.class_names,
            received_ns=answered_ns if received_ns is None else received_ns,
            answered_ns=answered_ns,
        )
        return info.pack()


@dataclass(eq=False)
class StatusReporter:
    """Sends ``status`` and makes the status line; in the frame loop."""

    config: EdgeConfig
    _: KW_ONLY
    session_id: int
    operating: Operating
    ledger: Ledger
    counts: FrameCounts
    keyframes: KeyframeRequests
    transmitter: Transmitter
    stills: StillStage
    inbox: FeedbackInbox
    failures: Failures
    clock: Callable[[], int]
    loop_clock: LoopClock

    def __post_init__(self) -> None:
        self._sequence = 0
        self._reported: Levers | None = None
        self._reported_sequence = 0

    def send(self, state: str) -> None:
        """Send the report, made for the moment at which it may go."""
        self.counts.measure_cpu(perception_ns=self.stills.analyzer.spent_ns)
        self.transmitter.status(
            lambda at_ns: self._status(state, at_ns), now_ns=self.loop_clock(), last=state == "ended"
        )
        self._sequence += 1

    def _levers_text(self) -> str:
        """Where a lever was moved, and now and then: on a thin link a sentence a second is not free."""
        levers, sent = self.operating.now.levers, self._reported
        moved = sent is None or (levers.tracks, levers.stills) != (sent.tracks, sent.stills)
        if not moved and self._sequence - self._reported_sequence < _LEVERS_REST:
            return ""
        self._reported, self._reported_sequence = levers, self._sequence
        return fitted_text(levers.says, _LEVERS_BYTES)

    def line(self, link: str) -> str:
        """The status line."""
        config, now, ledger, counts = self.config, self.operating.now, self.ledger, self.counts
        rate_bps = ledger.window_bytes(None, self.loop_clock()) * 8 * SECOND_NS / ledger.window_ns
        parts = [
            f"{config.edge_id} {counts.duration_s(config.nominal_fps):6.1f} s",
            f"{bitrate_text(rate_bps)} of {bitrate_text(now.total_bps)}",
            f"auto, {now.method}" if config.measures else now.method,
            f"stills {sum(ledger.outcomes('sent').values())}, {self.stills.pending} pending",
            f"tracks {self.stills.analyzer.tracks}",
            link,
        ]
        if now.levers.says:
            parts.append(now.levers.says)
        if counts.dropped_cpu:
            parts.append(f"{counts.dropped_cpu} frames dropped: slow machine")
        if counts.paused_ns:
            parts.append(f"clip {counts.paused_ns / SECOND_NS:.0f} s longer: slow machine")
        parts += [f"{one.part.upper()} FAILED" for one in self.failures.parts if not one.working]
        return "  ".join(parts)

    def _status(self, state: str, at_ns: int) -> Status:
        """Totals, outcomes and health at ``at_ns``.

        In lockstep no field depends on this machine's speed: the same input gives the same bytes.
        """
        counts, stills, transmitter = self.counts, self.stills, self.transmitter
        account = self.ledger.summary(counts.duration_s(self.config.nominal_fps))
        worst, now = account.worst_window_bps, self.operating.now
        measured = self.config.pace != "lockstep"
        reported_ns = self.inbox.received_ns
        age_ms = -1 if reported_ns is None else max(0, (self.clock() - reported_ns) // _MILLION)
        return Status(
            session_id=self.session_id,
            sequence=self._sequence,
            state=state,
            send_ns=at_ns,
            media_ns=max(0, at_ns - now.started_ns),
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
                frames_captured=counts.captured,
                frames_encoded=counts.encoded,
                frames_dropped=counts.dropped,
                keyframes=self.keyframes.sent,
                tracks=stills.analyzer.tracks,
                base_queue=0,  # the base stream has no queue: frames are dropped before they are encoded
                still_queue=stills.pending,
                encode_ms=counts.encode_ms if measured else 0.0,
                detect_ms=stills.analyzer.mean_ms if measured else 0.0,
                feedback_age_ms=age_ms if measured else -1,
                frames_dropped_cpu=counts.dropped_cpu,
                frames_unanalyzed=counts.unanalyzed,
                cores_needed=counts.cpu.now.needed if measured else 0.0,
                cores_free=counts.cpu.now.free if measured else 0.0,
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
            levers=self._levers_text(),
        )
