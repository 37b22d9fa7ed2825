"""Drawn crops for still codecs: a textured source, and what a thin base stream leaves of it."""

import cv2
import numpy as np


def textured(width: int, height: int, *, seed: int = 0) -> np.ndarray:
    """Soft colours with fine grain and a few sharp edges: (height, width, 3) uint8, BGR."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(20, 236, (max(2, height // 12), max(2, width // 12), 3), dtype=np.uint8)
    picture = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    grain = cv2.GaussianBlur(rng.normal(0, 22, (height, width)).astype(np.float32), (0, 0), 1.2)
    picture += grain.reshape(height, width, 1)
    for _ in range(3):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        cv2.rectangle(
            picture, (x, y), (x + width // 4, y + height // 4), rng.integers(0, 256, 3).tolist(), -1
        )
    return np.clip(picture, 0, 255).astype(np.uint8)


def washed_out(crop: np.ndarray, *, sigma_px: float = 1.0) -> np.ndarray:
    """The same without its fine detail, and a level or two off."""
    soft = cv2.GaussianBlur(crop, (0, 0), sigma_px).astype(np.int16)
    return np.clip((soft + 2) // 4 * 4, 0, 255).astype(np.uint8)
