"""Frames for the encoder and what follows it: drawn ones that are hard to code, and those of a real clip."""

from pathlib import Path

import av
import cv2
import numpy as np

from hvt_common.values import Frame

START_NS = 1_790_000_000_000_000_000


def framed(pictures: list[np.ndarray], *, fps: float = 15.0) -> list[Frame]:
    return [
        Frame(index, START_NS + round(index * 1e9 / fps), picture, picture)
        for index, picture in enumerate(pictures)
    ]


def hard_pictures(count: int, *, size: tuple[int, int]) -> list[np.ndarray]:
    """A pan over noisy ground, with a cut to another place half-way: no bit is cheap."""
    width, height = size
    worlds = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        coarse = rng.integers(0, 255, (30, 50, 3), np.uint8)
        ground = cv2.resize(coarse, (width + 600, height + 200), interpolation=cv2.INTER_CUBIC)
        noise = rng.normal(0, 18, (height + 200, width + 600, 1))
        worlds.append(np.clip(ground * 0.7 + 40 + noise, 0, 255).astype(np.uint8))
    pictures = []
    for index in range(count):
        x, y = int(3.3 * index) % 600, int(1.2 * index) % 200
        world = worlds[0 if index < count // 2 else 1]
        pictures.append(np.ascontiguousarray(world[y : y + height, x : x + width]))
    return pictures


def smooth_pictures(count: int, *, size: tuple[int, int]) -> list[np.ndarray]:
    """Saturated colours that change slowly in space, with a bright square that moves: easy to code well."""
    width, height = size
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    ground = np.stack([40 + 170 * x, 220 - 180 * y, 60 + 130 * (x + y) / 2], axis=-1).astype(np.uint8)
    pictures = []
    for index in range(count):
        picture = ground.copy()
        left = (7 * index) % (width - 40)
        picture[height // 3 : height // 3 + 32, left : left + 32] = (30, 60, 230)
        pictures.append(picture)
    return pictures


def real_pictures(clip: Path, count: int, *, size: tuple[int, int], step: int = 2) -> list[np.ndarray]:
    """Every ``step``-th picture of a clip, resampled."""
    pictures: list[np.ndarray] = []
    with av.open(str(clip)) as container:
        for index, picture in enumerate(container.decode(video=0)):
            if index % step == 0:
                bgr = picture.to_ndarray(format="bgr24")
                pictures.append(cv2.resize(bgr, size, interpolation=cv2.INTER_AREA))
            if len(pictures) == count:
                break
    return pictures
