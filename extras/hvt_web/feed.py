"""From events of a session to messages for browsers: a sink of the ground, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.edge_words import counts_text, decision_sentences, part_words, still_words
from hvt_common.protocol.messages import Info
from hvt_common.runtime.failures import FailedPart
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_ground.events import Event, MessageTiming, Notice, Overlay, Refinement, VideoSample
from hvt_ground.report.state import EdgeState, GroundState, SessionState
from hvt_ground.sinks import SinkWriter
from hvt_ground.sinks.palette import class_colour
from hvt_web.video.pictures import Made, Pictures, jpeg
from hvt_web.viewers import EdgePage, Hub, text

_LATE_NS = 300_000_000
"""So far behind the link, pictures are decoded and not coded again until it has caught up."""
_TOO_LATE_NS = 3_000_000_000
"""So far behind, pictures up to the next keyframe are skipped."""
_REQUEST_EVERY_NS = 2_000_000_000
_SHOWN_BY_BROWSERS = ("image/jpeg", "image/png", "image/webp")
_MILLION = 1_000_000


class SessionFeed(SinkWriter[Event]):
    """Writes one session of an edge to the page of it. ``clock`` is the ground's, Unix nanoseconds."""

    def __init__(self, info: Info, page: EdgePage, hub: Hub, *, clock: Callable[[], int]) -> None:
        self._info = info
        self._page = page
        self._hub = hub
        self._clock = clock
        self._pictures = Pictures(info)
        self._offset_ns: int | None = None
        self._late_ns = self._requested_ns = 0
        session = {
            "edge": info.edge,
            "session": f"{info.session_id:08x}",
            "baseSize": info.base_size,
            "fps": info.fps,
            "method": info.method,
            "pace": info.pace,
            "budget": info.budget_bps,
        }
        page.last = self._last
        hub.post(partial(hub.begin, page, session))

    def log(self, item: Event) -> None:
        match item:
            case VideoSample(stored=False):
                self._video(item)
            case MessageTiming(kind=Channel.BASE):
                self._offset_ns = item.clock_offset_ns
                self._late_ns = self._clock() - item.received_ns
            case Overlay(stored=False):
                self._hub.post(partial(self._hub.overlay, self._page, self._overlay(item)))
            case Refinement():
                self._still(item)
            case Notice():
                message = self._text(
                    "notice", item, level=item.level, text=item.text, at=self._clock() / SECOND_NS
                )
                self._hub.post(partial(self._hub.notice, self._page, message))

    def skipped(self, count: int) -> None:  # noqa: ARG002 - one is as bad as many
        """Pictures may be missing."""
        self._pictures.gap()

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - nothing takes long
        """The last picture stays at hand."""
        self._pictures.close()

    def _video(self, sample: VideoSample) -> None:
        now_ns, wanted = self._clock(), self._page.wanted
        if self._late_ns > _TOO_LATE_NS and not sample.keyframe:
            self._pictures.gap()
            self._want_keyframe(bool(wanted), now_ns)
            return
        self._page.newest = sample.frame_index
        made = self._pictures.add(sample, wanted=wanted, now_ns=now_ns, hurry=self._late_ns > _LATE_NS)
        self._give(sample, made)
        self._want_keyframe(self._pictures.waits, now_ns)

    def _last(self) -> None:
        for sample, made in self._pictures.last():
            self._give(sample, made)

    def _give(self, sample: VideoSample, made: Iterable[Made]) -> None:
        captured_ms = self._captured_ms(sample.capture_ns)
        for one in made:
            give = partial(self._hub.made, self._page, one)
            self._hub.post(partial(give, frame_index=sample.frame_index, captured_ms=captured_ms))

    def _want_keyframe(self, waits: bool, now_ns: int) -> None:  # noqa: FBT001 - two callers
        # An edge may make none by itself (--keyframe-interval 0).
        if waits and now_ns - self._requested_ns >= _REQUEST_EVERY_NS and self._info.pace != "lockstep":
            self.awaits_keyframe, self._requested_ns = True, now_ns

    def _captured_ms(self, capture_ns: int) -> float:
        # Capture time by the ground's clock. In lockstep capture is media time: there, and before the first is
        # counted, the picture is from now.
        if self._info.pace == "lockstep" or self._offset_ns is None:
            return self._clock() / _MILLION
        return (capture_ns - self._offset_ns) / _MILLION

    def _text(self, kind: str, item: Overlay | Refinement | Notice, **content: Any) -> str:
        frame, capture_ns = item.frame_index, item.capture_ns
        if isinstance(item, Refinement):  # it was known later
            frame, capture_ns = item.shown_at
        captured_ms = round(self._captured_ms(capture_ns), 1)
        return text(kind, edge=self._info.edge, frame=frame, captured=captured_ms, **content)

    def _overlay(self, item: Overlay) -> str:
        rows = zip(
            item.track_ids.tolist(),
            item.boxes_base_px.round(1).tolist(),
            item.words,
            item.confidences.tolist(),
            item.refined.tolist(),
            item.doubted.tolist(),
            item.sure.tolist(),
            strict=True,
        )
        tracks = [
            {"id": track, "box": box, "name": name, "sureness": round(sureness, 2)}
            | {word: 1 for word, holds in (("read", read), ("doubted", doubt), ("sure", known)) if holds}
            for track, box, name, sureness, read, doubt, known in rows
        ]
        colours = {name: "#{:02x}{:02x}{:02x}".format(*class_colour(name)) for name in set(item.words)}
        looked_ns = item.capture_ns if item.looked_ns is None else item.looked_ns
        looked_ms = round(self._captured_ms(looked_ns), 1)
        return self._text("overlay", item, looked=looked_ms, tracks=tracks, colours=colours)

    def _still(self, item: Refinement) -> None:
        still = still_name(self._info, item)
        pictures: list[tuple[str, str, bytes, str]] = []
        if item.media_type in _SHOWN_BY_BROWSERS:
            pictures.append((still, "still", item.still, item.media_type))
        elif item.still_bgr is not None:
            pictures.append((still, "still", jpeg(item.still_bgr, quality_pct=90), "image/jpeg"))
        if item.base_crop_bgr is not None and item.base_crop_bgr.size:
            pictures.append((still, "base", jpeg(item.base_crop_bgr), "image/jpeg"))
        message = self._text(
            "still",
            item,
            id=still,
            shows=[which for _, which, _, _ in pictures],
            track=item.track_id,
            box=[round(value, 1) for value in item.box_base_px],
            crop=None if item.crop_base_px is None else [round(value, 1) for value in item.crop_base_px],
            before=item.words[0],
            after=item.words[1],
            sureness=round(item.confidence, 2),
            reason=item.reason,
            why=still_words(item.reason),
            stored=item.stored,
            unread=item.unread,
            doubted=item.doubted,
            note=item.note,
        )
        self._hub.post(partial(self._hub.still, self._page, message, pictures))


