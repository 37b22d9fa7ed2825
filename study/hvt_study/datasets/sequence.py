"""The parts of a dataset: sequences with labels by source frame, and the clips that flights play.

A clip is small, and it can be sent to another process: the pictures are read when they are played, one at a time,
from the source or from a file of raw pixels that processes share (`stage_clip`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np

from hvt_common.units import exact_rate
from hvt_common.values import Frame, Image, View
from hvt_edge.source.contract import Source
from hvt_edge.source.folder import sequence_files
from hvt_edge.source.opening import open_source
from hvt_edge.source.resample import Resizer, capture_time_ns
from hvt_scene import CodeInView
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.virtual_camera import SCHEME, open_camera

NOMINAL_FPS = 15.0
"""Frames of a clip a second: the ground's list is judged at each of them, coded or not."""
_ANY_SIZE = (64, 64)  # of base frames, which are made for each flight anew
_MOST_SHARED_BYTES = 4 << 30


@dataclass(frozen=True, slots=True)
class Clip:
    """Pictures at `NOMINAL_FPS`, in a file that processes share, or read again from a large source."""

    spec: str
    """A value of ``--source`` that ends by itself: a video, a folder of images, ``demo``; or ``still:PICTURE``."""
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    frame_count: int
    pixels: Path | None = None
    """(frames, height, width, 3) uint8 BGR, raw; None where the source is read again."""
    source_fps: float | None = None
    """Rate at which the images of a folder were taken, or one that overrides a video's time stamps; None: 15 for a
    folder, the video's own."""
    seed: int = 0
    """Seed of the demo's scene, or of the way of the camera over a picture."""

    def images(self) -> Generator[Image, None, None]:
        if self.pixels is None:
            yield from self._read()
            return
        wide, high = self.source_size
        with self.pixels.open("rb") as file:  # not mapped: resident memory would grow with the clip
            for _ in range(self.frame_count):
                image = np.empty((high, wide, 3), np.uint8)
                if file.readinto(image.data.cast("B")) < image.nbytes:
                    return
                yield image

    def _read(self) -> Iterator[Image]:
        if self.spec.startswith(SCHEME):
            camera = open_camera(self.spec, fps=NOMINAL_FPS, seed=self.seed)
            return islice(camera.images(), self.frame_count)
        source = open_source(
            self.spec,
            size=_ANY_SIZE,
            fps=NOMINAL_FPS,
            max_frames=self.frame_count,
            source_fps=self.source_fps,
            seed=self.seed,
        )
        return (frame.source_bgr for frame in source.frames(start_ns=0))


class FrameSource(Source):
    """A clip as a source of the edge that gives only some of the frames; ``frame.index`` counts all of them."""

    live = False

    def __init__(self, clip: Clip, resizer: Resizer, *, frames: frozenset[int]) -> None:
        self._clip, self._resizer, self._chosen = clip, resizer, frames
        self.view: View = resizer.view
        self.fps = NOMINAL_FPS
        self.frame_count = len(frames)
        self.class_names: tuple[str, ...] = ()

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The chosen frames from the beginning."""
        rate = exact_rate(NOMINAL_FPS)
        for index, image in enumerate(self._clip.images()):
            if index in self._chosen:
                capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
                yield self._resizer.frame(np.asarray(image), index=index, capture_ns=capture_ns)


def stage_clip(clip: Clip, path: Path) -> Clip:
    """The clip with its pixels in a file of this path, so that every flight need not decode or draw.

    The very same clip where it is large (over 4 GiB), or the disk is full: the file is of no use then.
    """
    if not staged_bytes(clip):
        return clip
    count = 0
    try:
        with path.open("wb") as file, closing(clip.images()) as images:
            for image in images:
                file.write(np.ascontiguousarray(image).data)
                count += 1
    except OSError:
        return clip
    return replace(clip, pixels=path, frame_count=min(count, clip.frame_count)) if count else clip


def staged_bytes(clip: Clip) -> int:
    """The bytes that `stage_clip` takes of its folder, if there is room; 0 where it leaves the clip as it is."""
    wide, high = clip.source_size
    size_bytes = clip.frame_count * wide * high * 3
    return 0 if clip.pixels is not None or size_bytes > _MOST_SHARED_BYTES else size_bytes


@dataclass(frozen=True, slots=True)
class Sequence:
    """One sequence. Small, and it can be sent to another process; pictures and labels are read when asked for."""

    name: str
    """Unique within the dataset."""
    dataset: str
    """Scheme of its URI: ``visdrone``, ``uavdt``, ``mot``, ``clips``, ``demo`` or ``still``."""
    clip: Clip
    """The clip of a flight, ``clip.frame_count`` frames at 15 a second."""
    frame_count: int
    """Source frames of the whole sequence, of which `limited` takes nothing away."""
    fps: float
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    labels: Callable[[int], FrameLabels] | None
    """By source frame, 0 … ``frame_count`` - 1; None where nobody has labelled it."""
    class_set: tuple[str, ...]
    """Classes that the annotations may use, sorted: the same for all sequences of a dataset, whether each has them or
    not, so that names are compared alike in all of them."""
    one_target: bool = False
    """One object is labelled and nothing else that is in view: it is found or missed, and no box is known to be
    wrong."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """Further facts, such as ``weather: fog``."""
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
        """Duration of the whole sequence, however little of it is played."""
        return self.frame_count / self.fps

    def source_frame(self, frame_index: int) -> int:
        """The source frame that a frame of the clip shows: the latest one at or before its time."""
        if self.source_frames is not None:
            return self.source_frames[min(frame_index, len(self.source_frames) - 1)]
        return min(shown_frame(frame_index, fps=self.fps), self.frame_count - 1)

    def labels_at(self, frame_index: int) -> FrameLabels | None:
        """The labels of a frame of the clip; None without labels."""
        return None if self.labels is None else self.labels(self.source_frame(frame_index))

    def limited(self, frames: int | None) -> Sequence:
        """At most so many frames from the beginning; None: all."""
        if frames is None or frames >= self.clip_frames:
            return self
        return replace(self, clip=replace(self.clip, frame_count=frames))


def shown_frame(frame_index: int, *, fps: float) -> int:
    """The latest of source frames taken ``fps`` times a second at or before a frame of the clip, exactly."""
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
