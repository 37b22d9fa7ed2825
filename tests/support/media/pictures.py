"""A small moving scene as a folder of pictures: cheap to play in real time beside other processes."""

from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 960, 540
_THINGS = 6


def write_scene(folder: Path, *, frames: int) -> Path:
    """Write ``frames`` JPEGs: a still ground with fine texture, and six striped things that move over it."""
    rng = np.random.default_rng(7)
    coarse = rng.integers(60, 180, (HEIGHT // 12, WIDTH // 12, 3), np.uint8)
    ground = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    ground = cv2.add(ground, rng.integers(0, 40, ground.shape, np.uint8))
    things = [rng.integers(0, 255, (40 + 6 * n, 64 + 8 * n, 3), np.uint8) for n in range(_THINGS)]
    for index in range(frames):
        picture = ground.copy()
        for number, thing in enumerate(things):
            high, wide = thing.shape[:2]
            x = (90 * number + 5 * index) % (WIDTH - wide)
            y = 20 + 85 * number
            picture[y : y + high, x : x + wide] = thing
        cv2.imwrite(str(folder / f"{index:06d}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return folder