def still_name(info: Info, still: Refinement) -> str:
    """The name of a still's pictures in addresses: a still of several objects has one."""
    return f"{info.session_id & 0xFFFFFF:06x}-{still.still_sequence}"


_UNKNOWN = ("total", "base", "budget", "method", "recording")
_NO_SESSION: dict[str, Any] = {**dict.fromkeys(_UNKNOWN), "short": "", "why": [], "words": []}


def state_message(state: GroundState) -> str:
    """The state of all edges, for the wall and the plot; the words that an operator reads are made here."""
    edges = {one.edge: _edge(one, state) for one in state.edges}
    elsewhere = {edge: {"member": one.member, "page": one.page} for edge, one in state.elsewhere.items()}
    failed = [*state.behind, *(_failure(part.part, part, state.at_ns) for part in state.failed)]
    return text("state", at=state.at_ns // _MILLION, edges=edges, elsewhere=elsewhere, failed=failed)


def _edge(one: EdgeState, state: GroundState) -> dict[str, Any]:
    session, failed = one.session, [_failure(part.part, part, state.at_ns) for part in one.failed]
    said = {"link": one.link, "since": one.link_since_ns // _MILLION, "failed": failed}
    if session is None:
        return said | _NO_SESSION
    at_edge = [(part, _failure(part_words(part.part), part, state.at_ns)) for part in session.edge_failed]
    failed += [f"at the edge: {words}" for _, words in at_edge]
    short = [words for part, words in at_edge if part.part == "source"]
    if session.total_bps is not None:
        thin = "link or machine too slow, " if one.link == "thin" else ""
        short.append(f"{thin}{bitrate_text(session.total_bps)} of {bitrate_text(session.budget_bps)}")
    unrecorded = {part.part for part in state.failed} & {f"recording of {one.edge}", "recording"}
    loading = ["the detector is loading: boxes of this ground come then"] * state.loading
    return said | {
        "total": session.total_bps,
        "base": session.base_bps,
        "budget": session.budget_bps,
        "method": session.method,
        "short": ", ".join(short),
        "recording": state.recorded and not unrecorded,
        "why": _why(session),
        "words": loading + _words(session, calibrated=state.calibrated),
    }


def state_loads(state: GroundState) -> dict[str, tuple[float, float, float, float]]:
    """By edge, if known: Unix milliseconds, and bits a second: all, the base stream, the budget."""
    return {
        one.edge: (
            state.at_ns // _MILLION,
            one.session.total_bps,
            one.session.base_bps,
            one.session.budget_bps,
        )
        for one in state.edges
        if one.session is not None and one.session.total_bps is not None and one.session.base_bps is not None
    }


def _words(session: SessionState, *, calibrated: bool) -> list[str]:
    # The session in a few sentences; unknown facts are left out.
    words = []
    if session.total_bps is not None:
        words.append(f"{bitrate_text(session.total_bps)} of {bitrate_text(session.budget_bps)}")
    if session.delay_p50_ms is not None and session.delay_p95_ms is not None:
        words.append(
            f"capture to boxes {session.delay_p50_ms:.0f} ms, at most {session.delay_p95_ms:.0f} ms for 95 %"
        )
    words.append(_some(session.stills_received, "still"))
    trust = "" if calibrated else "; the probability of a class is not calibrated"
    words.append(
        f"{_some(session.tracks, 'track')} so far, {session.tracks_refined} refined by stills{trust}"
    )
    if session.view_unlike:
        words.append("this view is unlike what the detector knows: its boxes are thin and unnamed")
    if session.gaps:
        words.append(f"{_some(session.gaps, 'gap')}, {_some(session.lost, 'message')} lost")
    if session.backlog_stills or session.backlog_video_s:
        words.append(
            f"from outages {_some(session.backlog_stills, 'still')}, {session.backlog_video_s:.0f} s of video"
        )
    return words


def _some(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"


def _why(session: SessionState) -> list[str]:
    why = [] if session.edge_frames is None else [f"At the edge {session.edge_frames}."]
    if session.stills_not_sent:
        why.append(f"Not sent as stills: {counts_text(session.stills_not_sent)}.")
    if session.still_outcomes:
        why.append(f"Of the objects in stills: {counts_text(session.still_outcomes)}.")
    return why + decision_sentences(session.decisions)


def _failure(name: str, part: FailedPart, at_ns: int) -> str:
    # Without the reason: it may name files of this machine.
    return f"{name} has not worked for {_lasting((at_ns - part.since_ns) // SECOND_NS)}"


def _lasting(seconds: int) -> str:
    if seconds < 100:
        return f"{max(0, seconds)} s"
    return f"{round(seconds / 60)} min" if seconds < 6000 else f"{round(seconds / 3600)} h"
