"""A ground's report of its sessions: the JSON for programs, the table and the status line for people."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from hvt_common.protocol.edge_words import counts_text
from hvt_common.runtime.failures import FailedPart, Failures
from hvt_common.units import bitrate_text, utc_text
from hvt_ground.events import Event
from hvt_ground.report.state import EdgeState, GroundState
from hvt_ground.session.edge_sessions import EdgeSessions
from hvt_ground.session.session import Session
from hvt_ground.sinks import QueuedSink, Sink

_MOST_ENDED = 3
_LATE_S = 2.0
"""From this age on a picture is not that of now, as on the page."""


def status_text(state: GroundState) -> str:
    """The status line: the traffic of each edge now, and the failed parts; empty without any.

    Edges that have ended stand behind the others; more than a few are counted.
    """
    ended = [one for one in state.edges if one.link == "ended" and one.session is None and not one.failed]
    edges = [_edge_text(one) for one in state.edges if one not in ended]
    edges += map(_edge_text, ended) if len(ended) <= _MOST_ENDED else [f"{len(ended)} edges ended"]
    elsewhere = [f"{edge}: at {one.member}" for edge, one in state.elsewhere.items()]
    loading = ["detector loading"] * state.loading
    return " | ".join([*edges, *elsewhere, *loading, *state.behind, *map(failed_text, state.failed)])


def _edge_text(one: EdgeState) -> str:
    session = one.session
    if session is None:
        waits = "; ".join(part.reason for part in one.failed) or "waiting for a keyframe"
        said = f"{one.edge}: {'ended' if one.link == 'ended' else waits}"
    elif one.link == "lost":
        said = f"{one.edge}: {session.duration_s:.1f} s  LINK LOST for {one.silent_s:.0f} s"
    else:
        not_sent = session.stills_not_sent
        why = f" (not sent: {counts_text(not_sent, most=2)})" if not_sent else ""
        age = "" if session.delay_p50_ms is None else f"  {session.delay_p50_ms:.0f} ms"
        if age and session.picture_age_s is not None and session.picture_age_s > _LATE_S:
            age = f"  LATE, {session.picture_age_s:.0f} s old"
        if session.total_bps is not None:
            rate = f"{bitrate_text(round(session.total_bps))} of {bitrate_text(session.budget_bps)}"
        else:
            since = "" if session.picture_age_s is None else f" for {session.picture_age_s:.0f} s"
            rate = f"NO PICTURE{since}"
        said = (
            f"{one.edge}: {session.duration_s:.1f} s  {rate}{' (thin link)' if one.link == 'thin' else ''}  "
            f"stills {session.stills_received}{why}  "
            f"tracks {session.tracks}, {session.tracks_refined} refined{age}"
            f"{'  UNKNOWN VIEW' if session.view_unlike else ''}"
        )
    return "  ".join([said, *map(failed_text, one.failed)])


def summary(session: Session) -> dict[str, Any]:
    """The JSON summary of a session that has ended; rates count every byte on the line, as the edge's do."""
    info, perceived, reception = session.info, session.perceived, session.reception
    counters, account = reception.counters, reception.ledger.summary(reception.duration_s)
    status = session.reception.last_status
    unread = perceived.outcomes.get("unread", 0)
    backlog = session.backlog.totals
    return {
        "edge": info.edge,
        "session": f"{info.session_id:08x}",
        "method": reception.method,
        "pace": info.pace,
        "frames": reception.frames,
        "frames_decoded": session.frames_decoded,
        "frames_untracked": session.worker.untracked,
        "edge_frames": None if status is None or not status.frames else status.frame_account.as_dict(),
        "duration_s": round(reception.duration_s, 3),
        **account.as_dict(),
        "budget_bps": reception.highest_budget_bps,
        "stills": {
            "received": reception.stills,
            "dropped": sum(session.stills_dropped.values()),
            "unread": unread,
            "reasons": {
                "received": account.outcomes["received"],
                "dropped": dict(session.stills_dropped),
                "outcomes": dict(perceived.outcomes),
                "not_sent": dict(session.reception.not_sent),
            },
            "mean_bytes": round(account.roi_bytes / reception.stills) if reception.stills else 0,
        },
        "backlog": {
            "stills": backlog.stills,
            "frames": backlog.frames,
            "frames_left_out": backlog.left_out,
            "video_s": round(backlog.video_s, 3),
        },
        "tracks": perceived.tracks,
        "tracks_refined": perceived.refined,
        "class_changes": perceived.class_changes,
        "view_trust": None if perceived.view_trust is None else round(perceived.view_trust, 3),
        "view_unlike": perceived.view_unlike,
        "detections_run": perceived.detections_run,
        "gaps": counters.gaps,
        "lost": counters.lost,
        "resent": counters.resent,
        "corrupt": counters.corrupt,
        "duplicates": counters.duplicates + counters.replayed,
        "keyframe_requests": counters.keyframe_requests,
        "latency_ms": reception.overlay_latency.as_dict(),
        "receive_latency_ms": reception.receive_latency.as_dict(),
        "failure": session.failure,
        # Of these `completed` tells.
        "recording": None,
        "recordings": [],
        "recording_bytes": 0,
        "missing_events": {},
        "failed": [],
    }


