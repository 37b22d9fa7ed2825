"""What an edge says of a run: the JSON for programs, the table for people."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failure
from hvt_common.units import bitrate_text
from hvt_edge.backlog.worker import StoreNumbers

__all__ = ["EdgeRun", "summary", "table"]


@dataclass(frozen=True, slots=True)
class EdgeRun:
    """The numbers of a run that the ledger does not hold."""

    edge: str
    session: str
    method: str
    frames: int
    """Encoded and sent."""
    frames_dropped: int
    """Given up before encoding because the link or the machine was behind."""
    duration_s: float
    """From the first frame sent to the last; frames dropped between them count."""
    budget_bps: int
    base_bps: int
    """The part of the budget for the base stream."""
    keyframes: int
    keyframe_requests: int
    tracks: int
    encode_ms: float
    """Mean."""
    perception_ms: float
    """Mean of decoding, detection and tracking over all frames."""
    unusable_messages: int
    frames_stored: int = 0
    """Encoded while the link was away, and not sent at once."""
    store: StoreNumbers | None = None
    """What was kept while the link was away; None where nothing ever is."""
    failed: tuple[Failure, ...] = ()


def summary(run: EdgeRun, ledger: Ledger) -> dict[str, Any]:
    """The JSON summary; rates count every byte on the line: payload, attachments, transport overhead."""
    account = ledger.summary(run.duration_s)
    stills: dict[str, Any] = {
        outcome: sum(account.outcomes[outcome].values()) for outcome in ("sent", "deferred", "dropped")
    }
    stills["reasons"] = {outcome: account.outcomes[outcome] for outcome in ("sent", "deferred", "dropped")}
    on_roi = stills["sent"] - account.outcomes["sent"].get("stored", 0)
    stills["mean_bytes"] = round(account.roi_bytes / on_roi) if on_roi else 0
    stills["per_minute"] = round(60 * stills["sent"] / run.duration_s, 2) if run.duration_s else 0.0
    return {
        "edge": run.edge,
        "session": run.session,
        "method": run.method,
        "frames": run.frames,
        "frames_stored": run.frames_stored,
        "frames_dropped": run.frames_dropped,
        "duration_s": round(run.duration_s, 3),
        "base_bytes": account.base_bytes,
        "roi_bytes": account.roi_bytes,
        "backlog_bytes": account.backlog_bytes,
        "meta_bytes": account.meta_bytes,
        "overhead_bytes": account.overhead_bytes,
        "total_bps": account.total_bps,
        "base_bps": account.base_bps,
        "roi_bps": account.roi_bps,
        "budget_bps": run.budget_bps,
        "budget_base_bps": run.base_bps,
        "worst_window_bps": {
            "base": account.worst_window_bps.base,
            "roi": account.worst_window_bps.roi,
            "total": account.worst_window_bps.total,
        },
        "stills": stills,
        "tracks": run.tracks,
        "keyframes": run.keyframes,
        "keyframe_requests": run.keyframe_requests,
        "encode_ms": round(run.encode_ms, 2),
        "perception_ms": round(run.perception_ms, 2),
        "unusable_messages": run.unusable_messages,
        "store": None if run.store is None else asdict(run.store),
        "failed": [asdict(one) | {"failed_at": _clock_time(one.failed_ns)} for one in run.failed],
    }


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value."""
    stills, worst = content["stills"], content["worst_window_bps"]
    total = content["total_bps"]
    share = f"{total / content['budget_bps']:.0%} of {bitrate_text(content['budget_bps'])}"
    dropped = f", {content['frames_dropped']} dropped before encoding" if content["frames_dropped"] else ""
    sent = f"{stills['sent']}, {stills['per_minute']:.0f} a minute, {stills['mean_bytes']} bytes in the mean"
    rows = [
        ("method", content["method"]),
        ("frames", f"{content['frames']} in {content['duration_s']:.1f} s{dropped}"),
        ("total", f"{bitrate_text(total)}, {share}; fullest window {bitrate_text(worst['total'])}"),
        ("base", f"{bitrate_text(content['base_bps'])}; fullest window {bitrate_text(worst['base'])}"),
        ("stills", f"{bitrate_text(content['roi_bps'])}; fullest window {bitrate_text(worst['roi'])}"),
        ("stills sent", f"{sent}{_reasons(stills['reasons']['sent'])}"),
        ("deferred", f"{stills['deferred']}{_reasons(stills['reasons']['deferred'])}"),
        ("dropped", f"{stills['dropped']}{_reasons(stills['reasons']['dropped'])}"),
        ("tracks", str(content["tracks"])),
        ("keyframes", f"{content['keyframes']}, {content['keyframe_requests']} asked for by a ground"),
    ]
    return rows + _store_rows(content["store"]) + [("failed", _failure(one)) for one in content["failed"]]


def _clock_time(at_ns: int) -> str:
    return datetime.fromtimestamp(at_ns / 1e9, UTC).isoformat(timespec="seconds")


def _failure(one: dict[str, Any]) -> str:
    times = "" if one["count"] == 1 else f", {one['count']} times"
    again = "; works again" if one["working"] else ""
    return f"{one['part']} at {one['failed_at']}{times}: {one['reason']}{again}"


def _store_rows(store: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What the store did, where it did anything."""
    if store is None or not any(store.values()):
        return []
    sent = f"{store['sent_stills']} stills and {store['sent_video_s']:.0f} s of video sent afterwards"
    left = f"{store['stills']} stills and {store['video_s']:.0f} s are still kept"
    return [("store", f"{sent}; {left}")]


def _reasons(counts: dict[str, int]) -> str:
    if not counts:
        return ""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return " (" + ", ".join(f"{reason} {count}" for reason, count in ordered) + ")"
