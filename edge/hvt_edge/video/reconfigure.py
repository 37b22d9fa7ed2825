"""Changes at a keyframe: frame rate, the base's share, the total, the preset. x265 is opened anew for each.

With ``--video-share auto`` (`Split`) the base's share follows the objects that are to be refined. Stills get the bits
to work off the waiting need in some seconds; few tracks, or tracks whose class is settled, leave them to the base. A
new split is proposed where it differs enough to be worth a keyframe.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from hvt_edge.link.budget import RollingBudget
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import ReconfigurationTrigger
from hvt_edge.operating import FIRST_SHARE, Operating, Rates, base_rate_bps
from hvt_edge.stills.policy.base import Step
from hvt_edge.stills.policy.m6 import ExpectedGain
from hvt_edge.video.encoder import CheckedEncoder, Encoder, EncoderPlan, least_base_bps, most_keyframe_bytes
from hvt_edge.video.rate_model import PresetControl
from hvt_edge.video.x265 import BaseEncoder

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

_FAR_MORE = 2.0
"""Least growth of the base rate that is worth a keyframe while a flight begins."""
_WORTH = 0.04
"""Least change of the base rate, as a share, at a keyframe that is due anyway."""

OpenEncoder = Callable[[Rates], Encoder]


def encoder_opener(
    plan: EncoderPlan, operating: Operating, *, presets: PresetControl | None = None
) -> OpenEncoder:
    """Opens encoders in flight, with the preset that is in force then; the one before is closed first.

    Two at a time take 15 to 20 MB more at 1280x720 and twice the threads; a device of one session refuses the second.
    """
    last: Encoder | None = None

    def open_for(rates: Rates) -> Encoder:
        nonlocal last
        before, last = last, None  # it may be that no other opens now
        if isinstance(before, BaseEncoder | CheckedEncoder):
            before.close()
        last = encoder = plan.open(rates, preset=operating.now.preset)
        if presets is not None and isinstance(encoder, BaseEncoder):
            presets.watch(lambda: encoder.spent)
        return encoder

    return open_for


@dataclass(eq=False)
class EncoderReconfiguration:
    """Called before each keyframe for the link.

    With a ``pacer`` the total is the rate that the link carries: the budget tracks it at each frame (`track_link`),
    the base stream where `ReconfigurationTrigger` finds it worth a keyframe. Between the two, stills yield
    first, then frames.
    """

    operating: Operating
    _: KW_ONLY
    size: tuple[int, int]
    nominal_fps: float
    """Source frames a second."""
    least_fps: float
    """The lowest rate of coded frames."""
    edge_id: str
    metadata_bps: int
    """The rate of tracks, part of the budget."""
    min_budget_bps: int
    """The floor of the link's rate, unless the budget is lower itself."""
    open_encoder: OpenEncoder
    budget: RollingBudget
    split: Split | None
    pacer: Pacer | None = None
    presets: PresetControl | None = None
    """None where the preset is set."""

    def __post_init__(self) -> None:
        self._trigger = ReconfigurationTrigger()
        self._least_base_bps = least_base_bps(self.size, self.least_fps, edge_id=self.edge_id)
        now = self.operating.now
        self._opened = Rates(now.budget_bps, now.base_bps, now.decimation)
        """The rates for which x265 was last opened."""
        self._commanded = (now.budget_bps, now.video_share)
        """Budget and share that x265 was last opened under."""
        self.count = 0

    def track_link(self, now_ns: int) -> bool:
        """Hold the budget to the link's rate; True where the base should be opened anew, which needs a keyframe."""
        if self.pacer is None:
            return False
        self._allow(self.pacer.most_bps, now_ns)
        wanted_bps = self._base_of(self.pacer.steady_bps)
        if self.pacer.begins and 1 <= wanted_bps / self.operating.now.base_bps < _FAR_MORE:
            return False  # few keyframes on the way to the rate that is found cost less than many
        return self._trigger.wants(
            wanted_bps, self.operating.now.base_bps, at_ceiling=self.pacer.at_ceiling, now_ns=now_ns
        )

    def hold(self, now_ns: int) -> None:
        """While the link is offline: stored messages have the budget for which the base stream was opened.

        The pacer takes the silence for a link that carries next to nothing; stills would find no room in the store.
        """
        if self.pacer is None:
            return
        now = self.operating.now
        self._allow(min(self._commanded[0], round(now.base_bps / self._share)), now_ns)

    def least_decimation(self) -> int:
        """The least n at the link's rate, where each n-th source frame is coded: x265 needs some bits for each."""
        if self.pacer is None:
            return 1
        base_bps = self._base_of(self.pacer.steady_bps)
        most = max(1, int(self.nominal_fps / self.least_fps))
        for decimation in range(1, most):
            if base_bps >= least_base_bps(self.size, self.nominal_fps / decimation, edge_id=self.edge_id):
                return decimation
        return most

    def keyframe_bytes(self, last_bytes: int) -> int:
        """About the line bytes of the next keyframe, if the last one took ``last_bytes``.

        At a lower rate, for which the encoder is opened with it, its VBV lets less through.
        """
        if self.pacer is None:
            return last_bytes
        now = self.operating.now
        base_bps = self._base_of(min(now.budget_bps, self.pacer.steady_bps))
        if base_bps >= now.base_bps:
            return last_bytes
        fps = self.nominal_fps / max(now.decimation, self.least_decimation())
        return min(last_bytes, most_keyframe_bytes(self.size, fps, base_bps))

    def wants_keyframe(self, now_ns: int) -> bool:
        """Whether rates are so far off that it is worth a keyframe of its own; once a second."""
        now = self.operating.now
        if self._commanded != (now.budget_bps, now.video_share):  # commanded while a keyframe was being made
            return True
        if self.split is None or not self._moving:
            return False
        with self.split.lock:
            self._tell_split(now.decimation)
            return self.split.wants_keyframe(now_ns)

    def open_again(self) -> Encoder:
        """Return another encoder with the last settings."""
        return self.open_encoder(self._opened)

    def __call__(self, decimation: int, now_ns: int) -> Encoder | None:
        """Return the encoder from this keyframe on, or None to keep the present one."""
        now = self.operating.now
        before, self._commanded = self._commanded, (now.budget_bps, now.video_share)
        changed = before != self._commanded  # since the last keyframe
        same_preset = self.presets is None or not self.presets.wants_another(now_ns)
        if self.pacer is not None:
            return self._at_links_rate(
                self.pacer, decimation, now_ns, changed=changed, same_preset=same_preset
            )
        base_bps, total_bps = self._proposed_bps(decimation, changed=changed), now.budget_bps
        if same_preset and not changed and (decimation, base_bps) == (now.decimation, now.base_bps):
            return None
        return self._open(Rates(total_bps, base_bps, decimation), total_bps=total_bps, now_ns=now_ns)

    def _at_links_rate(
        self, pacer: Pacer, decimation: int, now_ns: int, *, changed: bool, same_preset: bool
    ) -> Encoder | None:
        now = self.operating.now
        if changed:
            floor_bps = min(now.budget_bps, self.min_budget_bps)
            pacer.set_ceiling(now.budget_bps, floor_bps=floor_bps)
        self._proposed_bps(decimation, changed=changed)  # which moves the share
        base_bps = self._base_of(pacer.steady_bps)
        near = abs(base_bps / now.base_bps - 1) <= _WORTH and not (pacer.at_ceiling or changed)
        if same_preset and decimation == now.decimation and (near or base_bps == now.base_bps):
            return None
        self._trigger.done(now_ns)
        rates = Rates(max(base_bps, pacer.steady_bps), base_bps, decimation)
        return self._open(rates, total_bps=pacer.most_bps, now_ns=now_ns)

    def _open(self, rates: Rates, *, total_bps: int, now_ns: int) -> Encoder:
        self.count += 1
        self._opened = rates
        self.operating.set(total_bps=total_bps, base_bps=rates.base_bps, decimation=rates.decimation)
        self._set_budget(now_ns)
        return self.open_again()

    def _allow(self, total_bps: int, now_ns: int) -> None:
        if total_bps != self.operating.now.total_bps:
            self.operating.set(total_bps=total_bps)
            self._set_budget(now_ns)

    def _set_budget(self, now_ns: int) -> None:
        now = self.operating.now
        fps = self.nominal_fps / now.decimation
        self.budget.set_total(now.total_bps, now.base_bps, fps, now_ns=now_ns)

    def _base_of(self, total_bps: int) -> int:
        # The base's part of this total; never less than x265 can follow at its lowest frame rate.
        return max(
            self._least_base_bps, base_rate_bps(total_bps, self._share, metadata_bps=self._metadata_bps)
        )

    @property
    def _share(self) -> float:
        commanded = self._commanded[1]
        if commanded is not None:
            return commanded
        return FIRST_SHARE if self.split is None else self.split.share

    @property
    def _metadata_bps(self) -> int:
        return self.metadata_bps if self.operating.now.decisions.tracks else 0

    @property
    def _moving(self) -> bool:
        # Whether the split tracks the scene; a commanded share stops it.
        return self._commanded[1] is None

    def _tell_split(self, decimation: int) -> None:
        assert self.split is not None
        stills = self.operating.now.decisions.stills
        self.split.set_beside(metadata_bps=self._metadata_bps, stills=stills, sparse=decimation > 1)

    def _proposed_bps(self, decimation: int, *, changed: bool) -> int:
        now = self.operating.now
        if not self._moving or self.split is None:
            base_bps = base_rate_bps(now.budget_bps, self._share, metadata_bps=self._metadata_bps)
            return base_bps if changed else now.base_bps
        total_bps = now.budget_bps if self.pacer is None else self.pacer.steady_bps
        with self.split.lock:
            self._tell_split(decimation)
            if changed or self.pacer is not None:
                self.split.set_total(total_bps)
            share = self.split.propose()
            share = self.split.share if share is None and changed else share
        return now.base_bps if share is None else round(now.budget_bps * share)


