"""A detector that remembers: flights of one comparison look at the same pixels again and again.

What a detection cost is remembered with it, so that a flight can still say what it would have spent.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import time
from pathlib import Path

from hvt_common.model_store import resolve_model
from hvt_common.values import Detections, Image
from hvt_common.vision.detect import OnnxDetector
from hvt_common.vision.model import ModelSettings, open_model

__all__ = ["CachedDetector"]


class CachedDetector(OnnxDetector):
    """The network that ``spec`` names, on one thread; its answers lie in ``folder``, which processes may share.

    Raises:
        UserError: as `hvt_common.vision.detect.open_detector`.
    """

    def __init__(self, spec: str, *, confidence: float, provider: str, folder: Path) -> None:
        path = resolve_model(spec, role="detector")
        super().__init__(
            open_model(path, settings=ModelSettings(threads=1, provider=provider)), confidence=confidence
        )
        self._name = f"{path.resolve()} {confidence:g}".encode()
        self._folder = folder
        self.saved_cpu_s = 0.0
        """What the answers out of memory would have cost, less what it took to remember."""

    def detect(self, image_bgr: Image) -> Detections:
        """The network's answer for these pixels."""
        began_s = time.process_time()
        path = self._folder / self._key(image_bgr)
        known = _read(path)
        if known is None:
            asked_s = time.process_time()
            found = super().detect(image_bgr)
            cost_s = time.process_time() - asked_s
            _write(path, (found, cost_s))
        else:
            found, cost_s = known
        self.saved_cpu_s += cost_s - (time.process_time() - began_s)
        return found

    def _key(self, image_bgr: Image) -> str:
        digest = hashlib.sha1(self._name + repr(image_bgr.shape).encode(), usedforsecurity=False)
        digest.update(image_bgr.tobytes())
        return digest.hexdigest()


def _read(path: Path) -> tuple[Detections, float] | None:
    with contextlib.suppress(FileNotFoundError):
        known: tuple[Detections, float] = pickle.loads(path.read_bytes())  # noqa: S301 - a folder of our own
        return known
    return None


def _write(path: Path, content: tuple[Detections, float]) -> None:
    scratch = path.with_suffix(f".{os.getpid()}")
    scratch.write_bytes(pickle.dumps(content))
    scratch.replace(path)  # whole or not at all: another process may be reading
