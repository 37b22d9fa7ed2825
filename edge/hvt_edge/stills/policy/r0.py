"""R0: no stills; the encoder spends its bits on the tracks (``--roi-depth``). What every still has to beat."""

from __future__ import annotations

from dataclasses import dataclass, field

from hvt_edge.stills.policy.m0 import VideoOnly

__all__ = ["TracksFirst"]


@dataclass(frozen=True, slots=True)
class TracksFirst(VideoOnly):
    """Wants no stills, as M0; what is different is how the base stream is quantised."""

    name: str = field(default="R0", init=False)
