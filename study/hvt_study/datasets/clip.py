"""The clip that all flights of one comparison fly over: its pictures, opened once, and what is really in them.

A clip is small, and it can be sent to another process: the pictures are read when they are played, one at a time,
from the source or from a file of raw pixels that processes share (`stage_clip`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import cast

import numpy as np

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_common.values import Frame, Image, View
from hvt_edge.source.contract import Source
from hvt_edge.source.demo import DemoSource
from hvt_edge.source.opening import open_source
from hvt_edge.source.resample import Resizer, capture_time_ns
from hvt_scene import Scene
from hvt_study.datasets.virtual_camera import SCHEME, open_camera
from hvt_study.metrics.list_score import Listed

__all__ = [
    "DEMO_LEAST_VISIBLE",
    "NOMINAL_FPS",
    "Clip",
    "FrameSource",
    "clip_name",
    "share_clip",
    "stage_clip",
    "staged_bytes",
]

NOMINAL_FPS = 15.0
"""At so many ticks a second the list of the ground is judged, whatever is coded."""
_ANY_SIZE = (64, 64)  # of base frames, which are made for each flight anew
DEMO_LEAST_VISIBLE = 0.5
"""An object of the demo of which less is to be seen is not asked for."""
_MOST_SHARED_BYTES = 4 << 30


@dataclass(frozen=True, slots=True)
class Clip:
    """Pictures at `NOMINAL_FPS`, in a file that processes share, or read again from a large source."""

    spec: str
    """What ``--source`` takes, if it ends by itself: a video, a folder of images, ``demo``; or ``still:PICTURE``."""
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    ticks: int
    pixels: Path | None
    """(ticks, height, width, 3) uint8 BGR, raw; None where the source is read again."""
    truth: tuple[Listed, ...] | None
    """What is in each picture, boxes in *source* pixels; None where the source does not know."""
    class_names: tuple[str, ...] = ()
    """Of the truth."""
    source_fps: float | None = None
    """Rate at which the images of a folder were taken, or one that overrides a video's time stamps; None: 15 for a
    folder, the video's own."""
    seed: int = 0
    """Of the demo's scene, or of the way of the camera over a picture."""

    def images(self) -> Generator[Image, None, None]:
        """Every picture, in order."""
        if self.pixels is None:
            yield from _open(
                self.spec, most=self.ticks, source_fps=self.source_fps, seed=self.seed, annotated=False
            ).images()
            return
        wide, high = self.source_size
        with self.pixels.open("rb") as file:  # not mapped: what is resident would grow with the clip
            for _ in range(self.ticks):
                image = np.empty((high, wide, 3), np.uint8)
                if file.readinto(image.data.cast("B")) < image.nbytes:
                    return
                yield image


class FrameSource(Source):
    """A clip as a source of the edge that gives only some of the ticks; ``frame.index`` counts ticks all the same."""

    live = False

    def __init__(self, clip: Clip, resizer: Resizer, *, ticks: frozenset[int]) -> None:
        self._clip, self._resizer, self._ticks = clip, resizer, ticks
        self.view: View = resizer.view
        self.fps = NOMINAL_FPS
        self.frame_count = len(ticks)
        self.class_names = clip.class_names

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The chosen ticks from the beginning."""
        rate = exact_rate(NOMINAL_FPS)
        for index, image in enumerate(self._clip.images()):
            if index in self._ticks:
                capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
                yield self._resizer.frame(np.asarray(image), index=index, capture_ns=capture_ns)


def clip_name(spec: str) -> str:
    """How a clip is called in tables: the file without folder and ending."""
    name = Path(spec.removeprefix(SCHEME)).name
    return Path(name.partition("@")[0]).stem or spec


def share_clip(spec: str, *, max_frames: int | None, folder: Path) -> Clip:
    """Read a clip once, into a file in ``folder``.

    ``spec`` is what ``--source`` takes, if it ends by itself, or ``still:PICTURE``.

    Raises:
        UserError: nothing usable is there, or it is live.
    """
    reel = _open(spec, most=max_frames)
    path: Path | None = folder / "clip.bgr"
    size, held_bytes, truth = (0, 0), 0, []
    with (folder / "clip.bgr").open("wb") as file:
        for index, image in enumerate(reel.images()):
            size = image.shape[1], image.shape[0]
            truth.append(reel.truth(index))
            held_bytes += image.nbytes
            if held_bytes > _MOST_SHARED_BYTES:
                path = None
            else:
                file.write(np.ascontiguousarray(image).data)
    if path is None:
        (folder / "clip.bgr").unlink()
    known = tuple(one for one in truth if one is not None)
    names = tuple(sorted({name for one in known for name in one.classes}))
    return Clip(spec, size, len(truth), path, known or None, names)


def stage_clip(clip: Clip, *, folder: Path) -> Clip:
    """The clip with its pixels in a file in ``folder``, which is there, so that every flight need not decode or draw.

    The very same clip where it is large (over 4 GiB), or the disk is full; nothing is left behind then.
    """
    if not staged_bytes(clip):
        return clip
    path = folder / "clip.bgr"
    count = 0
    try:
        with path.open("wb") as file, closing(clip.images()) as images:
            for image in images:
                file.write(np.ascontiguousarray(image).data)
                count += 1
    except OSError:
        path.unlink(missing_ok=True)
        return clip
    if not count:
        path.unlink()
        return clip
    return replace(clip, pixels=path, ticks=min(count, clip.ticks))


def staged_bytes(clip: Clip) -> int:
    """What `stage_clip` takes of its folder, if there is room; 0 where it leaves the clip as it is."""
    wide, high = clip.source_size
    size_bytes = clip.ticks * wide * high * 3
    return 0 if clip.pixels is not None or size_bytes > _MOST_SHARED_BYTES else size_bytes


@dataclass(frozen=True, slots=True)
class _Reel:
    images: Callable[[], Iterator[Image]]
    truth: Callable[[int], Listed | None]
    """Of one of them, in its pixels."""


def _open(
    spec: str,
    *,
    most: int | None,
    source_fps: float | None = None,
    seed: int = 0,
    annotated: bool = True,
) -> _Reel:
    if spec.startswith(SCHEME):
        camera = open_camera(spec, fps=NOMINAL_FPS, seed=seed, annotated=annotated)
        return _Reel(
            lambda: islice(camera.images(), most),
            lambda index: None if (seen := camera.truth(index)) is None else Listed(*seen),
        )
    source = open_source(
        spec, size=_ANY_SIZE, fps=NOMINAL_FPS, max_frames=most, source_fps=source_fps, seed=seed
    )
    if source.live:
        source.close()
        raise UserError(f"clip {spec!r} is live: give a file, a folder of images, demo or {SCHEME}PICTURE")
    return _Reel(
        lambda: (frame.source_bgr for frame in source.frames(start_ns=0)),
        lambda index: _demo_truth(source, index) if isinstance(source, DemoSource) else None,
    )


def _demo_truth(source: DemoSource, index: int) -> Listed:
    scene = cast(Scene, source.scene)
    truth, names = scene.truth(index / NOMINAL_FPS), scene.class_names
    asked = truth.visible >= DEMO_LEAST_VISIBLE
    kinds = tuple(names[kind] for kind in truth.class_ids[asked].tolist())
    return Listed(truth.boxes_source_px[asked], kinds, truth.boxes_source_px[~asked])
