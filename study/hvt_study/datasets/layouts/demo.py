"""The drawn demo scene, a sequence a seed, with exact labels: ``demo:0-4``, ``demo:1,5``.

Words of the edge's source may stand among the seeds: ``demo:0-4,codes,4k`` (`hvt_scene.source`).
"""

from collections.abc import Callable, Mapping
from functools import lru_cache, partial

from hvt_common.units import exact_rate
from hvt_edge.source.resample import base_frame_count
from hvt_scene import CodeInView, Scene
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_scene.source import SCENE_WORDS, demo_scene
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.options import parse_numbers
from hvt_study.datasets.sequence import NOMINAL_FPS, Clip, Sequence

_SIZE = (1920, 1080)
_LEAST_VISIBLE = 0.5
"""An object of which less is to be seen is not judged."""


def demo_labels(seed: int, spec: str, index: int) -> FrameLabels:
    """The drawn truth of a seed, of the frame at ``index / 15`` seconds; mostly hidden objects are passed over."""
    truth = _scene(seed, spec).truth(index / NOMINAL_FPS)
    judged = truth.visible >= _LEAST_VISIBLE
    return FrameLabels(
        boxes_xyxy_px=truth.boxes_source_px[judged],
        ids=truth.ids[judged],
        class_names=tuple(CLASS_NAMES[kind] for kind in truth.class_ids[judged].tolist()),
        beside_xyxy_px=truth.boxes_source_px[~judged],
    )


def demo_codes(seed: int, spec: str, index: int) -> tuple[CodeInView, ...]:
    """The codes on the roofs of a scene that has some, in the frame at ``index / 15`` seconds, by object."""
    return _scene(seed, spec).codes(index / NOMINAL_FPS)


def open_demo(uri: str, place: str) -> Mapping[str, Callable[[], Sequence]]:
    """The scenes of these seeds by name; seed 0 where words stand alone. `UserError` where they are neither."""
    parts = [part.strip() for part in place.split(",")]
    words = [part for part in parts if part in SCENE_WORDS]
    seeds = ",".join(part for part in parts if part not in words)
    spec = f"demo:{','.join(words)}" if words else "demo"
    numbers = (0,) if words and not seeds else parse_numbers(uri, seeds)
    return {_name(seed, words): partial(_open, seed, spec) for seed in numbers}


def _name(seed: int, words: list[str]) -> str:
    return "-".join(["demo", f"{seed}", *words])


def _open(seed: int, spec: str) -> Sequence:
    count = base_frame_count(exact_rate(Scene.duration_s), fps=exact_rate(NOMINAL_FPS))
    _, colon, words = spec.partition(":")
    drawn = demo_scene(spec)
    size = drawn.get("size", _SIZE)
    return Sequence(
        name=_name(seed, words.split(",") if colon else []),
        dataset="demo",
        clip=Clip(spec, size, count, seed=seed),
        frame_count=count,
        fps=NOMINAL_FPS,
        source_size=size,
        labels=partial(demo_labels, seed, spec),
        class_set=tuple(sorted(CLASS_NAMES)),
        attributes={"scene": words} if words else {},
        codes=partial(demo_codes, seed, spec) if drawn.get("codes") else None,
    )


@lru_cache(maxsize=1)
def _scene(seed: int, spec: str) -> Scene:
    return Scene(seed, **demo_scene(spec))
