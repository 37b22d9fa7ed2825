"""A package as a third party would install it, with still codecs, detectors or encoders behind the entry point."""

import textwrap
from collections.abc import Mapping
from pathlib import Path

PIXELS = '''
"""Zlib-packed pixels: a codec that knows nothing of HVT but the contract."""

import zlib

import numpy as np

from hvt_common.video.still_codecs import CodedCrop, StillError


class PixelCodec:
    name = "acme-pixels"
    media_type = "application/x-acme-pixels"
    needs_base = False

    def encode(self, crop_bgr, *, quality_pct, base_bgr=None):
        step = 65 - quality_pct * 64 // 100
        return CodedCrop(zlib.compress((crop_bgr // step).tobytes(), 9), {"step": step})

    def decode(self, data, *, size, parameters={}, base_bgr=None):
        step = parameters.get("step")
        if not isinstance(step, int) or not 1 <= step <= 65:
            raise StillError(f"step {step!r} is not within 1 and 65")
        wanted = size[0] * size[1] * 3
        try:
            pixels = zlib.decompressobj().decompress(data, wanted + 1)
        except zlib.error as error:
            raise StillError(str(error)) from None
        if len(pixels) != wanted:
            raise StillError(f"{len(pixels)} bytes in place of {wanted}")
        image = np.frombuffer(pixels, np.uint8).reshape(size[1], size[0], 3).astype(np.int16) * step + step // 2
        return np.minimum(image, 255).astype(np.uint8)
'''


BLOBS = '''
"""Bright blobs: a detector that knows nothing of HVT but the contract, as a runtime of its own would."""

import cv2
import numpy as np

from hvt_common.values import Detections


class BlobDetector:
    def __init__(self, model="person,vehicle"):
        self.class_names = tuple(model.split(","))

    def detect(self, image_bgr):
        grey = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
        _, mask = cv2.threshold(grey, 170, 255, cv2.THRESH_BINARY)
        _, _, rows, _ = cv2.connectedComponentsWithStats(mask)
        rows = rows[1:][rows[1:, 4] >= 60]
        boxes = np.stack([rows[:, 0], rows[:, 1], rows[:, 0] + rows[:, 2], rows[:, 1] + rows[:, 3]], 1)
        kinds = (rows[:, 4] > 400).astype(np.int32)
        return Detections(boxes.astype(np.float32), np.full(len(rows), 0.8, np.float32), kinds)
'''


ENCODERS = '''
"""Encoders that do not keep to their rate, or to the contract: x265 without what holds it."""

from dataclasses import replace

from hvt_common.values import AccessUnit
from hvt_edge.video.x265 import BaseEncoder


class Obedient:
    """Codes at once, at the rate that it was opened for."""

    factor = 1.0

    def __init__(self, settings):
        self._encoder = BaseEncoder(replace(settings, bitrate_bps=round(settings.bitrate_bps * self.factor)))

    def encode(self, frame, *, keyframe):
        return self._encoder.encode(frame, keyframe=keyframe)


class Greedy(Obedient):
    """Takes half as much again."""

    factor = 1.5


class WithoutKeyframes(Obedient):
    """Makes the first alone."""

    def encode(self, frame, *, keyframe):
        return self._encoder.encode(frame, keyframe=frame.index == 0)


class Late(Obedient):
    """Has a frame of delay."""

    before = None

    def encode(self, frame, *, keyframe):
        self.before, unit = super().encode(frame, keyframe=keyframe), self.before
        return unit


class Absent:
    """Takes no settings."""

    def __init__(self, settings):
        raise OSError("no such device")
'''


def install(
    folder: Path,
    parts: Mapping[str, str],
    *,
    module: str = "acme_codecs",
    source: str = PIXELS,
    group: str = "hvt.still_codecs",
) -> Path:
    """Lay out ``module`` and its metadata in ``folder``, as pip would; put the folder on the path to install it.

    ``parts`` maps the names of entry points of ``group`` to objects in the module.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{module}.py").write_text(textwrap.dedent(source))
    information = folder / f"{module}-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    rows = [f"{name} = {module}:{target}" for name, target in parts.items()]
    (information / "entry_points.txt").write_text("\n".join([f"[{group}]", *rows, ""]))
    return folder
