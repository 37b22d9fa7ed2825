"""The commands of a ground on ``control``: a keyframe, a still, the tracks, another budget or method.

Runs in the link's callbacks: each answer is made at once, from data at hand, and no command costs more than one
crop. The sender of a command is not trusted: arguments have bounds, and requests a rate.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Command, ControlAnswer, ControlRequest, TrackNow, fitted_text
from hvt_common.runtime.statistics import Newest
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_edge.backlog.stage import BacklogStage
from hvt_edge.config import EdgeConfig, least_budget_bps, stream_text
from hvt_edge.operating import FIRST_SHARE, Keyframes, Operating
from hvt_edge.profiles import REGIMES
from hvt_edge.stills.on_demand import OnDemandRequest
from hvt_edge.stills.policy.base import Method
from hvt_edge.stills.policy.registry import method
from hvt_edge.stills.requested_coding import RefusedError
from hvt_edge.stills.scheduler import Chooser

_MOST_REQUESTS = 32
"""Requests a second, from all grounds together."""
_REST_NS = 2 * SECOND_NS
"""Least time between two changes of the budget: each costs a keyframe and the opening of an encoder."""
_MOST_BPS = 1_000_000_000
_LEAST_CAMERA_BPS = 10_000
"""With less the frame loop would only wait for ``status``."""
_U32 = 2**32 - 1
_FAR_PX = 32767
_REASON_BYTES = 200

Arguments = Mapping[str, Any]
_ARGUMENTS: Mapping[str, Mapping[str, tuple[int, int] | None]] = {
    Command.STILL: {
        "track": (0, _U32),
        "frame": (0, _U32),
        "at_ms": (-3_600_000, 0),
        "quality": (5, 95),
        **dict.fromkeys("xywh", (-_FAR_PX, _FAR_PX)),
    },
    Command.STILL_OUTCOME: {"ask": (0, _U32)},
    Command.SET_BUDGET: {"bps": (1, _MOST_BPS)},
    Command.SET_METHOD: {"method": None},
}
"""Bounds of whole numbers; None is a word. All but those of a still are needed."""


@dataclass(eq=False)
class Commands:
    """Answers one session's requests; may be called from any thread.

    ``clock`` is Unix nanoseconds, for the rate of requests; ``loop_clock`` is the time of the budget's windows and
    of planned keyframes.
    """

    config: EdgeConfig
    _: KW_ONLY
    operating: Operating
    session_id: int
    keyframes: Keyframes
    chooser: Chooser
    make_method: Callable[[str], Method]
    """Makes a method by its name, with the edge's settings; raises `UserError` for an unknown one."""
    backlog: BacklogStage | None
    base_size: tuple[int, int]
    clock: Callable[[], int]
    loop_clock: Callable[[], int]

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._request_times: deque[int] = deque(maxlen=_MOST_REQUESTS)
        self._answered: Newest[int, ControlAnswer] = Newest(_MOST_REQUESTS)
        """By the number of the request."""
        self._changed_ns: int | None = None
        self._commands: dict[str, Callable[[Arguments], ControlAnswer]] = {
            Command.KEYFRAME: self._keyframe,
            Command.STILL: self._still,
            Command.STILL_OUTCOME: lambda of: self._answer(note=self.chooser.on_demand.outcome(of["ask"])),
            Command.TRACKS: self._tracks,
            Command.SET_BUDGET: self._set_budget,
            Command.SET_METHOD: self._set_method,
            Command.SEND_BACKLOG: self._send_backlog,
        }

    def answer(self, request: ControlRequest) -> ControlAnswer:
        """Obey the request or give the reason why not; never raises, whatever a ground sends."""
        with self._lock:
            answer = self._answered.get(request.request_id)
            if answer is None:
                try:
                    answer = self._obey(request)
                except (RefusedError, UserError) as refusal:
                    answer = self._answer(reason=str(refusal))
            if request.request_id:
                self._answered[request.request_id] = answer
            return answer

    def _answer(
        self,
        *,
        reason: str = "",
        still_request: int = -1,
        frame_index: int = -1,
        tracks: tuple[TrackNow, ...] = (),
        note: str = "",
    ) -> ControlAnswer:
        return ControlAnswer(
            session_id=self.session_id,
            accepted=not reason,
            reason=fitted_text(reason, _REASON_BYTES),
            still_request=still_request,
            frame_index=frame_index,
            tracks=tracks,
            note=fitted_text(note, _REASON_BYTES),
        )

    def _obey(self, request: ControlRequest) -> ControlAnswer:
        if request.session_id not in (0, self.session_id):
            raise RefusedError("that session has ended")
        self._check_rate()
        command = self._commands.get(request.command)
        if command is None:
            raise RefusedError(f"this edge does not serve {request.command!r}")
        _check_arguments(request.command, request.arguments)
        return command(request.arguments)

    def _check_rate(self) -> None:
        now_ns, times = self.clock(), self._request_times
        if len(times) == _MOST_REQUESTS and now_ns - times[0] < SECOND_NS:
            raise RefusedError(f"too many requests: at most {_MOST_REQUESTS} a second are served")
        times.append(now_ns)

    # The commands

    def _keyframe(self, _arguments: Arguments) -> ControlAnswer:
        refusal = self.keyframes.request(self.loop_clock())
        if refusal is not None:
            raise RefusedError(refusal)
        return self._answer()

    def _still(self, arguments: Arguments) -> ControlAnswer:
        number, frame_index = self.chooser.on_demand.request(_on_demand_request(arguments))
        return self._answer(still_request=number, frame_index=frame_index)

    def _tracks(self, _arguments: Arguments) -> ControlAnswer:
        frame_index, tracks, there = self.chooser.on_demand.tracks()
        note = (
            f"of {there} tracks these are the {len(tracks)} of most confidence" if there > len(tracks) else ""
        )
        return self._answer(frame_index=frame_index, tracks=tracks, note=note)

    def _set_budget(self, arguments: Arguments) -> ControlAnswer:
        now = self.operating.now
        self._change(arguments["bps"], now.video_share, now.method)
        return self._answer()

    def _set_method(self, arguments: Arguments) -> ControlAnswer:
        now = self.operating.now
        before, policy = method(now.method), self.make_method(arguments["method"])
        if policy.name == before.name:
            return self._answer()
        if "R0" in (policy.name, before.name):
            raise RefusedError(
                "R0 codes the video in another way from the first frame on: start the edge with it"
            )
        self._change(now.budget_bps, self._share_for(policy.video_only), policy.name)
        self.chooser.method = policy  # from the next decision step on; pending stills stay
        return self._answer()

    def _send_backlog(self, _arguments: Arguments) -> ControlAnswer:
        if self.backlog is None:
            raise RefusedError("this edge stores nothing while its link is away (--store 0)")
        if not self.backlog.send_video():
            raise RefusedError("nothing is stored that was not sent")
        return self._answer()

    # Changes of the rates

    def _change(self, budget_bps: int, video_share: float | None, method_name: str) -> None:
        now = self.operating.now
        rates_change = (budget_bps, video_share) != (now.budget_bps, now.video_share)
        if rates_change:
            now_ns = self.clock()
            if self._changed_ns is not None and now_ns - self._changed_ns < _REST_NS:
                raise RefusedError("the rates were changed a moment ago: wait two seconds")
            self._check_base(budget_bps, video_share)
            self._changed_ns = now_ns
        self.operating.set(budget_bps=budget_bps, video_share=video_share, method=method_name)
        if rates_change:
            self.keyframes.require(self.loop_clock())

    def _share_for(self, video_only: bool) -> float | None:  # noqa: FBT001 - one caller
        # The base's share for a method of that kind: all without stills, else the share at the edge's start.
        if video_only:
            return 1.0
        began = self.config
        return REGIMES["low"].video_share if method(began.method).video_only else began.fixed_share

    def _check_base(self, budget_bps: int, video_share: float | None) -> None:
        # As `hvt_edge.config.check_rate`, in words for a remote client.
        config, size = self.config, self.base_size
        share = FIRST_SHARE if video_share is None else video_share
        least_bps, what = least_budget_bps(config, size, share=share), stream_text(config, size)
        if config.passes_through:  # a camera's frames without room are left out
            least_bps = max(round(_LEAST_CAMERA_BPS / share), _LEAST_CAMERA_BPS + config.metadata_bps)
            what = "a camera that is passed through"
        if budget_bps < least_bps:
            raise RefusedError(
                f"{bitrate_text(budget_bps)} is too little for {what}: it takes at least {bitrate_text(least_bps)}"
            )


