"""The pool of drawn pictures that training cuts its views from, one file each, made by seeds alone.

Six kinds: ``demo`` (the demo's scene, clean), ``base`` (the same after x265 as the base stream carries it), ``thin``
(as a base of 640x360 carries it, enlarged as the detector does), ``codes`` (all three, with codes on roofs),
``place`` and ``aslant`` (`draw_place`). Seeds of training lie from `TRAIN_SEED` on; those of `held_out` and the
demo's own seed 0 never occur among them.
"""

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hvt_common.values import Frame, Image, View
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_scene import Appearance, Scene
from hvt_train.pictures.places import Picture, draw_place

TRAIN_SEED = 1000
HELD_OUT_SEED = 900_000
SOURCE_SIZE = (1920, 1080)
BASE_SIZE = (1280, 720)
_THIN_SIZE = (640, 360)
_FPS = 15.0
_CODED_FRAMES = 6


@dataclass(frozen=True, slots=True)
class PoolPlan:
    """How many: ``scenes`` worlds with ``moments`` each, ``codes`` with one (clean and coded), and places."""

    scenes: int = 220
    moments: int = 3
    codes: int = 120
    places: int = 700
    aslant: int = 160


@dataclass(frozen=True, slots=True)
class Shot:
    """One moment of a demo scene: the source frame and the truth in its pixels."""

    scene: Scene
    t_s: float

    def picture(self, size: tuple[int, int]) -> Picture:
        """The moment at ``size``, shrunk from the source as the edge shrinks it."""
        truth = self.scene.truth(self.t_s)
        scale = size[0] / self.scene.size[0]
        boxes = (truth.boxes_source_px * scale).astype(np.float32)
        image = _shrunk(self.scene.image(self.t_s), size)
        return Picture(image, boxes, truth.class_ids.astype(np.int32), truth.visible.astype(np.float32))


def shoot(seed: int, *, demo_appearance: bool, codes: bool = False) -> Scene:
    """The demo's scene of a seed, in the demo's look or in a random one; with ``codes`` on roofs."""
    appearance = None if demo_appearance else Appearance.random(seed)
    return Scene(seed, size=SOURCE_SIZE, appearance=appearance, codes=codes)


def coded(
    shot: Shot, *, bitrates_bps: Sequence[int], frames: int = _CODED_FRAMES, size: tuple[int, int] = BASE_SIZE
) -> list[Image]:
    """The base picture of a moment as the ground decodes it, ``frames`` after a keyframe, at each bitrate."""
    images = [
        _shrunk(shot.scene.image(max(0.0, shot.t_s - (frames - 1 - index) / _FPS)), size)
        for index in range(frames)
    ]
    return [through_x265(images, bitrate_bps) for bitrate_bps in bitrates_bps]


def through_x265(images: Sequence[Image], bitrate_bps: int) -> Image:
    """The last of pictures of one size, x265 at ``bitrate_bps`` having coded them all, as the ground decodes it."""
    high, wide = images[0].shape[:2]
    encoder = BaseEncoder(EncoderSettings(size=(wide, high), fps=_FPS, bitrate_bps=bitrate_bps))
    decoder, picture = BaseDecoder(), None
    for index, image in enumerate(images):
        frame = Frame(index=index, capture_ns=0, source_bgr=image, base_bgr=image)
        picture = decoder.decode(encoder.encode(frame).data)
    assert picture is not None
    return picture


def in_flight(image: Image, rng: np.random.Generator, *, kbps: float) -> Image:
    """A picture under a slowly moving camera, after x265 at ``kbps``; its sides are cut to multiples of 8."""
    high, wide = (side - side % 8 for side in image.shape[:2])
    step = rng.uniform(-4, 4, 2)
    moved = []
    for back in range(_CODED_FRAMES - 1, -1, -1):
        shift = np.array([[1, 0, step[0] * back], [0, 1, step[1] * back]], np.float32)
        shown = cv2.warpAffine(image[:high, :wide], shift, (wide, high), borderMode=cv2.BORDER_REFLECT)
        moved.append(np.asarray(shown, np.uint8))
    return through_x265(moved, round(1000 * kbps))


