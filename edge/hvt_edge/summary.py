"""An edge's report of a run: the JSON for programs, the table for people."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from hvt_common.protocol.frame_account import FrameAccount
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.still_words import counts_text
from hvt_common.runtime.failures import Failure
from hvt_common.units import bitrate_text
from hvt_edge.backlog.worker import StoreNumbers
from hvt_edge.loop.cpu import Cores

_RATES = (
    *("base_bytes", "roi_bytes", "backlog_bytes", "meta_bytes", "overhead_bytes"),
    *("total_bps", "base_bps", "roi_bps"),
)


def summary(
    ledger: Ledger,
    *,
    duration_s: float,
    frames: FrameAccount,
    unanalyzed: int,
    cores: Cores,
    store: StoreNumbers | None,
    failed: tuple[Failure, ...],
    **facts: str | float,
) -> dict[str, Any]:
    """The JSON summary; rates count every byte on the line: payload, attachments, transport overhead.

    ``duration_s`` is from the first frame sent to the last, by their capture; ``frames`` says what became of each;
    perception skipped ``unanalyzed`` of those that came to it; ``cores`` are of the times in which frames were left
    out for want of time. ``facts`` are numbers that the ledger does not hold, as they are.
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
        "frames": frames.groups.get("sent", 0) + frames.groups.get("nobody_listened", 0),
        "frames_stored": frames.groups.get("stored", 0),
        "frames_captured": frames.came,
        "frames_dropped": frames.dropped,
        "frames_dropped_cpu": frames.groups.get("processor", 0),
        "frames_unanalyzed": unanalyzed,
        "frame_account": frames.as_dict(),
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


def in_vain(content: dict[str, Any]) -> bool:
    """Whether pictures were made of which nobody received one, and none is stored for later."""
    return bool(content["unreached"] and content["frames"] and not content["frames_stored"])


def title(content: dict[str, Any]) -> str:
    """Of the table."""
    edge, why = content["edge"], content["unreached"]
    if in_vain(content):
        return f"{edge}: NOT SENT ({why}): 0 bytes received"
    if why and not content["frames_stored"]:
        return f"{edge}: NOT SENT ({why}): it ended before its first picture"
    return f"{edge}: stored for later ({why})" if why else f"{edge}: sent"


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value; a flight that nobody received has fewer rows."""
    stills, worst = content["stills"], content["worst_window_bps"]
    total = content["total_bps"]
    share = f"{total / content['budget_bps']:.0%} of {bitrate_text(content['budget_bps'])}"
    sent = f"{stills['sent']}, {stills['per_minute']:.0f} a minute, {stills['mean_bytes']} bytes in the mean"
    rows = [
        (
            "method",
            f"auto, {content['method']}: {content['levers']}" if content["levers"] else content["method"],
        ),
        ("frames", f"{content['frame_account']['text']}; {content['duration_s']:.1f} s"),
        *([("", content["preset_says"])] if content["preset_says"] else []),
        *_too_slow(content),
    ]
    failed = [("failed", _failure(one)) for one in content["failed"]]
    if in_vain(content):
        return [
            *rows,
            ("total", f"0 bytes received; {bitrate_text(total)} would have been, {share}"),
            *failed,
        ]
    rows += [
        ("total", f"{bitrate_text(total)}, {share}; fullest window {bitrate_text(worst['total'])}"),
        ("base", f"{bitrate_text(content['base_bps'])}; fullest window {bitrate_text(worst['base'])}"),
        ("stills", f"{bitrate_text(content['roi_bps'])}; fullest window {bitrate_text(worst['roi'])}"),
        ("stills sent", f"{sent}{_reasons(stills['reasons']['sent'])}"),
        ("not sent yet", f"{stills['deferred']}{_reasons(stills['reasons']['deferred'])}"),
        ("not sent", f"{stills['dropped']}{_reasons(stills['reasons']['dropped'])}"),
        ("tracks", str(content["tracks"])),
        ("keyframes", f"{content['keyframes']}, {content['keyframe_requests']} requested by a ground"),
    ]
    return rows + _store_rows(content["store"]) + failed


def _clock_time(at_ns: int) -> str:
    return datetime.fromtimestamp(at_ns / 1e9, UTC).isoformat(timespec="seconds")


def _failure(one: dict[str, Any]) -> str:
    times = "" if one["count"] == 1 else f", {one['count']} times"
    again = "; works again" if one["working"] else ""
    return f"{one['part']} at {one['failed_at']}{times}: {one['reason']}{again}"


def _too_slow(content: dict[str, Any]) -> list[tuple[str, str]]:
    rows = []
    if skipped := content["frames_unanalyzed"]:
        rows.append(("", f"{skipped} of {content['frames_captured']} frames not analyzed"))
    if longer := content["clip_paused_s"]:
        rows.append(("", f"the clip took {longer:.0f} s longer than it is: this machine is too slow for it"))
    needed, free = content["cores_needed"], content["cores_free"]
    if needed and (skipped or content["frames_dropped_cpu"]):
        rows.append(("", f"encoder and detector need {needed:.1f} cores, {free:.1f} were free"))
    return rows


def _store_rows(store: dict[str, Any] | None) -> list[tuple[str, str]]:
    if store is None or not any(store.values()):
        return []
    sent = f"{store['sent_stills']} stills and {store['sent_video_s']:.0f} s of video sent afterwards"
    left = f"{store['stills']} stills and {store['video_s']:.0f} s are still kept"
    lost = store["unacknowledged_bytes"]
    on_its_way = f"; {lost} bytes that were sent had not arrived" if lost else ""
    return [("store", f"{sent}; {left}{on_its_way}")]


def _reasons(counts: dict[str, int]) -> str:
    return f" ({counts_text(counts)})" if counts else ""