def completed(
    content: dict[str, Any],
    sessions: EdgeSessions,
    *,
    sinks: Iterable[Sink[Event]] = (),
    failures: Failures | None = None,
) -> dict[str, Any]:
    """The summary of a session, with the counts over all sessions of its edge, and the ground's own failures.

    Messages that were skipped, recordings of former sessions, of which a backlog came, parts that failed; and, once
    they are closed, the results of the session's ``sinks``.
    """
    edge = content["edge"]
    general = () if failures is None else failures.parts
    failed = [*sessions.failures.parts, *(one for one in general if _concerns(one.part, edge))]
    queued = [sink for sink in sinks if isinstance(sink, QueuedSink)]
    files = dict.fromkeys(path for sink in queued for path in sink.files)  # a removed one may come again
    recordings = [path for path in files if path.suffix == ".rrd"]
    sizes = {path: path.stat().st_size for path in recordings if path.exists()}
    recordings = list(sizes) or recordings  # retention removes the oldest in flight
    return content | {
        "recording": str(recordings[0]) if recordings else None,
        "recordings": [str(path) for path in recordings],
        "recording_bytes": sum(sizes.values()) if sizes or not recordings else None,
        "missing_events": {sink.part: sink.missing for sink in queued if sink.missing},
        "unusable_messages": sessions.receiver.unusable,
        "backlog": content["backlog"] | {"recordings": [str(path) for path in sessions.backlog.paths]},
        "failed": [
            {
                "part": one.part,
                "reason": one.reason,
                "count": one.count,
                "since": utc_text(one.since_ns, milliseconds=False),
                "last": utc_text(one.failed_ns, milliseconds=False),
                "working": one.working,
            }
            for one in failed
        ],
    }


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value."""
    stills, worst, latency = content["stills"], content["worst_window_bps"], content["latency_ms"]
    budget_bps = content["budget_bps"]
    share = f"{content['total_bps'] / max(1, budget_bps):.0%} of {bitrate_text(budget_bps)}"
    outcomes, not_sent = (counts_text(stills["reasons"][which]) for which in ("outcomes", "not_sent"))
    gaps = content["gaps"]
    lossless = f"{gaps} gaps, {content['lost']} messages lost" if gaps else "no gaps"
    changes = content["class_changes"]
    tracks = (
        f"{content['tracks']}; stills met {content['tracks_refined']} of them and changed the ground's own class "
        f"{changes} time{'s' * (changes != 1)}"
    )
    if not (content["tracks"] or content["detections_run"]):
        tracks = "not known: the detector has looked at no picture"
    rows = [
        ("session", f"{content['session']}, {content['method']}"),
        ("frames", f"{content['frames_decoded']} decoded in {content['duration_s']:.1f} s, {lossless}"),
        *([("", f"at the edge {content['edge_frames']['text']}")] if content["edge_frames"] else []),
        (
            "total",
            f"{bitrate_text(content['total_bps'])}, {share}; fullest window {bitrate_text(worst['total'])}",
        ),
        ("base", f"{bitrate_text(content['base_bps'])}; fullest window {bitrate_text(worst['base'])}"),
        (
            "stills",
            f"{stills['received']}, {bitrate_text(content['roi_bps'])}"
            + (f" (of the objects in them: {outcomes})" if outcomes else "")
            + (f"; the edge did not send: {not_sent}" if not_sent else ""),
        ),
        ("tracks", tracks),
        ("keyframes", f"{content['keyframe_requests']} requested"),
    ]
    if content["view_unlike"]:
        rows.append(("view", f"unlike what the detector knows (trust {content['view_trust']:.2f})"))
    backlog = content["backlog"]
    if backlog["stills"] or backlog["frames"]:
        rows.append(
            ("outages", f"{backlog['stills']} stills and {backlog['video_s']:.1f} s of video came afterwards")
        )
    if content["failure"]:
        rows.append(("session failed", content["failure"]))
    rows += [("former session", path) for path in backlog.get("recordings", ())]
    if latency["p50"] is not None:
        since = "receiving" if content["pace"] == "lockstep" else "capture"
        spread = f"p50 {latency['p50']:.0f} ms, p95 {latency['p95']:.0f}, max {latency['max']:.0f}"
        rows.append(("latency", f"{since} to overlay: {spread}"))
    if content["recordings"]:
        files = ", ".join(content["recordings"])
        size_bytes = content["recording_bytes"]
        size = "not there any more" if size_bytes is None else f"{size_bytes / 1e6:.2f} MB"
        rows.append(("recording", f"{files}, {size}"))
    for one in content["failed"]:
        ends = "works again" if one["working"] else "did not work again"
        count = "once" if one["count"] == 1 else f"{one['count']} times"
        rows.append(("failed", f"{one['part']}, {count}, at {one['since']}: {one['reason']}; {ends}"))
    rows += [("missing", f"{count} events in {part}") for part, count in content["missing_events"].items()]
    return rows


def failed_text(one: FailedPart) -> str:
    """The failed parts, and since when."""
    return f"{one.part} FAILED at {utc_text(one.since_ns)[11:19] or '?'} UTC"


def _concerns(part: str, edge: str) -> bool:
    # Whether a part is this edge's, or nobody's: ``recording of uav-1``, ``timing table``.
    _, of, whose = part.rpartition(" of ")
    return not of or whose == edge
