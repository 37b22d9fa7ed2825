"""The edge's own reports: `Info` on request, `Status` once a second, a line on the terminal, a summary at the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from hvt_common import __version__
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.edge_words import counts_text
from hvt_common.protocol.ledger import StillOutcome
from hvt_common.protocol.messages import (
    BASE_CODEC,
    MOST_FAILED_PARTS,
    FailedPart,
    Health,
    Info,
    Status,
    fitted_text,
)
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import View
from hvt_edge.config import EdgeConfig
from hvt_edge.operating import AutoDecisions, Operating
from hvt_edge.report.state import EdgeState, Heartbeat, LinkState

_PART_BYTES, _REASON_BYTES, _DECISIONS_BYTES = 24, 160, 120
_MOST_MS, _MOST_AGE_MS, _MOST_CORES = 60_000.0, 2**32 - 1, 4096.0
"""The largest numbers that a report can hold."""
_DECISIONS_REST = 10
_REPORTED: tuple[StillOutcome, ...] = ("sent", "deferred", "dropped")
_LATE_NS = 2 * SECOND_NS
"""A report that has waited this long for room beside video goes before the next frame: grounds need it too."""


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
    clock: Callable[[], int]

    def info(self, received_ns: int | None = None) -> bytes:
        """The session's facts for a ground; times are by the clock of the headers."""
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


