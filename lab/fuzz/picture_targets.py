"""Every decoder of pictures that the network reaches: stills of each codec, stills with their headers, the base."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from hvt_common.protocol.messages import RoiHeader, WireError
from hvt_common.values import View
from hvt_common.video.base_crop import base_crop, coded_size
from hvt_common.video.hevc import BaseDecoder
from hvt_common.video.still_codecs import CodedCrop, StillError, still_codec, still_codec_names
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from hvt_ground.perception.stills.decode import ReceivedStill, decode_still
from lab.fuzz.contract import Target
from lab.fuzz.message_targets import ROI
from lab.fuzz.mutate import changed_values, each_part, joined, parted
from lab.fuzz.picture_mutations import inside
from media.clips import framed, smooth_pictures
from media.crops import textured, washed_out
from media.hevc_pictures import coded_picture

CODECS = ("jpeg", "webp", "avif", "jxl", "h264-intra", "residual")
_SIZES = ((56, 40), (16, 16), (117, 50), (200, 9))
_VIEW = View.fitted((640, 360), (320, 192), fit="letterbox")
_BASE_SIZE = (96, 64)
_STILL = each_part(changed_values, None)


@cache
def _crop(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A crop and the same part of the base."""
    crop = textured(*size)
    return crop, washed_out(crop)


def _coded(name: str, size: tuple[int, int], quality_pct: int) -> CodedCrop:
    crop, base = _crop(size)
    codec = still_codec(name)
    return codec.encode(crop, quality_pct=quality_pct, base_bgr=base if codec.needs_base else None)


@cache
def _parameters(name: str, size: tuple[int, int]) -> dict:
    return dict(_coded(name, size, 50).parameters)


def _decoded(name: str) -> Callable[[bytes], None]:
    """The first byte says the size that the header announces; the rest is the payload."""

    def run(data: bytes) -> None:
        size = _SIZES[data[0] % len(_SIZES)] if data else _SIZES[0]
        codec = still_codec(name)
        base = _crop(size)[1] if codec.needs_base else None
        with contextlib.suppress(StillError):
            image = codec.decode(data[1:], size=size, parameters=_parameters(name, size), base_bgr=base)
            assert image.shape == (size[1], size[0], 3)
            assert image.dtype == np.uint8

    return run


def _still_seeds(name: str) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        return [
            bytes([place]) + _coded(name, size, quality).data
            for place, size in enumerate(_SIZES)
            for quality in (5, 60, 95)
        ]

    return seeds


# Stills as they come: header and payload


@cache
def _base() -> np.ndarray:
    return textured(320, 192, seed=2)


def _received(data: bytes) -> None:
    attachment, payload = parted(data, least=2)[:2]
    try:
        header = RoiHeader.parse(attachment)  # sealed without its payload: that is changed by itself
    except WireError:
        return
    with contextlib.suppress(StillError):
        image = decode_still(ReceivedStill(header, payload), base=_base(), view=_VIEW)
        assert max(image.shape) <= 512


def _received_seeds() -> list[bytes]:
    seeds = []
    for name in still_codec_names():
        if name not in CODECS:
            continue
        for crop_px in ((104, 56, 160, 96), (0, 0, 640, 360)):
            size = coded_size(crop_px)
            codec = still_codec(name)
            base = base_crop(_base(), view=_VIEW, crop_source_px=crop_px, size=size)
            coded = codec.encode(textured(*size), quality_pct=20, base_bgr=base if codec.needs_base else None)
            parameters = dict(coded.parameters)
            if size != (crop_px[2] - crop_px[0], crop_px[3] - crop_px[1]):
                parameters |= {"w": size[0], "h": size[1]}
            header = replace(ROI, codec=name, crop_source_px=crop_px, parameters=parameters)
            seeds.append(joined([header.pack(), coded.data]))
    return seeds


# The base stream


def _base_stream(data: bytes) -> None:
    decoder = BaseDecoder(size=_BASE_SIZE)
    for unit in parted(data)[:4]:
        picture = decoder.decode(unit)
        assert picture is None or (picture.ndim == 3 and max(picture.shape) <= 8192)


def _base_seeds() -> list[bytes]:
    settings = EncoderSettings(size=_BASE_SIZE, fps=15, bitrate_bps=150_000, preset="ultrafast")
    encoder = BaseEncoder(settings)
    units = [encoder.encode(frame).data for frame in framed(smooth_pictures(4, size=_BASE_SIZE))]
    announced = [
        coded_picture(b"\x80" * 20, size=size, qp=30) for size in ((64, 64), (8192, 4320), (16384, 64))
    ]
    return [joined(units), joined(units[:1]), *(joined([one, *units[:2]]) for one in announced)]


TARGETS = (
    *(
        Target(
            f"still-{name}",
            _decoded(name),
            _still_seeds(name),
            mutate=inside(name),
            share=25 if name in ("jpeg", "webp") else 15,
            short=500,
            most_bytes=12_000,
        )
        for name in CODECS
        if name in still_codec_names()
    ),
    Target("still-received", _received, _received_seeds, _STILL, share=20, short=400, most_bytes=40_000),
    Target(
        "base-decoder", _base_stream, _base_seeds, each_part(None), share=15, short=200, most_bytes=20_000
    ),
)
