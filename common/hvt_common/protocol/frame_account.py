"""The outcome of each source frame of a flight: the groups, and the one sentence that names them.

Each frame is in exactly one group. The edge counts (`hvt_edge.loop.counts`), `Status` carries the counts, and status
line, summary, page and JSON of both sides show this value, so that their numbers add up to the frames that came.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, Self, get_args

FrameGroup = Literal[
    "sent",
    "nobody_listened",
    "stored",
    "frame_rate",
    "budget",
    "link",
    "processor",
    "closer_look",
    "unreadable",
    "encoder",
]
"""Their order is that of the counts on the wire: a new one stands last."""

FRAME_GROUPS: Mapping[FrameGroup, str] = MappingProxyType(
    {
        "sent": "sent",
        "nobody_listened": "coded while nobody listened",
        "stored": "stored for later",
        "frame_rate": "left out by {frame_rate}",
        "budget": "had no room in the budget",
        "link": "the link did not carry",
        "processor": "the processor had no time for",
        "closer_look": "left out for a closer look",
        "unreadable": "damaged at the source",
        "encoder": "the encoder failed on",
    }
)
"""Group → the text behind its number."""

assert tuple(FRAME_GROUPS) == get_args(FrameGroup), "one order"


@dataclass(frozen=True, slots=True)
class FrameAccount:
    """Number of source frames in each group. Groups without a frame may be missing."""

    groups: Mapping[FrameGroup, int] = field(default_factory=dict)
    coded_fps: float = 0.0
    """Frames a second that the frame rate leaves now; 0 where that is not known."""
    auto_fps: bool = False
    """``--fps auto`` chose it."""

    @property
    def came(self) -> int:
        """All frames that the source gave."""
        return sum(self.groups.values())

    @property
    def dropped(self) -> int:
        """Given up before encoding, for any reason but the frame rate and the source's own damage."""
        return sum(
            self.groups.get(name, 0) for name in ("budget", "link", "processor", "closer_look", "encoder")
        )

    def __str__(self) -> str:
        """Such as ``220 frames came: 71 sent, 50 left out by auto's 7.5 a second, 81 had no room in the budget``."""
        frames = "1 frame" if self.came == 1 else f"{self.came} frames"
        said = [
            f"{self.groups[name]} {text.format(frame_rate=self._frame_rate)}"
            for name, text in FRAME_GROUPS.items()
            if self.groups.get(name)
        ]
        return f"{frames} came: {', '.join(said)}" if said else "no frame came"

    @property
    def _frame_rate(self) -> str:
        if not self.coded_fps:
            return "the frame rate"
        whose = "auto's" if self.auto_fps else "the frame rate of"
        return f"{whose} {self.coded_fps:.3g} a second"

    def as_counts(self) -> tuple[int, ...]:
        """For the wire: the groups' counts in their order, without zeros at the end."""
        counts = [self.groups.get(name, 0) for name in FRAME_GROUPS]
        while counts and not counts[-1]:
            counts.pop()
        return tuple(counts)

    @classmethod
    def of_counts(cls, counts: Sequence[int], *, coded_fps: float, auto_fps: bool) -> Self:
        """Read the result of `as_counts`; further groups of a later version are ignored."""
        groups = {name: count for name, count in zip(FRAME_GROUPS, counts, strict=False) if count}
        return cls(groups, coded_fps, auto_fps)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: ``came``, each group by name, zeros included, and the sentence as ``text``."""
        return {
            "came": self.came,
            **{name: self.groups.get(name, 0) for name in FRAME_GROUPS},
            "text": str(self),
        }
