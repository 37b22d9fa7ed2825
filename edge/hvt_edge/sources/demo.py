"""The drawn demo scene as a source."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.values import Fit, Frame
from hvt_edge.resample import BaseSize, Resizer, capture_time_ns, exact_rate
from hvt_edge.scene import Scene
from hvt_edge.scene.truth import frame_times, write_truth
from hvt_edge.sources.contract import Source

__all__ = ["DemoSource", "check_truth", "write_truth_of"]


class DemoSource(Source):
    """Twenty seconds of `Scene`, drawn in 1920x1080 at the base rate.

    Attributes:
        scene: what is drawn, with its ground truth; ``scene.truth(index / fps)`` belongs to frame ``index``.
    """

    live = False

    def __init__(self, *, size: BaseSize, fps: float, fit: Fit, seed: int, max_frames: int | None) -> None:
        self.scene = Scene(seed)
        self.class_names = self.scene.class_names
        self.fps = fps
        self._resizer = Resizer(self.scene.size, size, fit=fit)
        self.view = self._resizer.view
        whole = math.ceil(self.scene.duration_s * exact_rate(fps))
        self.frame_count = whole if max_frames is None else min(whole, max_frames)

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """The scene from its beginning."""
        rate = exact_rate(self.fps)
        for index, t_s in frame_times(self.scene.duration_s, self.fps):
            if index == self.frame_count:
                return
            capture_ns = capture_time_ns(index, fps=rate, start_ns=start_ns)
            yield self._resizer.frame(self.scene.image(t_s), index=index, capture_ns=capture_ns)


def check_truth(path: Path | None, source: Source) -> None:
    """Refuse ``--truth`` for a source that does not know what it shows; `UserError`."""
    if path is not None and not isinstance(source, DemoSource):
        raise UserError(f"--truth {path} is for --source demo: no other source knows its truth")


def write_truth_of(source: Source, path: Path | None, *, fps: float) -> None:
    """Write the demo's ground truth, where it is asked for."""
    if path is not None and isinstance(source, DemoSource):
        write_truth(source.scene, path, fps=fps, view=source.view)
