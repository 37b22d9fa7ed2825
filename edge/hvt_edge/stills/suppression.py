"""Temporal suppression: which candidates may be asked for at all at this step, in front of every method.

One stage for all methods, so that they differ in what they want and in nothing else. The paper's plain variants run
with it off (``--cooldown 0``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hvt_edge.perception.candidates import Candidate

__all__ = ["Suppression"]


@dataclass(frozen=True, slots=True)
class Suppression:
    """Holds back candidates; frozen, without state: all it needs is in the candidates."""

    cooldown_s: float = 2.0
    """A track that was sent rests this long; 0 is no rest."""
    min_gain: float = 1.2
    """Beyond the rest, it must have grown or sharpened by this factor since; 1 asks for nothing."""
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
        """What ``--cooldown`` means: 0 is off altogether; else the wait for a gain is five times as long.

        ``min_gain`` is ``--min-gain``.
        """
        if cooldown_s == 0:
            return cls(cooldown_s=0.0, min_gain=1.0, avoid_border=False)
        return cls(cooldown_s=cooldown_s, min_gain=min_gain, gain_s=5 * cooldown_s)

    def apply(
        self, candidates: Sequence[Candidate], *, now_ns: int
    ) -> tuple[list[Candidate], list[tuple[Candidate, str]]]:
        """Split into those that may go on and those held, each with ``refused cooldown border no_gain``."""
        kept: list[Candidate] = []
        held: list[tuple[Candidate, str]] = []
        for candidate in candidates:
            reason = self._reason(candidate, now_ns)
            if reason is None:
                kept.append(candidate)
            else:
                held.append((candidate, reason))
        return kept, held

    def _reason(self, candidate: Candidate, now_ns: int) -> str | None:
        if _since_s(candidate.last_refused_ns, now_ns) < self.retry_s:
            return "refused"
        rested_s = _since_s(candidate.last_sent_ns, now_ns)
        if rested_s < self.cooldown_s:
            return "cooldown"
        if self.avoid_border and candidate.touches_border and self._waits_at_border(candidate):
            return "border"
        # Last, because it may have to look at pixels.
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


def _since_s(then_ns: int | None, now_ns: int) -> float:
    return float("inf") if then_ns is None else (now_ns - then_ns) / 1e9
