"""Which candidates may get a still at this step, before every method: temporal suppression, then the gate.

One stage for all methods, so that they differ in what they request and in nothing else. The paper's plain variants
run with suppression off (``--cooldown 0``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hvt_edge.perception.candidates import Candidate
from hvt_edge.perception.crop import BaseLoss


@dataclass(frozen=True, slots=True)
class Suppression:
    """Holds back candidates; frozen, without state: all it needs is in the candidates."""

    cooldown_s: float = 2.0
    """A track that was sent rests this long; 0 is no rest."""
    min_gain: float = 1.2
    """Beyond the rest, it must have grown or sharpened by this factor since; 1 demands nothing."""
    gain_s: float = 10.0
    """After this long without a still, it needs no gain any more."""
    avoid_border: bool = True
    """Wait for the whole object where it is only partly in the picture."""
    border_s: float = 1.0
    """The longest such wait for a track of which nothing was sent yet."""
    retry_s: float = 1.0
    """A track that the still stage refused rests this long; on in the plain variants too, for it costs time only."""

    @classmethod
    def for_cooldown(cls, cooldown_s: float, *, min_gain: float = 1.2) -> Suppression:
        """``--cooldown``: 0 is off; else the wait for a gain (``--min-gain``) is five times as long."""
        if cooldown_s == 0:
            return cls(cooldown_s=0.0, min_gain=1.0, avoid_border=False)
        return cls(cooldown_s=cooldown_s, min_gain=min_gain, gain_s=5 * cooldown_s)

    def apply(
        self, candidates: Sequence[Candidate], *, now_ns: int
    ) -> tuple[list[Candidate], list[tuple[Candidate, str]]]:
        """Split into those that may go on and those held, each with ``refused cooldown border no_gain``."""
        allowed: list[Candidate] = []
        held: list[tuple[Candidate, str]] = []
        for candidate in candidates:
            reason = self._reason(candidate, now_ns)
            if reason is None:
                allowed.append(candidate)
            else:
                held.append((candidate, reason))
        return allowed, held

    def _reason(self, candidate: Candidate, now_ns: int) -> str | None:
        if _since_s(candidate.last_refused_ns, now_ns) < self.retry_s:
            return "refused"
        rested_s = _since_s(candidate.last_sent_ns, now_ns)
        if rested_s < self.cooldown_s:
            return "cooldown"
        if self.avoid_border and candidate.touches_border and self._waits_at_border(candidate):
            return "border"
        # Last, because it may have to read pixels.
        if rested_s < self.gain_s and not self._gained(candidate):
            return "no_gain"
        return None

    def _waits_at_border(self, candidate: Candidate) -> bool:
        if candidate.sent_count and not candidate.last_sent_at_border:
            return True  # the ground has it whole; a part adds nothing
        # One that leaves will not get better. One that enters gets its time, and no more, so that an object that
        # only ever touches the border is seen once all the same.
        return not candidate.leaving and candidate.border_s < self.border_s

    def _gained(self, candidate: Candidate) -> bool:
        if self.min_gain <= 1 or candidate.last_sent_area_px is None:
            return True
        if candidate.area_px >= self.min_gain * candidate.last_sent_area_px:
            return True
        if candidate.last_sent_at_border and not candidate.touches_border:
            return True  # whole at last
        if candidate.sharpness is None or candidate.last_sent_sharpness is None:
            return False
        return candidate.sharpness() >= self.min_gain * candidate.last_sent_sharpness


@dataclass(frozen=True, slots=True)
class Gate:
    """Refuses a still where the base shows enough; refuses nothing at 0 dB. Frozen, without state.

    The edge decodes its own stream and knows what the base lost of each candidate (`BaseLoss`). Both conditions have
    to hold, because each has its blind spot: PSNR is high on a dark or smooth object whatever became of its edges,
    and lost detail is small on a coarse object that is plainly wrong in colour. docs/stills.md has the figures.
    """

    psnr_y_db: float = 0.0
    """Luma PSNR of the base crop from which on the base counts as good; 0: no gate."""
    most_detail_lost: float = 0.4
    """Nor may the base have lost more than this share of the crop's detail (`BaseLoss.detail_lost`)."""

    @property
    def on(self) -> bool:
        """Whether anything is ever refused."""
        return self.psnr_y_db > 0

    def good_enough(self, loss: BaseLoss) -> bool:
        """Whether the base shows it so well that a still is not worth its bits."""
        return self.on and loss.psnr_y_db >= self.psnr_y_db and loss.detail_lost <= self.most_detail_lost


def _since_s(then_ns: int | None, now_ns: int) -> float:
    return float("inf") if then_ns is None else (now_ns - then_ns) / 1e9
