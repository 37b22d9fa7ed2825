"""The drawn demo scene, a sequence a seed, with exact labels: ``demo:0-4``, ``demo:1,5``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

from hvt_common.units import exact_rate
from hvt_edge.source.resample import base_frame_count
from hvt_scene import Scene
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_study.datasets.clip import NOMINAL_FPS, Clip
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.options import parse_numbers
from hvt_study.datasets.sequence import Sequence

__all__ = ["DemoLabels", "open_demo"]

_SIZE = (1920, 1080)
_LEAST_VISIBLE = 0.5
"""An object of which less is to be seen is not judged."""


@dataclass(frozen=True, slots=True)
class DemoLabels:
    """The drawn truth of a seed. Objects of which less than half is to be seen are passed over."""

    seed: int

    def __call__(self, index: int) -> FrameLabels:
        """Of the frame at ``index / 15`` seconds."""
        truth = _scene(self.seed).truth(index / NOMINAL_FPS)
        judged = truth.visible >= _LEAST_VISIBLE
        return FrameLabels(
            boxes_xyxy_px=truth.boxes_source_px[judged],
            ids=truth.ids[judged],
            class_names=tuple(CLASS_NAMES[kind] for kind in truth.class_ids[judged].tolist()),
            beside_xyxy_px=truth.boxes_source_px[~judged],
        )


def open_demo(uri: str, seeds: str) -> Mapping[str, Callable[[], Sequence]]:
    """The scenes of these seeds by name; `UserError` where they are no seeds."""
    return {f"demo-{seed}": partial(_open, seed) for seed in parse_numbers(uri, seeds)}


def _open(seed: int) -> Sequence:
    count = base_frame_count(exact_rate(Scene.duration_s), fps=exact_rate(NOMINAL_FPS))
    return Sequence(
        name=f"demo-{seed}",
        dataset="demo",
        clip=Clip("demo", _SIZE, count, seed=seed),
        frame_count=count,
        fps=NOMINAL_FPS,
        source_size=_SIZE,
        labels=DemoLabels(seed),
        class_set=tuple(sorted(CLASS_NAMES)),
    )


@lru_cache(maxsize=1)
def _scene(seed: int) -> Scene:
    return Scene(seed)
