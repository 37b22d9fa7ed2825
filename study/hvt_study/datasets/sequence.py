"""What a dataset is made of: sequences that a flight can play, with labels by source frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hvt_common.units import exact_rate
from hvt_study.datasets.clip import NOMINAL_FPS, Clip
from hvt_study.datasets.labels import NO_ID, UNKNOWN, FrameLabels

__all__ = ["NO_ID", "UNKNOWN", "FrameLabels", "Sequence", "shown_frame"]


@dataclass(frozen=True, slots=True)
class Sequence:
    """One sequence. Small, and it can be sent to another process; pictures and labels are read when asked for."""

    name: str
    """Unique within the dataset."""
    dataset: str
    """Scheme of its URI: ``visdrone``, ``uavdt``, ``mot``, ``clips``, ``demo`` or ``still``."""
    clip: Clip
    """What the flight plays, ``clip.ticks`` ticks at 15 a second."""
    frame_count: int
    """Source frames of the whole sequence, of which `cut` takes nothing away."""
    fps: float
    """Source frames a second."""
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    labels: Callable[[int], FrameLabels] | None
    """By source frame, 0 … ``frame_count`` - 1; None where nobody has said what is there."""
    class_set: tuple[str, ...]
    """Classes that the annotations may use, sorted: the same for all sequences of a dataset, whether each has them or
    not, so that names are compared alike in all of them."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """What else is known, such as ``weather: fog``."""
    files: tuple[Path, ...] = ()
    """Everything that its pictures and labels are made from: files, and folders of images."""
    tick_frames: tuple[int, ...] | None = None
    """Source frame of each tick where the frame rate is not constant; None where `shown_frame` says it."""

    @property
    def ticks(self) -> int:
        """How many ticks the flight plays."""
        return self.clip.ticks

    @property
    def duration_s(self) -> float:
        """Of the whole sequence, however little of it is played."""
        return self.frame_count / self.fps

    def frame_at_tick(self, tick: int) -> int:
        """The source frame that a tick shows: the latest one at or before its time."""
        if self.tick_frames is not None:
            return self.tick_frames[min(tick, len(self.tick_frames) - 1)]
        return min(shown_frame(tick, fps=self.fps), self.frame_count - 1)

    def labels_at_tick(self, tick: int) -> FrameLabels | None:
        """What is in the picture that a tick shows; None without labels."""
        return None if self.labels is None else self.labels(self.frame_at_tick(tick))

    def cut(self, ticks: int | None) -> Sequence:
        """At most so many ticks from the beginning; None: all."""
        if ticks is None or ticks >= self.ticks:
            return self
        return replace(self, clip=replace(self.clip, ticks=ticks))


def shown_frame(tick: int, *, fps: float) -> int:
    """The latest of frames taken ``fps`` times a second at or before a tick, the first at 0, in exact fractions."""
    return int(tick * exact_rate(fps) / exact_rate(NOMINAL_FPS))
