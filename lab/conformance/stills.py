"""``PYTHONPATH=. python -m lab.conformance.stills``: write docs/conformance/stills.json, a still of each codec.

Encoders differ from machine to machine, so that these are made once; a test has the code of today read them. A reader
without a decoder of H.264 takes the decoded picture from the vector, and checks all around it.
"""

import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.values import Image, View
from hvt_common.video.base_crop import exact_base_crop
from hvt_common.video.still_codecs import Parameters, still_codec, still_codec_names
from hvt_common.video.still_codecs.h264_intra import (
    coded_slice,
    decoded,
    parameter_sets,
    split_payload,
    verbatim_picture,
)
from hvt_common.video.still_codecs.yuv420 import Planar, padded_size, to_planar

FILE = Path(__file__).resolve().parents[2] / "docs" / "conformance" / "stills.json"
_BASE = (64, 48)
_PLAIN = {"jpeg": (2, 24), "webp": (2, 24), "avif": (2, 24), "jxl": (2, 24)}
"""Mean and largest difference in levels of another decoder's picture: each enlarges chroma in its way."""
_CROPS = (
    ("enlarged, odd sides", View((160, 120), _BASE, 0.4, (0.0, 0.0)), (37, 21, 78, 50), (41, 29)),
    ("at a corner, with an offset", View((150, 120), _BASE, 0.4, (2.0, 0.0)), (0, 0, 33, 40), (33, 40)),
    ("shrunk", View(_BASE, _BASE, 1.0, (0.0, 0.0)), (0, 4, 64, 44), (32, 20)),
)


def vectors() -> Iterator[dict[str, Any]]:
    """One after the other; raises where a library is missing."""
    planes = _base_planes()
    for what, view, crop_px, size in _CROPS:
        yield _residual(what, planes, view, crop_px, size)
    crop = _texture(41, 29, seed=3)
    yield _intra("one slice", crop, quality_pct=70)
    yield _intra("whole blocks", _texture(32, 32, seed=4), quality_pct=70)
    # Found by trying: its data has zeros that look like a start code; without a loop filter.
    noise = np.random.default_rng(5235).integers(-30, 30, (29, 41, 3))
    grain = np.asarray(np.clip(_texture(41, 29, seed=5235) + noise, 0, 255), np.uint8)
    yield _intra("data that is escaped, no loop filter", grain, quality_pct=100)
    for name, (mean, most) in _PLAIN.items():
        if name not in still_codec_names():
            raise SystemExit(f"{name} is not installed: install hvt[jxl] and an OpenCV with WebP and AVIF")
        coded = still_codec(name).encode(crop, quality_pct=80)
        pixels = still_codec(name).decode(coded.data, size=(41, 29))
        yield _vector("a picture file", name, coded.data, (41, 29), pixels) | {
            "tolerance": {"mean": mean, "most": most}
        }


def still_cases() -> Iterator[dict[str, Any]]:
    """The steps of a reader before its decoder: no encoder takes part, so the code makes the cases."""
    data = bytes.fromhex("000001 000002 0000 0003 00000004 ff000003 b70000")
    for what, qp, size, cabac in (
        ("QP 15 has no loop filter", 15, (16, 16), b"\x55"),
        ("QP 16 has one", 16, (16, 16), b"\x55"),
        ("the lowest QP", 0, (33, 17), b"\x01"),
        ("the highest QP, data that is escaped, zeros at its end", 51, (512, 512), data),
    ):
        stream = parameter_sets(padded_size(size)) + coded_slice(cabac, qp=qp, intra=True)
        yield {
            "what": what,
            "size": size,
            "payload": bytes((qp, *cabac)).hex(),
            "stream": stream.hex(),
            "becomes": "read",
        }
    for what, payload in (("a QP of 52", "3401"), ("no data", "20"), ("nothing", "")):
        yield {"what": what, "size": (16, 16), "payload": payload, "becomes": "refused"}
    planes, noise, odd = _base_planes(), _noise_planes(), (-98305 / 65536, -16391 / 65536)
    for what, base_planes, crop, size, scale, offset, change, becomes in (
        ("the base that it was coded on", planes, (0, 0, 64, 64), (16, 16), 1.0, (0.0, 0.0), 0, "read"),
        ("a larger number for it", planes, (0, 0, 64, 64), (16, 16), 1.0, (0.0, 0.0), 5 << 16, "read"),
        ("another base", planes, (0, 0, 64, 64), (16, 16), 1.0, (0.0, 0.0), 1, "again"),
        ("32 samples a pixel", planes, (0, 0, 512, 512), (16, 16), 1.0, (0.0, 0.0), 0, "read"),
        ("33 samples a pixel", planes, (0, 0, 528, 528), (16, 16), 1.0, (0.0, 0.0), 0, "refused"),
        ("any colours, up to the far corner", noise, (36, 24, 64, 48), (28, 24), 1.0, (0.0, 0.0), 0, "read"),
        ("enlarged beyond all sides", noise, (0, 0, 190, 150), (190, 150), 0.3701, odd, 0, "read"),
        ("at and beside a half", noise, (8, 8, 24, 24), (16, 16), 1.0, (1 / 64, 1023 / 65536), 0, "read"),
        ("a little more than a sample", noise, (8, 8, 24, 24), (16, 16), 1 + 2**-16, (0.0, 0.0), 0, "read"),
        ("shrunk to odd sides", noise, (5, 3, 64, 46), (41, 29), 1.0, (0.5, 0.25), 0, "read"),
    ):
        view = View(crop[2:], _BASE, scale, offset)
        base = exact_base_crop(base_planes, view=view, crop_source_px=crop, size=size)
        yield {
            "what": what,
            "size": size,
            "parameters": {"b": zlib.crc32(to_planar(base).tobytes()) & 0xFFFF ^ change},
            "crop_source_px": crop,
            "view_scale": scale,
            "view_offset_px": offset,
            "base_size": _BASE,
            "base_planes": [plane.tobytes().hex() for plane in base_planes],
            "becomes": becomes,
        }