class StatusReporter:
    """Sends ``status``, from the heartbeat's state and its parts; in the frame loop."""

    def __init__(self, heartbeat: Heartbeat) -> None:
        self._of = heartbeat
        self._sequence = 0
        self._pending: tuple[EdgeState, str] | None = None
        """The report of the newest second, not sent yet."""
        self._due_ns: int | None = None
        """The time since which a report waits."""
        self._reported: AutoDecisions | None = None
        self._reported_sequence = 0

    def send(self, phase: Literal["running", "ended"]) -> None:
        """Make the report of this second, and send it as soon as it leaves video its room; the last one waits."""
        state = self._of.beat(phase)
        # Made once: the transmitter packs a report twice, first for its size.
        self._pending = (state, self._decisions_text(state.decisions))
        self._due_ns = self._of.loop_clock() if self._due_ns is None else self._due_ns
        self.send_pending(last=phase == "ended")

    def send_pending(self, *, last: bool = False) -> None:
        """Called before each frame: a report that found no room is tried again."""
        if self._pending is None:
            return
        (state, decisions), now_ns = self._pending, self._of.loop_clock()
        late = self._due_ns is not None and now_ns - self._due_ns >= _LATE_NS
        if self._of.transmitter.metadata(
            Channel.STATUS,
            lambda at_ns: self._status(state, decisions, at_ns).pack(),
            now_ns=now_ns,
            before_frames=late,
            last=last,
        ):
            self._pending = self._due_ns = None
            self._sequence += 1

    def _decisions_text(self, decisions: AutoDecisions) -> str:
        # Sent after a change of a decision, and now and then: on a thin link a sentence a second is not free.
        sent = self._reported
        moved = sent is None or (decisions.tracks, decisions.stills) != (sent.tracks, sent.stills)
        if not decisions.says or (not moved and self._sequence - self._reported_sequence < _DECISIONS_REST):
            return ""
        self._reported, self._reported_sequence = decisions, self._sequence
        return fitted_text(decisions.says, _DECISIONS_BYTES)

    def _status(self, state: EdgeState, decisions: str, at_ns: int) -> Status:
        # In lockstep no field depends on this machine's speed: the same input gives the same bytes.
        account = self._of.ledger.summary(state.duration_s)
        worst, frames, transmitter = account.worst_window_bps, state.frames, self._of.transmitter
        measured, reported_s = not state.lockstep, state.link.reported_s
        totals: dict[str, Any] = {
            **{name: size for name, size in account.as_dict().items() if name.endswith("_bytes")},
            **{f"{name}_messages": count for name, count in account.messages.items()},
            **{outcome: account.outcomes[outcome] for outcome in _REPORTED},
        }
        return Status(
            session_id=self._of.session_id,
            sequence=self._sequence,
            state=state.state,
            send_ns=at_ns,
            media_ns=max(0, at_ns - self._of.operating.now.started_ns),
            last_base_sequence=transmitter.base_sequence,
            last_still_sequence=transmitter.still_sequence,
            **totals,
            worst_window_bps=(worst.base, worst.roi, worst.total),
            health=Health(
                frames_captured=frames.account.came,
                frames_encoded=frames.encoded,
                frames_dropped=frames.account.dropped,
                keyframes=state.keyframes,
                tracks=state.tracks,
                base_queue=0,  # the base stream has no queue: frames are dropped before they are encoded
                still_queue=state.stills_pending,
                encode_ms=min(state.encode_ms or 0.0, _MOST_MS) if measured else 0.0,
                detect_ms=min(state.perception_ms or 0.0, _MOST_MS) if measured else 0.0,
                feedback_age_ms=min(round(1000 * reported_s), _MOST_AGE_MS)
                if measured and reported_s is not None
                else -1,
                frames_dropped_cpu=frames.account.groups.get("processor", 0),
                frames_unanalyzed=frames.unanalyzed,
                cores_needed=min(state.cores_needed or 0.0, _MOST_CORES) if measured else 0.0,
                cores_free=(state.cores_free or 0.0) if measured else 0.0,
            ),
            failed=tuple(
                FailedPart(
                    part=fitted_text(one.part, _PART_BYTES),
                    reason=fitted_text(one.reason, _REASON_BYTES),
                    failures=one.count,
                    failed_ns=one.failed_ns,
                    working=one.working,
                )
                for one in self._of.failures.parts[:MOST_FAILED_PARTS]
            ),
            decisions=decisions,
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
    if state.decisions.says:
        parts.append(state.decisions.says)
    if state.detection_slow:
        parts.append(f"boxes {state.boxes_age_s:.1f} s behind: detection is too slow")
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


def summary(of: Heartbeat, *, unreached: str) -> dict[str, Any]:
    """The JSON summary; rates count every byte on the line: payload, attachments, transport overhead.

    ``unreached`` is the reason why no program received its video; empty where one did.
    """
    config, counts, now, ledger, frames = of.config, of.counts, of.operating.now, of.ledger, of.frames
    keyframes, analyzer, cores = of.stills.keyframes, of.stills.analyzer, counts.cpu.short
    duration_s = counts.duration_s(config.nominal_fps)
    account = ledger.summary(duration_s)
    reasons = {outcome: account.outcomes[outcome] for outcome in _REPORTED}
    stills: dict[str, Any] = {outcome: sum(by.values()) for outcome, by in reasons.items()}
    on_roi = stills["sent"] - account.outcomes["sent"].get("stored", 0)
    stills["reasons"] = reasons
    stills["mean_bytes"] = round(account.roi_bytes / on_roi) if on_roi else 0
    stills["per_minute"] = round(60 * stills["sent"] / duration_s, 2) if duration_s else 0.0
    return {
        "edge": config.edge_id,
        "session": f"{of.session_id:08x}",
        "method": now.method,
        "decisions": now.decisions.says,
        "preset": now.preset,
        "preset_says": now.preset_says,
        "clip_paused_s": round(counts.slow_ns / SECOND_NS, 2),
        "budget_bps": now.highest_budget_bps,
        "budget_base_bps": now.base_bps,
        "keyframes": keyframes.sent,
        "keyframe_requests": keyframes.served,
        "tracks": analyzer.tracks,
        "encode_ms": round(counts.encode_ms, 2),
        "perception_ms": round(analyzer.mean_ms, 2),
        "unusable_messages": of.link.unusable,
        "unreached": unreached,
        "duration_s": round(duration_s, 3),
        "frames": frames.groups.get("sent", 0) + frames.groups.get("nobody_listened", 0),
        "frames_stored": frames.groups.get("stored", 0),
        "frames_captured": frames.came,
        "frames_dropped": frames.dropped,
        "frames_dropped_cpu": frames.groups.get("processor", 0),
        "frames_unanalyzed": counts.unanalyzed,
        "frame_account": frames.as_dict(),
        **account.as_dict(),
        "replies": ledger.replies,
        "reply_bytes": ledger.reply_bytes,
        "stills": stills,
        "cores_needed": round(cores.needed, 2),
        "cores_free": round(cores.free, 2),
        "store": None if of.backlog is None else asdict(of.backlog.worker.numbers),
        "failed": [asdict(one) | {"failed_at": _clock_time(one.failed_ns)} for one in of.failures.parts],
    }


def in_vain(content: dict[str, Any]) -> bool:
    """Whether pictures were made of which none was received, and none is stored for later."""
    return bool(content["unreached"] and content["frames"] and not content["frames_stored"])


def title(content: dict[str, Any]) -> str:
    edge, why = content["edge"], content["unreached"]
    if in_vain(content):
        return f"{edge}: NOT SENT ({why}): 0 bytes received"
    if why and not content["frames_stored"]:
        return f"{edge}: NOT SENT ({why}): it ended before its first picture"
    return f"{edge}: stored for later ({why})" if why else f"{edge}: sent"


def table(content: dict[str, Any]) -> list[tuple[str, str]]:
    """The same as rows of name and value; a flight that was not received has fewer rows."""
    stills, worst = content["stills"], content["worst_window_bps"]
    total = content["total_bps"]
    share = f"{total / content['budget_bps']:.0%} of {bitrate_text(content['budget_bps'])}"
    sent = f"{stills['sent']}, {stills['per_minute']:.0f} a minute, {stills['mean_bytes']} bytes in the mean"
    rows = [
        (
            "method",
            f"auto, {content['method']}: {content['decisions']}"
            if content["decisions"]
            else content["method"],
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
