"""A detector that remembers: flights of one comparison look at the same pixels again and again.

The cost of a detection is remembered with it, so that a flight can still state its full cost. An answer is named by
all that decides it: the content of the model file, its provider, the code and the versions of the libraries on the
way, and the pixels. One that was cut off or changed is asked for again.
"""

import hashlib
import time
from functools import cache
from pathlib import Path

import msgpack
import numpy as np

from hvt_common.inference.detect import OnnxDetector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.runtimes.model_file import files_of
from hvt_common.inference.store import resolve_model
from hvt_common.values import Detections, Image
from hvt_study.cache import results

_PACKAGES = ("numpy", "opencv-python-headless", "onnxruntime", "onnxruntime-gpu", "openvino")
"""Those that may have a say in an answer, as far as they are installed."""
digest_of_file = cache(results.file_digest)
"""Once in a study, or until the file changes (`hvt_study.runs.run_context`)."""


class CachedDetector(OnnxDetector):
    """The network that ``spec`` names, on one thread; its answers lie in ``folder``, which processes may share.

    Raises `UserError` as `hvt_common.inference.detect.open_detector`; `detect` raises `CacheError` on a full disk.
    """

    def __init__(self, spec: str, *, confidence: float, provider: str, folder: Path) -> None:
        path = resolve_model(spec, role="detector")
        super().__init__(
            open_model(path, settings=ModelSettings(threads=1, provider=provider)), confidence=confidence
        )
        said = (
            *(digest_of_file(file.resolve()) for file in files_of(path)),
            self.model.provider.provider,
            f"{confidence:g}",
            f"code {results.code_digest(*results.DETECTING)}",
            *(f"{name} {number}" for name, number in results.installed(_PACKAGES).items()),
        )
        self._name = " ".join(said).encode()
        self._folder = results.make_folder(folder)
        self.saved_cpu_s = 0.0
        """The cost of the answers out of memory, less that of remembering."""

    def detect(self, image_bgr: Image, *, share: float = 1.0) -> Detections:
        assert share == 1, "a study flies in lockstep, where nothing is reduced"
        began_s = time.process_time()
        path = self._folder / self._key(image_bgr)
        known = _read(path)
        if known is None:
            began_s = time.process_time()
            found = super().detect(image_bgr)
            cost_s = time.process_time() - began_s
            _write(path, found, cost_s)
        else:
            found, cost_s = known
        self.saved_cpu_s += cost_s - (time.process_time() - began_s)
        return found

    def _key(self, image_bgr: Image) -> str:
        digest = hashlib.sha1(self._name + repr(image_bgr.shape).encode(), usedforsecurity=False)
        digest.update(image_bgr.tobytes())
        return digest.hexdigest()


def _read(path: Path) -> tuple[Detections, float] | None:
    """The answer there; None where there is none, or no whole one."""
    body = results.read_whole(path)
    if body is None:
        return None
    cost_s, boxes, confidences, class_ids = msgpack.unpackb(body)
    found = Detections(
        np.frombuffer(boxes, "<f4").reshape(-1, 4).astype(np.float32),
        np.frombuffer(confidences, "<f4").astype(np.float32),
        np.frombuffer(class_ids, "<i4").astype(np.int32),
    )
    return found, float(cost_s)


def _write(path: Path, found: Detections, cost_s: float) -> None:
    arrays = (found.boxes_xyxy_px, "<f4"), (found.confidences, "<f4"), (found.class_ids, "<i4")
    results.write_whole(
        path, msgpack.packb([cost_s, *(one.astype(dtype).tobytes() for one, dtype in arrays)])
    )
