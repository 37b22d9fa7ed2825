"""The clip that all flights of one comparison fly over: its pictures, opened once, and what is really in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_common.values import Frame, Image, View
from hvt_edge.resample import Resizer, capture_time_ns, exact_rate
from hvt_edge.source import open_source
from hvt_edge.sources.contract import Source
from hvt_edge.sources.demo import DemoSource
from hvt_study.list_score import Listed
from hvt_study.virtual_camera import SCHEME, open_camera

__all__ = ["TICK_FPS", "Clip", "TickSource", "clip_name", "share_clip"]

TICK_FPS = 15.0
"""At so many ticks a second the list of the ground is judged, whatever is coded."""
_ANY_SIZE = (64, 64)  # of base frames, which are made for each flight anew
_LEAST_VISIBLE = 0.5
_MOST_SHARED_BYTES = 4 << 30


@dataclass(frozen=True, slots=True)
class Clip:
    """Pictures at `TICK_FPS`, in a file that all processes map, or read again from the source where that is large."""

    spec: str
    source_size: tuple[int, int]
    """(width, height) in pixels."""
    ticks: int
    pixels: Path | None
    """(ticks, height, width, 3) uint8 BGR, raw; None where the source is read again."""
    truth: tuple[Listed, ...] | None
    """What is in each picture, boxes in *source* pixels; None where the source does not know."""
    class_names: tuple[str, ...] = ()
    """Of the truth."""

    def images(self) -> Iterator[Image]:
        """Every picture, in order."""
        if self.pixels is None:
            yield from _open(self.spec, most=self.ticks).images()
            return
        wide, high = self.source_size
        shape = (self.ticks, high, wide, 3)
        yield from np.memmap(self.pixels, np.uint8, mode="r", shape=shape)


class TickSource(Source):
    """A clip as a source of the edge that gives only some of the ticks; ``frame.index`` counts ticks all the same."""

    live = False

    def __init__(self, clip: Clip, resizer: Resizer, *, ticks: frozenset[int]) -> None:
        self._clip, self._resizer, self._ticks = clip, resizer, ticks
        self.view: View = resizer.view
        self.fps = TICK_FPS
        self.frame_count = len(ticks)
        self.class_names = clip.class_names

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The chosen ticks from the beginning."""
        rate = exact_rate(TICK_FPS)
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


@dataclass(frozen=True, slots=True)
class _Reel:
    images: Callable[[], Iterator[Image]]
    truth: Callable[[int], Listed | None]
    """Of one of them, in its pixels."""


def _open(spec: str, *, most: int | None) -> _Reel:
    if spec.startswith(SCHEME):
        camera = open_camera(spec, fps=TICK_FPS)
        return _Reel(
            lambda: islice(camera.images(), most),
            lambda index: None if (seen := camera.truth(index)) is None else Listed(*seen),
        )
    source = open_source(spec, size=_ANY_SIZE, fps=TICK_FPS, max_frames=most)
    if source.live:
        source.close()
        raise UserError(f"clip {spec!r} is live: give a file, a folder of images, demo or {SCHEME}PICTURE")
    return _Reel(
        lambda: (frame.source_bgr for frame in source.frames(start_ns=0)),
        lambda index: _demo_truth(source, index) if isinstance(source, DemoSource) else None,
    )


def _demo_truth(source: DemoSource, index: int) -> Listed:
    truth, names = source.scene.truth(index / TICK_FPS), source.scene.class_names
    asked = truth.visible >= _LEAST_VISIBLE
    kinds = tuple(names[kind] for kind in truth.class_ids[asked].tolist())
    return Listed(truth.boxes_source_px[asked], kinds, truth.boxes_source_px[~asked])
