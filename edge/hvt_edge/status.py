"""What the edge says of itself: `Info` when asked, `Status` once a second, and a line for whoever looks at it."""

from __future__ import annotations

from hvt_common import __version__
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import Health, Info, Status, fitted_class_names
from hvt_common.units import bitrate_text
from hvt_common.values import View
from hvt_edge.config import EdgeConfig
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.operating.keyframes import KeyframePlan
from hvt_edge.stills.stage import StillStage

__all__ = ["make_info", "make_status", "status_text"]

_SECOND_NS = 1_000_000_000


def make_info(
    config: EdgeConfig,
    *,
    session_id: int,
    started_ns: int,
    view: View,
    class_names: tuple[str, ...],
    window_ns: int,
    received_ns: int,
    answered_ns: int,
) -> Info:
    """What does not change while the session runs; both times are of the clock that the headers go by."""
    return Info(
        session_id=session_id,
        edge=config.edge_id,
        software=__version__,
        started_ns=started_ns,
        source_size=view.source_size,
        base_size=view.base_size,
        view_scale=view.scale,
        view_offset_px=view.offset_px,
        fps=config.nominal_fps,
        codec="hevc",
        pace=config.pace,
        method=config.method,
        budget_bps=config.budget_bps,
        base_bps=config.base_bps,
        window_ns=window_ns,
        class_names=fitted_class_names(class_names),
        received_ns=received_ns,
        answered_ns=answered_ns,
    )


def make_status(
    state: str,
    *,
    session_id: int,
    sequence: int,
    at_ns: int,
    started_ns: int,
    fps: float,
    ledger: Ledger,
    counts: FrameCounts,
    keyframes: KeyframePlan,
    sender: Transmitter,
    stills: StillStage,
    feedback_age_ms: int,
    measured: bool,
) -> Status:
    """Totals, fates and health at ``at_ns``.

    Without ``measured`` (lockstep) no field hangs on this machine's speed: the same input gives the same bytes.
    """
    account = ledger.summary(counts.duration_s(fps))
    worst = account.worst_window_bps
    return Status(
        session_id=session_id,
        sequence=sequence,
        state=state,
        send_ns=at_ns,
        media_ns=max(0, at_ns - started_ns),
        last_base_sequence=sender.base_sequence,
        last_still_sequence=sender.still_sequence,
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
            keyframes=keyframes.sent,
            tracks=stills.tracks,
            base_queue=0,  # the base stream has no queue: frames are dropped before they are encoded
            still_queue=stills.pending,
            encode_ms=counts.encode_ms if measured else 0.0,
            detect_ms=stills.perception_ms if measured else 0.0,
            feedback_age_ms=feedback_age_ms if measured else -1,
        ),
    )


def status_text(
    config: EdgeConfig,
    *,
    counts: FrameCounts,
    ledger: Ledger,
    stills: StillStage,
    now_ns: int,
    allowed_bps: float,
    link: str,
) -> str:
    """The status line; ``allowed_bps`` is what the budget or the link allows now."""
    rate_bps = ledger.window_bytes(None, now_ns) * 8 * _SECOND_NS / ledger.window_ns
    sent = sum(ledger.outcomes("sent").values())
    return (
        f"{config.edge_id} {counts.duration_s(config.nominal_fps):6.1f} s  {bitrate_text(rate_bps)} of "
        f"{bitrate_text(allowed_bps)}  {config.method}  stills {sent}, {stills.pending} waiting  "
        f"tracks {stills.tracks}  {link}"
    )