def _on_demand_request(arguments: Arguments) -> OnDemandRequest:
    track, frame, at_ms = (arguments.get(name) for name in ("track", "frame", "at_ms"))
    given = [arguments[side] for side in "xywh" if side in arguments]
    if len(given) not in (0, 4):
        raise RefusedError("a box takes x, y, w and h, all four")
    if track is not None and given:
        raise RefusedError("a still is of a track or of a box, not of both")
    if at_ms is not None and frame is not None:
        raise RefusedError("a still is of a frame or of a time, not of both")
    return OnDemandRequest(
        track_id=track,
        box_xywh_px=(given[0], given[1], given[2], given[3]) if given else None,
        frame_index=frame,
        ago_ms=None if at_ms is None else -at_ms,
        quality_pct=arguments.get("quality"),
    )


def _check_arguments(command: str, arguments: Arguments) -> None:
    taken = _ARGUMENTS.get(command, {})
    for name, value in arguments.items():
        if name not in taken:
            raise RefusedError(f"{command} takes no {name!r:.24}")
        bounds = taken[name]
        if bounds is None and not isinstance(value, str):
            raise RefusedError(f"{command}: {name} is a word, not {value!r:.24}")
        if bounds is not None and (type(value) is not int or not bounds[0] <= value <= bounds[1]):
            raise RefusedError(
                f"{command}: {name} is a whole number from {bounds[0]} to {bounds[1]}, not {value!r:.24}"
            )
    missing = [] if command == Command.STILL else [name for name in taken if name not in arguments]
    if missing:
        raise RefusedError(f"{command}: {missing[0]} is missing")
