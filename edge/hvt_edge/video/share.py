"""``--video-share auto``: how much of the budget is the base stream's follows what there is to refine.

Stills get what it takes to work off the waiting need in some seconds; few tracks, or tracks whose class is settled,
leave the bits to the base. x265 cannot change its rate without being opened again, so a new split is proposed at
keyframes only, and only where it differs enough to be worth that.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

from hvt_edge.stills.policy.base import Step
from hvt_edge.stills.policy.m6 import ExpectedGain

if TYPE_CHECKING:
    from hvt_edge.perception.candidates import Candidate

FIRST_SHARE = 0.85
"""Of the budget, for the base, until the scene is known: between what served best on a car park (0.9) and on small
objects (0.8) at 200 kbps."""


@dataclass(eq=False)
class Split:
    """Watches decision steps, which may come from another thread, and proposes a share at keyframes.

    Rates are in line bits a second.
    """

    _: KW_ONLY
    total_bps: int
    least_base_bps: int
    """The lowest B_v at which x265 follows its target (`rate.least_base_bps`)."""
    metadata_bps: int = 0
    """The rate of the ``tracks`` channel: neither the base's nor the stills'."""
    visible_base_bps: int = 160_000
    """Below it the base loses objects that it would else show, more than stills give back (1280x720 at 15 fps)."""
    least_still_share: float = 0.05
    """For newcomers, and for stills that a ground asks for."""
    most_still_share: float = 0.35
    most_sparse_share: float = 1.0
    """For the base, while not all frames are coded: each takes the longer on the line the more bits it has."""
    horizon_s: float = 5.0
    """The need that waits is to be worked off in so long."""
    full_gain: float = 0.3
    """A track with this expected gain (M6) counts as one whole still; one with less as a part of it."""
    memory_s: float = 3.0
    """Time constant with which the need is averaged."""
    least_change: float = 0.05
    """Of the budget; a smaller change is not worth the opening of an encoder."""
    own_change: float = 0.1
    """Of the budget; a share that is off by so much is worth a keyframe of its own."""
    own_rest_s: float = 20.0
    """The least time between two of these, and before the first: a keyframe on a thin link is seen for seconds."""
    share: float = FIRST_SHARE
    """The base's share of the budget: the first, then the one last proposed."""

    def __post_init__(self) -> None:
        self.lock = threading.RLock()
        """Held by whoever says something and asks for the share that follows."""
        self._gain = ExpectedGain()
        self._stills, self._sparse = True, False
        self._need_bytes = 0.0
        self._shown = 1.0
        self._observed_ns: int | None = None
        self._changed_ns = 0
        """The time of the last change of the share."""

    def observe(self, candidates: Sequence[Candidate], step: Step) -> None:
        """Take in all tracks of a decision step, those that rest included."""
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
        """Another budget from now on; the share stays as it is, unless x265 could not follow it any more."""
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
        """Whether the scene has changed so much that the split should not wait for the next keyframe that comes."""
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
        return max(0.0, min(wanted, 1 - self._metadata_share() - self._floor_bps() / self.total_bps))

    def _floor_bps(self) -> float:
        # The least for the base: more, the more of the objects it shows by itself.
        least = self.least_base_bps
        return least + self._shown * max(0, self.visible_base_bps - least)

    def _metadata_share(self) -> float:
        return self.metadata_bps / self.total_bps