def main() -> int:
    lines = ",\n".join(json.dumps(one) for one in vectors())
    FILE.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    print(f"{FILE}: {lines.count(chr(10)) + 1} vectors")
    return 0


def _residual(
    what: str,
    planes: tuple[Planar, Planar, Planar],
    view: View,
    crop_px: tuple[int, int, int, int],
    size: tuple[int, int],
) -> dict[str, Any]:
    base = exact_base_crop(planes, view=view, crop_source_px=crop_px, size=size)
    detail = _texture(*size, seed=7).astype(np.int16) - 128
    crop = np.asarray(np.clip(base + detail // 4, 0, 255), np.uint8)
    codec = still_codec("residual")
    coded = codec.encode(crop, quality_pct=70, base_bgr=base)
    pixels = codec.decode(coded.data, size=size, parameters=coded.parameters, base_bgr=base)
    reference, (qp, cabac) = to_planar(base), split_payload(coded.data)
    units = [
        parameter_sets(padded_size(size)) + verbatim_picture(reference),
        coded_slice(cabac, qp=qp, intra=False),
    ]
    return _vector(what, "residual", coded.data, size, pixels, coded.parameters) | {
        "crop_source_px": crop_px,
        "view_scale": view.scale,
        "view_offset_px": view.offset_px,
        "base_size": _BASE,
        "base_planes": [plane.tobytes().hex() for plane in planes],
        "base_crop": base.tobytes().hex(),
        "reference": reference.tobytes().hex(),
        "stream": b"".join(units).hex(),
        "decoded": decoded(units, decoder="h264", size=padded_size(size)).tobytes().hex(),
    }


def _intra(what: str, crop: Image, *, quality_pct: int) -> dict[str, Any]:
    codec, size = still_codec("h264-intra"), (crop.shape[1], crop.shape[0])
    data = codec.encode(crop, quality_pct=quality_pct).data
    qp, cabac = split_payload(data)
    unit = parameter_sets(padded_size(size)) + coded_slice(cabac, qp=qp, intra=True)
    return _vector(what, "h264-intra", data, size, codec.decode(data, size=size)) | {
        "stream": unit.hex(),
        "decoded": decoded([unit], decoder="h264", size=padded_size(size)).tobytes().hex(),
    }


def _vector(
    what: str,
    codec: str,
    data: bytes,
    size: tuple[int, int],
    pixels: Image,
    parameters: Parameters | None = None,
) -> dict[str, Any]:
    return {
        "codec": codec,
        "what": what,
        "size": size,
        "parameters": dict(parameters or {}),
        "payload": data.hex(),
        "pixels": pixels.tobytes().hex(),
    }


def _noise_planes() -> tuple[Planar, Planar, Planar]:
    """Planes of a base picture: every level beside every other, and one half of it black and white."""
    rng, (width, height) = np.random.default_rng(11), _BASE
    luma = rng.integers(0, 256, (height, width), np.uint8)
    blue, red = (rng.integers(0, 256, (height // 2, width // 2), np.uint8) for _ in range(2))
    luma[:, ::3] = np.where(luma[:, ::3] > 127, 255, 0)
    return luma, blue, red


def _base_planes() -> tuple[Planar, Planar, Planar]:
    """Planes of a base picture: limited range, with blacks and whites beyond it, as a decoder may give."""
    width, height = _BASE
    luma = _texture(width, height, seed=1)[..., 0]
    first, second = (_texture(width // 2, height // 2, seed=seed)[..., 0] for seed in (4, 5))
    return luma, first, second


def _texture(width: int, height: int, *, seed: int) -> Image:
    """Smooth blotches of colour, the same everywhere: a file keeps them, so that no generator has to."""
    coarse = np.random.default_rng(seed).integers(0, 256, (-(-height // 6), -(-width // 6), 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


if __name__ == "__main__":
    sys.exit(main())
