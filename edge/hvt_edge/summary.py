"""What an edge says of a run: the JSON for programs, the table for people."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failure
from hvt_common.units import bitrate_text
from hvt_edge.backlog.worker import StoreNumbers
from hvt_edge.loop.cpu import Cores

__all__ = ["summary", "table", "title"]


_RATES = (
    *("base_bytes", "roi_bytes", "backlog_bytes", "meta_bytes", "overhead_bytes"),
    *("total_bps", "base_bps", "roi_bps"),
)


def summary(
    ledger: Ledger,
    *,
    duration_s: float,
    cores: Cores,
    store: StoreNumbers | None,
    failed: tuple[Failure, ...],
    **facts: str | float,
) -> dict[str, Any]:
    """The JSON summary; rates count every byte on the line: payload, attachments, transport overhead.

    ``duration_s`` is from the first frame sent to the last, by their capture; ``cores`` of the times in which frames
    were left out for want of time. ``facts`` are numbers that the ledger does not hold, as they are.
    """
    account = ledger.summary(duration_s)
    reasons = {outcome: account.outcomes[outcome] for outcome in ("sent", "deferred", "dropped")}
    stills: dict[str, Any] = {outcome: sum(counts.values()) for outcome, counts in reasons.items()}
    on_roi = stills["sent"] - account.outcomes["sent"].get("stored", 0)
    stills["reasons"] = reasons
    stills["mean_bytes"] = round(account.roi_bytes / on_roi) if on_roi else 0
    stills["per_minute"] = round(60 * stills["sent"] / duration_s, 2) if duration_s else 0.0
    return {
        **{name: round(fact, 2) if isinstance(fact, float) else fact for name, fact in facts.items()},
        "duration_s": round(duration_s, 3),
        **{name: getattr(account, name) for name in _RATES},
        "replies": ledger.replies,
        "reply_bytes": ledger.reply_bytes,
        "worst_window_bps": asdict(account.worst_window_bps),
        "stills": stills,
        "cores_needed": round(cores.needed, 2),
        "cores_free": round(cores.free, 2),
        "store": None if store is None else asdict(store),
        "failed": [asdict(one) | {"failed_at": _clock_time(one.failed_ns)} for one in failed],
    }


def title(content: dict[str, Any]) -> str:
    """Of the table: it counts what would have been sent where nobody took it."""
    sent = f"NOT SENT ({content['unreached']})" if content["unreached"] else "sent"
    return f"{content['edge']}: {sent}"


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value."""
    stills, worst = content["stills"], content["worst_window_bps"]
    total = content["total_bps"]
    share = f"{total / content['budget_bps']:.0%} of {bitrate_text(content['budget_bps'])}"
    sent = f"{stills['sent']}, {stills['per_minute']:.0f} a minute, {stills['mean_bytes']} bytes in the mean"
    rows = [
        (
            "method",
            f"auto, {content['method']}: {content['levers']}" if content["levers"] else content["method"],
        ),
        ("frames", f"{content['frames']} in {content['duration_s']:.1f} s"),
        *_left_out(content),
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


def _left_out(content: dict[str, Any]) -> list[tuple[str, str]]:
    """Why frames were not coded or not analyzed."""
    captured, cpu, skipped = (content[f"frames_{name}"] for name in ("captured", "dropped_cpu", "unanalyzed"))
    needed, free = content["cores_needed"], content["cores_free"]
    cores = f": encoder and detector need {needed:.1f} cores, {free:.1f} were free" if needed else ""
    rows = []
    if link := content["frames_dropped"] - cpu:
        rows.append(("", f"{link} of {captured} frames dropped: the link had no room"))
    if cpu:
        rows.append(("", f"{cpu} of {captured} frames dropped{cores}"))
    if longer := content["clip_paused_s"]:
        rows.append(("", f"the clip took {longer:.0f} s longer than it is: this machine is too slow for it"))
    if skipped:
        rows.append(("", f"{skipped} of {captured} frames not analyzed{'' if cpu else cores}"))
    return rows


def _store_rows(store: dict[str, Any] | None) -> list[tuple[str, str]]:
    """What the store did, where it did anything."""
    if store is None or not any(store.values()):
        return []
    sent = f"{store['sent_stills']} stills and {store['sent_video_s']:.0f} s of video sent afterwards"
    left = f"{store['stills']} stills and {store['video_s']:.0f} s are still kept"
    lost = store["unacknowledged_bytes"]
    on_its_way = f"; {lost} bytes that were sent had not arrived" if lost else ""
    return [("store", f"{sent}; {left}{on_its_way}")]


def _reasons(counts: dict[str, int]) -> str:
    if not counts:
        return ""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return " (" + ", ".join(f"{reason} {count}" for reason, count in ordered) + ")"
