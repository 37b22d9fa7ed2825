"""One frame of the base stream: decide whether and how it is coded, encode, keep, send."""

from __future__ import annotations

from collections.abc import Callable

from hvt_common.values import AccessUnit, Frame, Tracks
from hvt_edge.backlog.stage import BacklogStage, State
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.operating.keyframes import KeyframePlan
from hvt_edge.video.frame_skip import FrameSkip
from hvt_edge.video.local_copy import BaseRecorder
from hvt_edge.video.regions import TrackRegions
from hvt_edge.video.x265 import BaseEncoder

__all__ = ["BaseStage"]


class BaseStage:
    """Runs in the frame loop, once for each tick.

    Args:
        encoder: opened for the cadence's first frame rate; with ``side_data`` where there is a plan.
        keyframes: when a keyframe comes; it may come at a tick that the cadence would have left out.
        sender: takes the units.
        recorder: keeps them in a file too.
        first_keyframe_bytes: the guess until a keyframe has been seen.
        regions: which regions get more bits; None for none.
        cadence: which ticks are coded; all by default.
        renew: called with (n, ``now_ns``) before each keyframe, each n-th tick being coded from it on. Returns an
            encoder newly opened for that, where anything has changed, or None to go on with the one there is. x265
            takes neither another frame rate nor another bit rate once it is open. Needed where the cadence changes.
        admits: asked with ``now_ns`` before a tick is coded; where it says no, the frame is held back (`held`).
        keep: takes the units while the link is away.
    """

    def __init__(
        self,
        encoder: BaseEncoder,
        *,
        keyframes: KeyframePlan,
        sender: Transmitter,
        recorder: BaseRecorder | None,
        first_keyframe_bytes: int,
        regions: TrackRegions | None = None,
        frame_skip: FrameSkip | None = None,
        renew: Callable[[int, int], BaseEncoder | None] | None = None,
        admits: Callable[[int], bool] = lambda _now_ns: True,
        backlog: BacklogStage | None = None,
    ) -> None:
        self._encoder = encoder
        self._keyframes = keyframes
        self._sender = sender
        self._recorder = recorder
        self._keyframe_bytes = first_keyframe_bytes
        self._regions = regions
        self._frame_skip = frame_skip or FrameSkip()
        self._renew = renew
        self._admits = admits
        self._backlog = backlog
        self._kept = self._admitted = False
        """Of the tick encoded last: whether it goes to the store, and whether the link was free for it."""
        self.held = False
        """Whether the last tick was to be coded and could not be, because the link is busy."""

    @property
    def decimation(self) -> int:
        """Each n-th tick is coded now."""
        return self._frame_skip.decimation

    def encode(self, frame: Frame, *, now_ns: int, tracks: Tracks | None = None) -> AccessUnit | None:
        """Encode the frame, as a keyframe where one is due and fits; None where this tick is not coded.

        ``tracks`` are the newest that are known, in base pixels.
        """
        fits = self._sender.keyframe_fits(self._keyframe_bytes, now_ns=now_ns)
        keyframe = self._keyframes.now(now_ns, fits=fits)
        # Asked once a tick: between two answers the link may fill, and a frame would build on others that were kept.
        self._admitted, self.held = self._admits(now_ns), False
        self._kept = self._backlog is not None and self._backlog.keeps(keyframe=keyframe and self._admitted)
        if self._backlog is not None and self._kept:
            keyframe = self._backlog.wants_keyframe(now_ns, due=keyframe)
        if not keyframe and not self._frame_skip.codes(frame.index):
            return None
        if not self._kept and not self._admitted:
            self.held = True
            return None
        if keyframe and not self._kept:
            self._begin_run(frame.index, now_ns=now_ns)
        regions = [] if self._regions is None else self._regions.regions(tracks)
        unit = self._encoder.encode(frame, keyframe=keyframe, regions=regions)
        self._frame_skip.coded(frame.index, keyframe=unit.keyframe, mean_qp=self._encoder.mean_qp)
        self._note(unit, now_ns)
        if self._recorder is not None:
            self._recorder.write(unit)
        return unit

    def send(self, unit: AccessUnit, *, now_ns: int) -> None:
        """Send the unit; blocks while the link is full, and frames are then dropped before they are encoded.

        Or keep it, where the link is away.
        """
        if self._backlog is not None and self._kept:
            probes = self._admitted and self._backlog.probes(now_ns)
            self._backlog.base(unit, now_ns=now_ns, sent=probes)
            if probes:
                self._sender.base(unit, now_ns=now_ns, after_hole=not unit.keyframe)
            else:
                self._sender.store_base(unit, now_ns=now_ns)
            return
        if self._backlog is not None:
            self._backlog.sent(unit)
        line_bytes = self._sender.base(unit, now_ns=now_ns)
        if unit.keyframe:
            self._keyframe_bytes = line_bytes
            self._keyframes.note_cost(self._sender.takes_ns(line_bytes))

    def _note(self, unit: AccessUnit, now_ns: int) -> None:
        """What a keyframe means to the plan and to the store."""
        backlog = self._backlog
        if backlog is None or backlog.state is State.LIVE:
            if unit.keyframe:
                self._keyframes.done(now_ns)
        elif self._kept:
            # One that begins a segment while the link is back is not the one to go on with, which stays due.
            if unit.keyframe and backlog.offline:
                self._keyframes.done(now_ns)
        else:
            assert unit.keyframe, "x265 makes a keyframe of each frame that is to be one"
            self._keyframes.done(now_ns)
            backlog.resume()

    def _begin_run(self, tick: int, *, now_ns: int) -> None:
        """What may change with a keyframe only. What is kept goes on with the quality that the link had."""
        before = self._frame_skip.decimation
        decimation = self._frame_skip.at_keyframe(tick)
        encoder = None if self._renew is None else self._renew(decimation, now_ns)
        assert encoder is not None or decimation == before, "a cadence that changes needs another encoder"
        self._encoder = encoder or self._encoder
