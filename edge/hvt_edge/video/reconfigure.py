"""What changes with a keyframe: the frame rate, the base's share, the total. x265 is opened anew for each."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

from hvt_edge.config import LEAST_FPS, EdgeConfig
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import ReconfigurationTrigger
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import Step
from hvt_edge.video.frame_skip import FrameSkip
from hvt_edge.video.least_rate import least_base_bps
from hvt_edge.video.share import Split
from hvt_edge.video.x265 import BaseEncoder
from hvt_edge.wiring import make_encoder

__all__ = ["EncoderReconfiguration", "LimitedFrameSkip"]

_WORTH = 0.04
"""At a keyframe that comes anyway, a base rate that is off by less is left as it is."""


class EncoderReconfiguration:
    """Called before each keyframe; watches decision steps, which may come from another thread.

    With a ``pacer`` the total is the rate that the link carries: the budget follows it at each tick (`follow`), the
    base stream where `ReconfigurationTrigger` finds it worth a keyframe. Between the two, stills give way
    first, then frames.
    """

    def __init__(
        self,
        config: EdgeConfig,
        *,
        size: tuple[int, int],
        decimation: int,
        sender: Transmitter,
        split: Split | None,
        pacer: Pacer | None = None,
    ) -> None:
        self._config = config
        self._size = size
        self._decimation = decimation
        self._base_bps = config.base_bps
        self._sender = sender
        self._split = split
        self._pacer = pacer
        self._total_bps = config.budget_bps
        self._trigger = ReconfigurationTrigger()
        self.on_change: Callable[[], None] = lambda: None
        """Called when the budget has been told of a new split."""
        self._lock = threading.Lock()
        self._wanted: EdgeConfig | None = None
        self.count = 0
        """How often x265 was opened anew."""

    @property
    def base_bps(self) -> int:
        """B_v as it is now."""
        return self._base_bps

    def change(self, config: EdgeConfig) -> None:
        """Total budget and share are those of ``config`` from the next keyframe on; from any thread."""
        with self._lock:
            self._wanted = config

    def follow(self, now_ns: int) -> bool:
        """Hold the budget to the link's rate; True where the base should be opened anew: a keyframe is wanted."""
        if self._pacer is None:
            return False
        total_bps = self._pacer.rate_bps
        if total_bps != self._total_bps:
            self._total_bps = total_bps
            fps = self._config.nominal_fps / self._decimation
            self._sender.set_total(total_bps, self._base_bps, fps, now_ns=now_ns)
        wanted_bps = self._base_of(self._pacer.steady_bps)
        return self._trigger.wants(wanted_bps, self._base_bps, settled=self._pacer.settled, now_ns=now_ns)

    def hold(self, now_ns: int) -> None:
        """While the link is away: what is kept has the budget that the base stream was opened for.

        The pacer takes the silence for a link that carries next to nothing; stills to be kept would find no room.
        """
        if self._pacer is None:
            return
        total_bps = min(self._config.budget_bps, round(self._base_bps / self._share))
        if total_bps != self._total_bps:
            self._total_bps = total_bps
            fps = self._config.nominal_fps / self._decimation
            self._sender.set_total(total_bps, self._base_bps, fps, now_ns=now_ns)

    def least_decimation(self) -> int:
        """At the link's rate, each n-th tick at the most can be coded: x265 has a least for each frame."""
        if self._pacer is None:
            return 1
        base_bps, nominal_fps = self._base_of(self._pacer.steady_bps), self._config.nominal_fps
        most = max(1, int(nominal_fps / LEAST_FPS))
        for decimation in range(1, most):
            if base_bps >= least_base_bps(self._size, nominal_fps / decimation, edge_id=self._config.edge_id):
                return decimation
        return most

    def observe(self, candidates: Sequence[Candidate], step: Step) -> None:
        """Take in all tracks of a decision step."""
        if self._split is not None:
            with self._lock:
                self._split.observe(candidates, step)

    def wants_keyframe(self, now_ns: int) -> bool:
        """Whether the split is so far off that it is worth a keyframe of its own; asked once a second."""
        with self._lock:
            if self._wanted is not None:  # it came while a keyframe was being made
                return True
            return self._moving and self._split is not None and self._split.wants_keyframe(now_ns)

    def __call__(self, decimation: int, now_ns: int) -> BaseEncoder | None:
        """Return the encoder to go on with from this keyframe, or None for the one there is."""
        changed = self._take_change()
        if self._pacer is not None:
            return self._at_links_rate(self._pacer, decimation, now_ns, changed=changed)
        base_bps = self._proposed_bps(changed=changed)
        if not changed and (decimation, base_bps) == (self._decimation, self._base_bps):
            return None
        self._decimation, self._base_bps = decimation, base_bps
        self.count += 1
        fps = self._config.nominal_fps / decimation
        if changed:
            self._sender.set_total(self._config.budget_bps, base_bps, fps, now_ns=now_ns)
        else:
            self._sender.set_base(base_bps, fps, now_ns=now_ns)
        self.on_change()
        return make_encoder(self._config, size=self._size, decimation=decimation, base_bps=base_bps)

    def _at_links_rate(
        self, pacer: Pacer, decimation: int, now_ns: int, *, changed: bool
    ) -> BaseEncoder | None:
        if changed:
            pacer.set_ceiling(self._config.budget_bps, floor_bps=self._config.floor_bps)
        self._proposed_bps(changed=changed)  # which moves the share
        base_bps = self._base_of(pacer.steady_bps)
        near = abs(base_bps / self._base_bps - 1) <= _WORTH and not (pacer.settled or changed)
        if decimation == self._decimation and (near or base_bps == self._base_bps):
            return None
        self._decimation, self._base_bps, self._total_bps = decimation, base_bps, pacer.rate_bps
        self.count += 1
        self._trigger.done(now_ns)
        fps = self._config.nominal_fps / decimation
        self._sender.set_total(self._total_bps, base_bps, fps, now_ns=now_ns)
        self.on_change()
        config = replace(self._config, budget=max(base_bps, pacer.steady_bps))
        return make_encoder(config, size=self._size, decimation=decimation, base_bps=base_bps)

    def _base_of(self, total_bps: int) -> int:
        """The base's part of so much in all; never less than x265 can follow at its lowest frame rate."""
        config, share = self._config, self._share
        least_bps = least_base_bps(self._size, LEAST_FPS, edge_id=config.edge_id)
        return max(least_bps, round(min(total_bps * share, total_bps - config.metadata_bps)))

    @property
    def _share(self) -> float:
        """The base's, as it is now."""
        return self._split.share if self._moving and self._split is not None else self._config.share

    @property
    def _moving(self) -> bool:
        """Whether the split follows the scene: another method may want none."""
        return isinstance(self._config.video_share, str)

    def _take_change(self) -> bool:
        """Whether another total or share was asked for since the last keyframe; it is the one from now on."""
        with self._lock:
            wanted, self._wanted = self._wanted, None
        if wanted is None:
            return False
        before, self._config = self._config, wanted
        return (before.budget_bps, before.base_bps) != (wanted.budget_bps, wanted.base_bps)

    def _proposed_bps(self, *, changed: bool) -> int:
        config = self._config
        if not self._moving or self._split is None:
            return config.base_bps if changed else self._base_bps
        total_bps = config.budget_bps if self._pacer is None else self._pacer.steady_bps
        with self._lock:
            if changed or self._pacer is not None:
                self._split.set_total(total_bps)
            share = self._split.propose()
            share = self._split.share if share is None and changed else share
        return self._base_bps if share is None else round(config.budget_bps * share)


class LimitedFrameSkip(FrameSkip):
    """Another cadence, with no more frames than ``least_decimation()`` allows at the time of a keyframe."""

    def __init__(self, wished: FrameSkip, least_decimation: Callable[[], int]) -> None:
        super().__init__(wished.decimation)
        self._wished = wished
        self._least_decimation = least_decimation

    def coded(self, tick: int, *, keyframe: bool, mean_qp: float) -> None:
        """See `FrameSkip`."""
        super().coded(tick, keyframe=keyframe, mean_qp=mean_qp)
        self._wished.coded(tick, keyframe=keyframe, mean_qp=mean_qp)

    def at_keyframe(self, tick: int) -> int:
        """See `FrameSkip`."""
        self.decimation = max(self._wished.at_keyframe(tick), self._least_decimation())
        return self.decimation