@dataclass(eq=False)
class Split:
    """Observes decision steps, which may come from another thread, and proposes a share at keyframes.

    Rates are in line bits a second.
    """

    _: KW_ONLY
    total_bps: int
    least_base_bps: int
    """The lowest B_v at which x265 follows its target (`rate.least_base_bps`)."""
    metadata_bps: int = 0
    """The rate of the ``tracks`` channel: part of neither the base's share nor the stills'."""
    visible_base_bps: int = 160_000
    """Rate below which the base loses more objects than stills give back (1280x720 at 15 fps)."""
    least_still_share: float = 0.05
    """Least share of stills, for new tracks and for stills that a ground requests."""
    most_still_share: float = 0.35
    most_sparse_share: float = 1.0
    """Most of the base while not all frames are coded: each takes the longer on the line the more bits it has."""
    horizon_s: float = 5.0
    """Time in which the waiting need is to be worked off."""
    full_gain: float = 0.3
    """A track with this expected gain (M6) counts as one whole still; one with less as a part of it."""
    memory_s: float = 3.0
    """Time constant with which the need is averaged."""
    least_change: float = 0.05
    """Least change, as a share of the budget; a smaller one is not worth the opening of an encoder."""
    own_change: float = 0.1
    """Change, as a share of the budget, that is worth a keyframe of its own."""
    own_rest_s: float = 20.0
    """The least time between two of these, and before the first: a keyframe on a thin link is visible for seconds."""
    share: float = FIRST_SHARE
    """The base's share of the budget: the first, then the one last proposed."""

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        """Held by a caller that sets values and reads the share that follows."""
        self._gain = ExpectedGain()
        self._stills, self._sparse = True, False
        self._need_bytes = 0.0
        self._shown = 1.0
        self._observed_ns: int | None = None
        self._changed_ns = 0
        """The time of the last change of the share."""

    def observe(self, candidates: Sequence[Candidate], step: Step) -> None:
        """Observe all tracks of a decision step, resting ones included."""
        need_bytes = sum(self._need(one, step) for one in candidates)
        doubts = [self._gain.doubt(one, from_source=step.from_source) for one in candidates]
        shown = 1 - sum(doubts) / len(doubts) if doubts else 1.0
        decay = 0.0
        if self._observed_ns is None:
            self._changed_ns = step.now_ns
        else:
            decay = math.exp(-max(0, step.now_ns - self._observed_ns) / 1e9 / self.memory_s)
        with self.lock:
            self._need_bytes = decay * self._need_bytes + (1 - decay) * need_bytes
            self._shown = decay * self._shown + (1 - decay) * shown
            self._observed_ns = step.now_ns

    def set_total(self, total_bps: int) -> None:
        """Set another budget; the share stays as it is, unless x265 could not follow it any more."""
        self.total_bps = total_bps
        self.share = max(self.share, min(1.0, self.least_base_bps / total_bps))

    def set_beside(self, *, metadata_bps: int, stills: bool, sparse: bool) -> None:
        """Set whether stills are sent from now on; without them the base has their share.

        ``sparse``: not all source frames are coded.
        """
        self.metadata_bps, self._stills, self._sparse = metadata_bps, stills, sparse

    def propose(self) -> float | None:
        """The base's share of the budget from the keyframe that is due now; None to leave it as it is."""
        if self._observed_ns is None:
            return None
        share = self._target()
        over = self._sparse and self.share > self._most_sparse_share()
        if abs(share - self.share) < self.least_change - 1e-9 and not over:
            return None
        self.share, self._changed_ns = share, self._observed_ns
        return share

    def wants_keyframe(self, now_ns: int) -> bool:
        """Whether the scene has changed so much that the split should not wait for the next keyframe."""
        if self._observed_ns is None or now_ns - self._changed_ns < self.own_rest_s * 1e9:
            return False
        return abs(self._target() - self.share) >= self.own_change - 1e-9

    def _target(self) -> float:
        share = 1 - self._metadata_share() - self._still_share()
        return round(min(share, self._most_sparse_share()) if self._sparse else share, 2)

    def _most_sparse_share(self) -> float:
        return max(self.most_sparse_share, min(1.0, self.least_base_bps / self.total_bps))

    def _need(self, candidate: Candidate, step: Step) -> float:
        part = min(1.0, self._gain.gain(candidate, step) / self.full_gain)
        return part * (step.cost.of(candidate) + step.still_overhead_bytes)

    def _still_share(self) -> float:
        if not self._stills:
            return 0.0
        wanted = 8 * self._need_bytes / self.horizon_s / self.total_bps
        wanted = min(self.most_still_share, max(self.least_still_share, wanted))
        # The least for the base: the more of the objects it shows by itself, the higher.
        floor_bps = self.least_base_bps + self._shown * max(0, self.visible_base_bps - self.least_base_bps)
        return max(0.0, min(wanted, 1 - self._metadata_share() - floor_bps / self.total_bps))

    def _metadata_share(self) -> float:
        return self.metadata_bps / self.total_bps