def thin_kbps(rng: np.random.Generator) -> float:
    """A rate of a thin base of `BASE_SIZE`: 80 to 1400 kbps, every octave as often."""
    return math.exp(rng.uniform(math.log(80), math.log(1400)))


def fill_pool(folder: Path, plan: PoolPlan, *, workers: int = 1) -> list[Path]:
    """Draw the missing files in ``folder`` and return all files of the plan, in the order of their names."""
    folder.mkdir(parents=True, exist_ok=True)
    counts = {"demo": plan.scenes, "codes": plan.codes, "place": plan.places, "aslant": plan.aslant}
    jobs = [
        (kind, number, plan.moments if kind == "demo" else 1)
        for kind, count in counts.items()
        for number in range(count)
    ]
    # Kinds are spread evenly, so that a pool that is cut short is a smaller pool of the same mixture.
    jobs.sort(key=lambda job: (job[1] / counts[job[0]], job[0]))
    with ProcessPoolExecutor(workers) as executor:
        names = executor.map(_draw, [(folder, *job) for job in jobs], chunksize=1)
        return sorted(path for group in names for path in group)


def _draw(job: tuple[Path, str, int, int]) -> list[Path]:
    cv2.setNumThreads(1)
    folder, kind, number, moments = job
    if kind in {"place", "aslant"}:
        path, aslant = folder / f"{kind}-{number:05d}.npz", kind == "aslant"
        if not path.exists():
            rng = np.random.default_rng([TRAIN_SEED, number, *([1] if aslant else [])])
            save_picture(path, draw_place(rng, size=1024 if aslant else 1280, aslant=aslant))
        return [path]
    names = ("demo", "base", "thin") if kind == "demo" else ("codes-demo", "codes-base", "codes-thin")
    paths = [folder / f"{name}-{number:05d}-{m}.npz" for name in names for m in range(moments)]
    if not all(path.exists() for path in paths):
        for path, picture in zip(paths, _pictures(number, moments, codes=kind == "codes"), strict=True):
            save_picture(path, picture)
    return paths


def _pictures(number: int, moments: int, *, codes: bool) -> Iterator[Picture]:
    """First the clean pictures of all moments, then the coded ones, large and small."""
    rng = np.random.default_rng([TRAIN_SEED, 1 + codes, number])
    seed = TRAIN_SEED + number + 100_000 * codes
    scene = shoot(seed, demo_appearance=number % 3 > 0 if codes else number % 4 == 0, codes=codes)
    clean = [
        Shot(scene, float(t_s)).picture(BASE_SIZE) for t_s in rng.uniform(0.4, scene.duration_s, moments)
    ]
    yield from clean
    for size, low, high in ((BASE_SIZE, 300_000, 2_500_000), (_THIN_SIZE, 100_000, 500_000)):
        for t_s in rng.uniform(0.4, scene.duration_s, moments):
            shot = Shot(scene, float(t_s))
            bitrate = round(math.exp(rng.uniform(math.log(low), math.log(high))))
            truth = shot.picture(BASE_SIZE)
            image = coded(shot, bitrates_bps=[bitrate], size=size)[0]
            picture = np.asarray(cv2.resize(image, BASE_SIZE, interpolation=cv2.INTER_LINEAR), np.uint8)
            yield Picture(picture, truth.boxes_px, truth.class_ids, truth.visible)


def save_picture(path: Path, picture: Picture) -> None:
    """Write whole or not at all: a run that is stopped leaves no half file."""
    partial = path.with_suffix(".part")
    with partial.open("wb") as file:
        np.savez(
            file,
            image=picture.image_bgr,
            boxes=picture.boxes_px,
            classes=picture.class_ids,
            visible=picture.visible,
        )
    partial.replace(path)


def _shrunk(image: Image, size: tuple[int, int]) -> Image:
    if (image.shape[1], image.shape[0]) == size:
        return image
    view = View.fitted((image.shape[1], image.shape[0]), size, fit="letterbox")
    assert view.offset_px == (0.0, 0.0), "the drawn frame has the shape of the base"
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
