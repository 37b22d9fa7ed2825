"""The order of the stages at the edge. Nothing else knows it."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, cast

from hvt_common.inference.detect import Detector
from hvt_common.protocol.channels import EdgeKeys
from hvt_common.protocol.ledger import Account, Ledger
from hvt_common.protocol.messages import Feedback, Status
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.reporting import StatusLine
from hvt_common.transport.doctor.diagnose import LinkWatch
from hvt_common.transport.duplicate_edge import refuse_duplicate_edge
from hvt_common.transport.session import open_session
from hvt_common.values import Fit
from hvt_edge.config import EdgeConfig, check_rate
from hvt_edge.control.commands import Commands, Served
from hvt_edge.control.link_control import LinkControl, wait_for_ground
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import EdgeLink
from hvt_edge.link.tracks_channel import TrackReporter
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.link.unacknowledged import Unacknowledged
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.loop.realtime import RealtimePace
from hvt_edge.source.closing import closing_on
from hvt_edge.source.demo import check_truth, write_truth_of
from hvt_edge.source.opening import Source, open_source
from hvt_edge.status import make_info, make_status, status_text
from hvt_edge.stills.stage import StillStage
from hvt_edge.summary import EdgeRun, summary
from hvt_edge.video.local_copy import BaseRecorder
from hvt_edge.video.reconfigure import EncoderReconfiguration, LimitedFrameSkip
from hvt_edge.video.stage import BaseStage
from hvt_edge.wiring import (
    SECOND_NS,
    base_size,
    check_files,
    first_decimation,
    make_analyzer,
    make_backlog,
    make_budget,
    make_chooser,
    make_detector,
    make_encoder,
    make_frame_skip,
    make_keyframes,
    make_link_settings,
    make_on_demand,
    make_pacer,
    make_regions,
    make_split,
    warm_up_for,
)

__all__ = ["Edge"]

_GOODBYE_S = 1.5
_MILLION = 1_000_000


@dataclass(frozen=True, slots=True)
class _Flow:
    """What a frame goes through."""

    base: BaseStage
    stills: StillStage
    sender: Transmitter
    link: EdgeLink
    reconfiguration: EncoderReconfiguration


class Edge:
    """One run of one edge: build it, `run` it once. ``on_started()`` is called once nothing is refused any more."""

    def __init__(
        self, config: EdgeConfig, *, stop: threading.Event, on_started: Callable[[], None] = lambda: None
    ) -> None:
        self._config = config
        self._stop = stop
        self._on_started = on_started
        self._lockstep = config.pace == "lockstep"
        self._clock = SteadyClock()
        self._session_id = secrets.randbits(64)
        self._counts = FrameCounts()
        self._ledger = Ledger(window_ns=round(config.window * SECOND_NS))
        self._keyframes = make_keyframes(config)
        self._inbox = FeedbackInbox()
        unacked = None if self._lockstep else Unacknowledged()
        self._link_control = LinkControl(make_pacer(config), unacked, keyframes=self._keyframes)
        self._commands = Commands(
            config,
            session_id=self._session_id,
            keyframes=self._keyframes,
            clock=self._clock,
            window_ns=lambda: self._now_ns,
        )
        self._watch: LinkWatch | None = None
        self._started_ns = 0
        self._now_ns = 0
        self._status_sequence = 0

    def run(self) -> dict[str, Any]:
        """Play the source to its end or until ``stop`` is set; return the summary.

        Raises:
            UserError: before anything is sent, where a setting, a file or a port cannot be used.
        """
        config = self._config
        check_files(config)
        detector = make_detector(config)
        with ExitStack() as stack:
            source = stack.enter_context(self._open_source())
            check_truth(config.truth, source)
            check_rate(config, source.view.base_size)
            warm_up_for(config, detector, source.view)
            line = stack.enter_context(StatusLine(quiet=config.quiet))
            flow = self._make_flow(stack, source, detector)
            self._on_started()
            if not source.live:
                wait_for_ground(flow.link.heard, config, stop=self._stop, note=line.note)
            self._started_ns = self._clock()
            try:
                self._play(source, flow, line)
            finally:
                flow.stills.close()
                self._say_goodbye(flow)
        return summary(self._facts(flow), self._ledger)

    def _make_flow(self, stack: ExitStack, source: Source, detector: Detector) -> _Flow:
        """Everything between the source and the link."""
        config, view, link_control = self._config, source.view, self._link_control
        decimation = first_decimation(config, view.base_size)
        encoder = make_encoder(config, size=view.base_size, decimation=decimation, base_bps=config.base_bps)
        budget = make_budget(config, decimation=decimation)
        link = self._open_link(stack, source, detector.class_names)
        # Files come after all that may be refused: a failed start leaves nothing behind.
        write_truth_of(source, config.truth, fps=config.nominal_fps)
        recorder = stack.enter_context(BaseRecorder(config.record_base)) if config.record_base else None
        sender = Transmitter(
            link,
            ledger=self._ledger,
            budget=budget,
            edge_id=config.edge_id,
            session_id=self._session_id,
            lockstep=self._lockstep,
            wait_until=self._wait_until,
            pacer=link_control.pacer,
            unacked=link_control.unacked,
        )
        reconfiguration = EncoderReconfiguration(
            config,
            size=view.base_size,
            decimation=decimation,
            sender=sender,
            split=make_split(config, view.base_size),
            pacer=link_control.pacer,
        )
        backlog = make_backlog(
            config,
            session_id=self._session_id,
            live=source.live,
            link=link,
            sender=sender,
            keyframes=self._keyframes,
            clock=self._clock,
            info=lambda: self._info(source, detector.class_names, self._clock()),
        )
        if backlog is not None:
            stack.enter_context(backlog)
        base = BaseStage(
            encoder,
            keyframes=self._keyframes,
            sender=sender,
            recorder=recorder,
            first_keyframe_bytes=config.base_bps // 40,  # a fifth of a second: what the VBV lets through
            plan=make_regions(config, view.base_size),
            frame_skip=LimitedFrameSkip(
                make_frame_skip(config, decimation), reconfiguration.least_decimation
            ),
            renew=reconfiguration,
            admits=link_control.admits,
            backlog=backlog,
        )
        on_demand = make_on_demand(
            config, view=view, class_names=detector.class_names, most_bytes=sender.most_still_bytes
        )
        chooser = make_chooser(
            config,
            view=view,
            class_names=detector.class_names,
            most_bytes=sender.most_still_bytes(),
            on_outcome=sender.outcome,
            observe=reconfiguration.observe,
            asked=on_demand,
            overdue=link_control.overdue_stills,
        )
        reconfiguration.on_change = lambda: chooser.set_most_bytes(sender.most_still_bytes())
        self._commands.serve(
            Served(on_demand, reconfiguration, chooser, base_size=view.base_size, backlog=backlog)
        )
        stills = StillStage(
            make_analyzer(config, detector=detector, view=view),
            chooser,
            sender=sender,
            keyframes=self._keyframes,
            reporter=TrackReporter(sender, session_id=self._session_id) if config.send_tracks else None,
            backlog=backlog,
        )
        link_control.attach(
            linked=link.heard, sender=sender, reconfiguration=reconfiguration, stills=stills, backlog=backlog
        )
        return _Flow(base, stills, sender, link, reconfiguration)

    def _open_source(self) -> Source:
        config = self._config
        assert config.source is not None, "check() refuses a missing source"
        return open_source(
            config.source,
            size=base_size(config),
            fps=config.nominal_fps,
            fit=cast("Fit", config.fit),
            seed=config.seed,
            max_frames=config.max_frames,
            source_fps=config.source_fps,
            clock=self._clock,
        )

    def _open_link(self, stack: ExitStack, source: Source, class_names: tuple[str, ...]) -> EdgeLink:
        config = self._config
        settings = make_link_settings(config)
        refuse_duplicate_edge(settings, EdgeKeys(config.edge_id))
        session = stack.enter_context(open_session(settings))
        link = stack.enter_context(
            EdgeLink(
                session,
                EdgeKeys(config.edge_id),
                answer_info=lambda received_ns: self._info(source, class_names, received_ns),
                answer_control=self._commands.answer,
                hear=self._hear,
                clock=self._clock,
            )
        )
        self._watch = stack.enter_context(LinkWatch(session, settings, served=lambda _ground: link.heard()))
        return link

    # The frame loop

    def _play(self, source: Source, flow: _Flow, line: StatusLine) -> None:
        next_status_ns = 0
        with ExitStack() as stack:
            if source.live:
                stack.enter_context(closing_on(self._stop, source))
            pace = self._make_pace(flow, source)
            stack.enter_context(pace)
            for frame in source.frames(start_ns=self._started_ns):
                if self._stop.is_set():
                    break
                self._counts.captured += 1
                pace.step(frame)
                self._now_ns = pace.now_ns
                if self._now_ns >= next_status_ns:
                    next_status_ns = self._now_ns + SECOND_NS
                    self._report(flow, line)
                    if flow.reconfiguration.wants_keyframe(self._now_ns):
                        self._keyframes.renew(self._now_ns)
        if not source.live:
            self._link_control.finish(stop=self._stop, note=line.note)

    def _make_pace(self, flow: _Flow, source: Source) -> LockstepPace | RealtimePace:
        fps = self._config.nominal_fps
        if self._lockstep:
            return LockstepPace(
                flow.base,
                flow.stills,
                inbox=self._inbox,
                keyframes=self._keyframes,
                fps=fps,
                counts=self._counts,
                heard=flow.link.heard,
                stop=self._stop,
            )
        return RealtimePace(
            flow.base,
            flow.stills,
            inbox=self._inbox,
            clock=self._clock,
            fps=fps,
            live=source.live,
            counts=self._counts,
            stop=self._stop,
            follow=self._link_control.before_frame,
        )

    def _wait_until(self, at_ns: int) -> None:
        """Let the budget's window make room; media time needs no waiting."""
        if not self._lockstep and (wait_ns := at_ns - self._clock()) > 0:
            self._stop.wait(wait_ns / SECOND_NS)

    # What others ask and are told

    def _hear(self, feedback: Feedback) -> None:
        if feedback.session_id == self._session_id:
            now_ns = self._clock()
            self._link_control.hear(feedback, now_ns=now_ns)
            # Last: who waits there for the end goes on to keep what is not acknowledged.
            self._inbox.receive(feedback, now_ns=now_ns)

    def _info(self, source: Source, class_names: tuple[str, ...], received_ns: int) -> bytes:
        info = make_info(
            self._commands.config,
            session_id=self._session_id,
            started_ns=self._started_ns,
            view=source.view,
            class_names=class_names,
            window_ns=self._ledger.window_ns,
            received_ns=received_ns,
            answered_ns=self._clock(),
        )
        return info.pack()

    def _report(self, flow: _Flow, line: StatusLine) -> None:
        self._send_status("running", flow)
        pacer, watch = self._link_control.pacer, self._watch
        unlinked = watch is not None and watch.trouble  # which the log has said
        heard = "a ground listens" if flow.link.heard() else "no link" if unlinked else "no ground listens"
        line.show(
            status_text(
                self._commands.config,
                counts=self._counts,
                ledger=self._ledger,
                stills=flow.stills,
                now_ns=self._now_ns,
                allowed_bps=self._commands.config.budget_bps if pacer is None else pacer.rate_bps,
                link=f"{heard}  {self._link_control.text()}".rstrip(),
            )
        )

    def _send_status(self, state: str, flow: _Flow) -> None:
        now_ns = self._now_ns if self._lockstep else self._clock()
        flow.sender.status(lambda at_ns: self._status(state, flow, at_ns), now_ns=now_ns)
        self._status_sequence += 1

    def _status(self, state: str, flow: _Flow, at_ns: int) -> Status:
        heard_ns = self._inbox.received_ns
        return make_status(
            state,
            session_id=self._session_id,
            sequence=self._status_sequence,
            at_ns=at_ns,
            started_ns=self._started_ns,
            fps=self._config.nominal_fps,
            ledger=self._ledger,
            counts=self._counts,
            keyframes=self._keyframes,
            sender=flow.sender,
            stills=flow.stills,
            feedback_age_ms=-1 if heard_ns is None else max(0, (self._clock() - heard_ns) // _MILLION),
            measured=not self._lockstep,
        )

    def _say_goodbye(self, flow: _Flow) -> None:
        """Let the ground finish, then tell it that this was all."""
        sender = flow.sender
        if self._link_control.backlog is not None:
            self._link_control.backlog.send_no_more()
        self._send_status("ended", flow)
        if flow.link.heard():  # what is still in a queue would be lost with the session
            self._inbox.wait_for_end(
                base=self._ledger.messages(Account.BASE),
                roi=sender.still_sequence + 1,
                frame_index=self._counts.last_index,
                still_sequence=sender.still_sequence,
                timeout_s=_GOODBYE_S,
            )

    def _facts(self, flow: _Flow) -> EdgeRun:
        counts, config, backlog = self._counts, self._config, self._link_control.backlog
        kept = 0 if backlog is None else backlog.frames
        return EdgeRun(
            edge=config.edge_id,
            session=f"{self._session_id:016x}",
            method=self._commands.config.method,
            frames=counts.encoded - kept,
            frames_stored=kept,
            frames_dropped=counts.dropped,
            duration_s=self._counts.duration_s(self._config.nominal_fps),
            budget_bps=self._commands.highest_budget_bps,
            base_bps=flow.reconfiguration.base_bps,
            keyframes=self._keyframes.sent,
            keyframe_requests=self._keyframes.requests,
            tracks=flow.stills.tracks,
            encode_ms=counts.encode_ms,
            perception_ms=flow.stills.perception_ms,
            unusable_messages=flow.link.unusable,
            store=None if backlog is None else backlog.numbers,
        )
