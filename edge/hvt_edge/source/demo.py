"""The drawn demo scene as a source. Who draws it says so by the entry point ``demo`` in the group ``hvt.scenes``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from hvt_common.errors import UserError
from hvt_common.units import exact_rate
from hvt_common.values import Fit, Frame, Image, View
from hvt_edge.source.contract import BaseSize, Source
from hvt_edge.source.resample import Resizer, capture_time_ns

__all__ = ["DemoSource", "DrawnScene", "check_truth", "write_truth_of"]


class DrawnScene(Protocol):
    """What a drawn scene is to the edge; made by ``scene(seed)``."""

    size: tuple[int, int]
    """(width, height) of its pictures in pixels."""
    class_names: tuple[str, ...]
    duration_s: float

    def image(self, t_s: float) -> Image:
        """The picture at a moment: BGR, uint8, (height, width, 3)."""
        ...

    def write_truth(self, path: Path, *, fps: float, view: View) -> int:
        """Write the ground truth of a flight at that rate as MOTChallenge's gt.txt, in base pixels."""
        ...


class DemoSource(Source):
    """The demo scene from its beginning to its end, at the base rate.

    The frame at ``index`` shows ``scene`` at the moment ``index / fps``. Raises `UserError` where no scene is
    installed.
    """

    live = False

    def __init__(self, *, size: BaseSize, fps: float, fit: Fit, seed: int, max_frames: int | None) -> None:
        self.scene = _open_scene(seed)
        self.class_names = self.scene.class_names
        self.fps = fps
        self._resizer = Resizer(self.scene.size, size, fit=fit)
        self.view = self._resizer.view
        whole = math.ceil(self.scene.duration_s * exact_rate(fps))
        self._count = whole if max_frames is None else min(whole, max_frames)
        self.frame_count = self._count

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The scene from its beginning."""
        rate = exact_rate(self.fps)
        for index in range(self._count):
            capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
            image = self.scene.image(float(index / rate))
            yield self._resizer.frame(image, index=index, capture_ns=capture_ns)


def _open_scene(seed: int) -> DrawnScene:
    for entry in entry_points(group="hvt.scenes", name="demo"):
        scene: DrawnScene = entry.load()(seed)
        return scene
    raise UserError("--source demo: no package installed here draws a scene; install hvt whole")


def check_truth(path: Path | None, source: Source) -> None:
    """Refuse ``--truth`` for a source that does not know what it shows; `UserError`."""
    if path is not None and not isinstance(source, DemoSource):
        raise UserError(f"--truth {path} is for --source demo: no other source knows its truth")


def write_truth_of(source: Source, path: Path | None, *, fps: float) -> None:
    """Write the demo's ground truth, where it is asked for."""
    if path is not None and isinstance(source, DemoSource):
        source.scene.write_truth(path, fps=fps, view=source.view)
