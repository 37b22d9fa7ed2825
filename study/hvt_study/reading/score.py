"""From readings to figures: which codes were read right at least once, how soon, and which were misread."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hvt_scene import CodeInView
from hvt_study.datasets.clip import NOMINAL_FPS
from hvt_study.reading.reader import Reading

LEAST_VISIBLE = 0.95
"""A code of which less is in the frame and under no crown cannot be asked for at that moment."""
_LEAST_FRAMES = 15
"""A code that is whole in view for less than a second is not counted."""
_SURE = 0.5


@dataclass(frozen=True, slots=True)
class Code:
    """One code of a clip."""

    object_id: int
    text: str
    first_s: float
    """Media time at which it is first in view as a whole."""
    height_px: float
    """Median of its characters, source pixels."""


@dataclass(slots=True)
class Evidence:
    """What one channel has shown of one code: grows while a flight lasts."""

    read_s: float = math.inf
    """Media time at which the picture arrived that was first read right."""
    best: Reading | None = None
    """The first right reading, or before it the most confident one; None where there is none."""

    @property
    def right(self) -> bool:
        """Whether it was read right."""
        return math.isfinite(self.read_s)

    def add(self, reading: Reading, *, code: str, at_s: float) -> None:
        """One more reading; nothing changes once one was right."""
        if self.right:
            return
        right = reading.text == code
        if right:
            self.read_s = at_s
        if right or self.best is None or reading.confidence > self.best.confidence:
            self.best = reading


@dataclass(frozen=True, slots=True)
class ChannelScore:
    """Of one channel of one flight."""

    read: float | None
    """Share of the codes that were read right at least once; None where there are none."""
    median_s: float | None
    """Of the time from coming into view to the first right reading, over all codes; None where under half were."""
    misread: float | None
    """Share that was never read right, and once wrong with confidence as a code of the same length."""


def codes_to_read(views: Sequence[Iterable[CodeInView]]) -> dict[int, Code]:
    """The codes of a clip by object, from what is in view in each of its frames; those in view for a second."""
    seen: dict[int, list[tuple[int, CodeInView]]] = {}
    for frame_index, codes in enumerate(views):
        for one in codes:
            if one.visible >= LEAST_VISIBLE:
                seen.setdefault(one.object_id, []).append((frame_index, one))
    return {
        object_id: Code(
            object_id,
            found[0][1].text,
            found[0][0] / NOMINAL_FPS,
            statistics.median(one.height_px for _, one in found),
        )
        for object_id, found in sorted(seen.items())
        if len(found) >= _LEAST_FRAMES
    }


def channel_score(codes: Iterable[Code], evidence: Mapping[int, Evidence]) -> ChannelScore:
    """The figures of these codes; a code without evidence was never shown."""
    shown = [(code, evidence.get(code.object_id, Evidence())) for code in codes]
    if not shown:
        return ChannelScore(None, None, None)
    waits = [max(0.0, one.read_s - code.first_s) for code, one in shown]
    median_s = statistics.median(waits)
    wrong = sum(
        not one.right
        and one.best is not None
        and len(one.best.text) == len(code.text)
        and one.best.confidence >= _SURE
        for code, one in shown
    )
    return ChannelScore(
        sum(one.right for _, one in shown) / len(shown),
        median_s if math.isfinite(median_s) else None,
        wrong / len(shown),
    )
