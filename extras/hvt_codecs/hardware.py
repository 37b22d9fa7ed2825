"""Encoders of graphics cards and boards, through PyAV, behind the entry point `hvt.encoders`: one class for all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import av.error
from av.video.frame import PictureType
from av.video.reformatter import VideoReformatter

from hvt_common.errors import UserError
from hvt_common.values import AccessUnit, Frame
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import Region, encoder_context, mean_qp_of, yuv_picture

_BT709, _LIMITED = 1, 1
"""Values of ITU-T H.273, and of FFmpeg's AVColorRange."""
_GOP_FRAMES = 60_000
"""No keyframe comes by itself for an hour at 15 fps; more does not fit hevc_qsv's 16 bits."""


@dataclass(frozen=True, slots=True)
class HardwareRow:
    """One encoder of FFmpeg."""

    codec: str
    """Its name in FFmpeg, and for ``--encoder``."""
    pixel_format: str
    needs: str
    """The hardware that it needs."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Options for zero latency, constant rate, and an IDR where a keyframe is forced."""


class HardwareEncoder:
    """An `Encoder`. Raises `UserError` if the machine has no such device; `ValueError` if it delays frames."""

    def __init__(self, settings: EncoderSettings, *, row: HardwareRow) -> None:
        self._row = row
        self._to_yuv = VideoReformatter()
        self._count = 0
        self.mean_qp = math.nan
        context = encoder_context(row.codec, settings, pixel_format=row.pixel_format)
        context.bit_rate = settings.bitrate_bps
        context.gop_size = _GOP_FRAMES
        context.color_primaries = context.color_trc = context.colorspace = _BT709
        context.color_range = _LIMITED
        vbv_bits = max(1, round(settings.bitrate_bps * settings.vbv_s))
        limits = {"maxrate": str(settings.bitrate_bps), "bufsize": str(vbv_bits), "bf": "0"}
        context.options = {**limits, **row.options}
        try:
            context.open()
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UserError(
                f"--encoder {row.codec} does not open on this machine ({reason}): it takes {row.needs}; "
                "x265 takes none"
            ) from error
        self._context = context

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        del regions
        picture = yuv_picture(self._to_yuv, frame.base_bgr, pixel_format=self._row.pixel_format)
        picture.pts = self._count
        picture.pict_type = PictureType.I if keyframe else PictureType.NONE
        self._count += 1
        packets = self._context.encode(picture)
        if len(packets) != 1:
            raise ValueError(
                f"{self._row.codec} gave {len(packets)} units for frame {frame.index}: it delays"
            )
        self.mean_qp = mean_qp_of(packets[0])
        return AccessUnit(frame.index, frame.capture_ns, bytes(packets[0]), keyframe=packets[0].is_keyframe)


# The project has run none of them: the rows were written from FFmpeg's documentation. The qualification run at the
# start keeps a wrong row from a flight.
ROWS = (
    HardwareRow(
        "hevc_nvenc",
        "yuv420p",
        "an NVIDIA GPU with NVENC and its driver",
        {"preset": "p4", "tune": "ull", "rc": "cbr", "delay": "0", "zerolatency": "1", "forced-idr": "1"},
    ),
    HardwareRow(
        "hevc_qsv",
        "nv12",
        "an Intel GPU with Quick Sync and its driver",
        {"preset": "medium", "async_depth": "1", "low_delay_brc": "1", "look_ahead": "0", "forced_idr": "1"},
    ),
    HardwareRow("hevc_v4l2m2m", "nv12", "a board whose kernel has an HEVC encoder as a V4L2 device"),
)
nvenc, qsv, v4l2m2m = (partial(HardwareEncoder, row=row) for row in ROWS)
