"""What a ground says of its sessions: the JSON for programs, the table and the status line for people."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hvt_common.runtime.failures import Failure, Failures
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import GroundSession

__all__ = ["completed", "status_text", "summary", "table"]


def status_text(edges: Iterable[tuple[str, EdgeSessions]], *, failures: Failures | None = None) -> str:
    """The status line: what comes of each edge now, and which models fail; empty without any."""
    parts = []
    for edge, sessions in edges:
        session = sessions.session
        if session is None:
            state = "ended" if sessions.ended else "waiting for a keyframe"
            parts.append("  ".join([f"{edge}: {state}", *failed_texts(sessions.failures)]))
            continue
        latency_ms = session.overlay_latency.percentile(50)
        age = "" if latency_ms is None or session.lockstep else f"  {latency_ms:.0f} ms"
        total = session.ledger.summary(session.duration_s).total_bps
        parts.append(
            f"{edge}: {session.duration_s:.1f} s  {bitrate_text(total)} of "
            f"{bitrate_text(session.info.budget_bps)}  stills {session.stills_received}  tracks "
            f"{session.pipeline.tracks}, {session.pipeline.refined} refined{age}"
            + "".join(f"  {text}" for text in failed_texts(sessions.failures))
        )
    return " | ".join(parts + failed_texts(failures))


def summary(session: GroundSession) -> dict[str, Any]:
    """The JSON summary of a session that has ended; rates count every byte on the line, as the edge's do."""
    info, pipeline, counters = session.info, session.pipeline, session.counters
    account = session.ledger.summary(session.duration_s)
    worst = account.worst_window_bps
    unread = pipeline.outcomes.get("unread", 0)
    backlog = session.backlog.totals
    came = session.stills_received + backlog.stills
    deferred = came - sum(pipeline.outcomes.values()) - sum(session.stills_dropped.values())
    return {
        "edge": info.edge,
        "session": f"{info.session_id:016x}",
        "method": info.method,
        "pace": info.pace,
        "frames": session.frames_received,
        "frames_decoded": session.frames_decoded,
        "frames_untracked": session.frames_untracked,
        "duration_s": round(session.duration_s, 3),
        "base_bytes": account.base_bytes,
        "roi_bytes": account.roi_bytes,
        "backlog_bytes": account.backlog_bytes,
        "meta_bytes": account.meta_bytes,
        "overhead_bytes": account.overhead_bytes,
        "total_bps": account.total_bps,
        "base_bps": account.base_bps,
        "roi_bps": account.roi_bps,
        "budget_bps": info.budget_bps,
        "budget_base_bps": info.base_bps,
        "worst_window_bps": {"base": worst.base, "roi": worst.roi, "total": worst.total},
        "stills": {
            "received": session.stills_received,
            "deferred": deferred,
            "dropped": sum(session.stills_dropped.values()),
            "unread": unread,
            "reasons": {
                "received": account.outcomes["received"],
                "dropped": dict(session.stills_dropped),
                "outcomes": dict(pipeline.outcomes),
            },
            "mean_bytes": round(account.roi_bytes / session.stills_received)
            if session.stills_received
            else 0,
        },
        "backlog": {
            "stills": backlog.stills,
            "frames": backlog.frames,
            "frames_left_out": backlog.left_out,
            "video_s": round(backlog.video_s, 3),
        },
        "tracks": pipeline.tracks,
        "tracks_refined": pipeline.refined,
        "class_changes": pipeline.class_changes,
        "detections_run": pipeline.detections_run,
        "gaps": counters.gaps,
        "lost": counters.lost,
        "corrupt": counters.corrupt,
        "duplicates": counters.duplicates + counters.replayed,
        "keyframe_requests": counters.keyframe_requests,
        "latency_ms": session.overlay_latency.as_dict(),
        "receive_latency_ms": session.receive_latency.as_dict(),
        "recording": str(session.recording) if session.recording is not None else None,
        "recording_bytes": _size_bytes(session.recording),
        "failure": session.failure,
    }


def completed(
    content: dict[str, Any], sessions: EdgeSessions, *, failures: Failures | None = None
) -> dict[str, Any]:
    """The summary of a session, with what counts over all sessions of its edge, and the ground's own failures.

    Messages that were skipped, recordings of former sessions, of which a backlog came, and parts that failed.
    """
    failed = [*sessions.failures.parts, *(() if failures is None else failures.parts)]
    return content | {
        "unusable_messages": sessions.unusable,
        "backlog": content["backlog"] | {"recordings": [str(path) for path in sessions.backlog.paths]},
        "failed": [
            {
                "part": one.part,
                "reason": one.reason,
                "count": one.count,
                "last": _utc(one),
                "working": one.working,
            }
            for one in failed
        ],
    }


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value."""
    stills, worst, latency = content["stills"], content["worst_window_bps"], content["latency_ms"]
    share = (
        f"{content['total_bps'] / max(1, content['budget_bps']):.0%} of {bitrate_text(content['budget_bps'])}"
    )
    outcomes = ", ".join(f"{name} {count}" for name, count in sorted(stills["reasons"]["outcomes"].items()))
    lossless = (
        "no gaps" if not content["gaps"] else f"{content['gaps']} gaps, {content['lost']} messages lost"
    )
    rows = [
        ("session", f"{content['session']}, {content['method']}"),
        ("frames", f"{content['frames_decoded']} decoded in {content['duration_s']:.1f} s, {lossless}"),
        (
            "total",
            f"{bitrate_text(content['total_bps'])}, {share}; fullest window {bitrate_text(worst['total'])}",
        ),
        ("base", f"{bitrate_text(content['base_bps'])}; fullest window {bitrate_text(worst['base'])}"),
        (
            "stills",
            f"{stills['received']}, {bitrate_text(content['roi_bps'])}"
            + (f" ({outcomes})" if outcomes else ""),
        ),
        (
            "tracks",
            f"{content['tracks']}, {content['tracks_refined']} refined, {content['class_changes']} class changes",
        ),
        ("keyframes", f"{content['keyframe_requests']} asked for"),
    ]
    backlog = content["backlog"]
    if backlog["stills"] or backlog["frames"]:
        rows.append(
            ("outages", f"{backlog['stills']} stills and {backlog['video_s']:.1f} s of video came afterwards")
        )
    if content["failure"]:
        rows.append(("session failed", content["failure"]))
    for one in content.get("failed", ()):
        times = "" if one["count"] == 1 else f"{one['count']} times, last "
        rows.append(("failed", f"{one['part']}, {times}at {one['last']}: {one['reason']}"))
    rows += [("former session", path) for path in backlog.get("recordings", ())]
    if latency["p50"] is not None:
        since = "receiving" if content["pace"] == "lockstep" else "capture"
        spread = f"p50 {latency['p50']:.0f} ms, p95 {latency['p95']:.0f}, max {latency['max']:.0f}"
        rows.append(("latency", f"{since} to overlay: {spread}"))
    if content["recording"]:
        rows.append(("recording", f"{content['recording']}, {content['recording_bytes'] / 1e6:.2f} MB"))
    return rows


def failed_texts(failures: Failures | None) -> list[str]:
    """What does not work now, since when."""
    parts = () if failures is None else failures.parts
    return [f"{one.part} FAILED at {_utc(one)[11:19]} UTC" for one in parts if not one.working]


def _utc(failure: Failure) -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(failure.failed_ns // SECOND_NS))


def _size_bytes(path: Path | None) -> int:
    return path.stat().st_size if path is not None and path.exists() else 0
