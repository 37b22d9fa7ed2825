"""What a dataset is made of: sequences that a flight can play, with labels by source frame."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hvt_common.units import exact_rate
from hvt_edge.source.folder import sequence_files
from hvt_scene import CodeInView
from hvt_study.datasets.clip import NOMINAL_FPS, Clip
from hvt_study.datasets.labels import FrameLabels


@dataclass(frozen=True, slots=True)
class Sequence:
    """One sequence. Small, and it can be sent to another process; pictures and labels are read when asked for."""

    name: str
    """Unique within the dataset."""
    dataset: str
    """Scheme of its URI: ``visdrone``, ``uavdt``, ``mot``, ``clips``, ``demo`` or ``still``."""
    clip: Clip
    """What the flight plays, ``clip.frame_count`` frames at 15 a second."""
    frame_count: int
    """Source frames of the whole sequence, of which `limited` takes nothing away."""
    fps: float
    """Source frames a second."""
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    labels: Callable[[int], FrameLabels] | None
    """By source frame, 0 … ``frame_count`` - 1; None where nobody has said what is there."""
    class_set: tuple[str, ...]
    """Classes that the annotations may use, sorted: the same for all sequences of a dataset, whether each has them or
    not, so that names are compared alike in all of them."""
    one_target: bool = False
    """One object is labelled and nothing else that is in view: it is found or missed, and no box is known to be
    wrong."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """What else is known, such as ``weather: fog``."""
    files: tuple[Path, ...] = ()
    """Everything that its pictures and labels are made from: files, and folders of images."""
    codes: Callable[[int], tuple[CodeInView, ...]] | None = None
    """Codes that can be read in a source frame; None where none were painted."""
    source_frames: tuple[int, ...] | None = None
    """Source frame of each frame of the clip where the rate is not constant; None where `shown_frame` says it."""

    @property
    def clip_frames(self) -> int:
        """How many frames the flight plays."""
        return self.clip.frame_count

    @property
    def duration_s(self) -> float:
        """Of the whole sequence, however little of it is played."""
        return self.frame_count / self.fps

    def source_frame(self, frame_index: int) -> int:
        """The source frame that a frame of the clip shows: the latest one at or before its time."""
        if self.source_frames is not None:
            return self.source_frames[min(frame_index, len(self.source_frames) - 1)]
        return min(shown_frame(frame_index, fps=self.fps), self.frame_count - 1)

    def labels_at(self, frame_index: int) -> FrameLabels | None:
        """What is in a frame of the clip; None without labels."""
        return None if self.labels is None else self.labels(self.source_frame(frame_index))

    def limited(self, frames: int | None) -> Sequence:
        """At most so many frames from the beginning; None: all."""
        if frames is None or frames >= self.clip_frames:
            return self
        return replace(self, clip=replace(self.clip, frame_count=frames))


def shown_frame(frame_index: int, *, fps: float) -> int:
    """Of source frames taken ``fps`` times a second, the latest at or before a frame of the clip, exactly."""
    return int(frame_index * exact_rate(fps) / exact_rate(NOMINAL_FPS))


def content_hash(sequence: Sequence) -> str:
    """SHA-256, hexadecimal, of the bytes of pictures and annotations and of how they are played, wherever they lie.

    It reads every file once: seconds for a sequence of a thousand images. The drawn demo is its seed.
    """
    digest = hashlib.sha256(f"{sequence.dataset} {sequence.fps:.9g} {sequence.clip.seed}".encode())
    digest.update(repr(sorted(sequence.attributes.items())).encode())
    for path in sequence.files:
        for file in sequence_files(path) if path.is_dir() else [path] * path.is_file():
            digest.update(f"\n{file.name} {file.stat().st_size}\n".encode())
            with file.open("rb") as stream:
                hashlib.file_digest(stream, lambda: digest)  # adds to the one that there is
    return digest.hexdigest()
