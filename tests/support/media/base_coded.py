"""A small still codec that builds on the base, for tests of what stands around codecs."""

import zlib
from dataclasses import dataclass, field

import cv2
import numpy as np

from hvt_common.video.still_codecs import NO_PARAMETERS, BaseMissingError, CodedCrop


@dataclass(frozen=True, slots=True)
class StandIn:
    """Half the difference to the base as WebP; a checksum of the base crop tells whether it is the right one."""

    name: str = field(default="stand-in", init=False)
    media_type: str = field(default="image/webp", init=False)
    needs_base: bool = field(default=True, init=False)

    def encode(self, crop_bgr, *, quality_pct, base_bgr=None) -> CodedCrop:
        half = (np.round((crop_bgr.astype(np.float32) - base_bgr) / 2) + 128).clip(0, 255).astype(np.uint8)
        data = cv2.imencode(".webp", half, [cv2.IMWRITE_WEBP_QUALITY, quality_pct])[1].tobytes()
        return CodedCrop(data, {"c": zlib.crc32(base_bgr.tobytes())})

    def decode(self, data, *, size, parameters=NO_PARAMETERS, base_bgr=None):
        if base_bgr is None or zlib.crc32(base_bgr.tobytes()) != parameters["c"]:
            raise BaseMissingError("another base")
        half = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert half.shape == (size[1], size[0], 3)
        return (base_bgr + 2 * (half.astype(np.int32) - 128)).clip(0, 255).astype(np.uint8)


class Hopeless:
    """A fallback that is never the smaller one: losslessly coded."""

    name, media_type, needs_base = "hopeless", "image/png", False

    def encode(self, crop_bgr, *, quality_pct, base_bgr=None) -> CodedCrop:
        return CodedCrop(crop_bgr.tobytes())

    def decode(self, data, *, size, parameters=NO_PARAMETERS, base_bgr=None):
        return np.frombuffer(data, np.uint8).reshape(size[1], size[0], 3)
