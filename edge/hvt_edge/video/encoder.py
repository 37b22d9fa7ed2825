"""The frame loop's contract with an encoder, its settings from a budget in line bits, and all encoders by name.

There are x265 and those that packages install, as an extra the hardware encoders and passthrough: an entry point of
the group ``hvt.encoders``, imported when it is named: it makes an `Encoder` of `EncoderSettings`, or refuses them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final, Protocol, cast

from hvt_common.errors import UserError, not_installed
from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.runtime.plug_ins import installed, loaded, the_one
from hvt_common.values import AccessUnit, Frame
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES, frames_bps
from hvt_edge.operating import Rates

if TYPE_CHECKING:
    from hvt_edge.video.x265 import Region

PRESETS = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium")
VBV_S = 0.15
"""Depth of the VBV buffer in seconds of the base rate."""

# At QP 51 the keyframes of 25 aerial pictures took at most 0.6, 1.6, 2.5, 3.9 and 7.8 kB at 320x180, 640x360,
# 960x540, 1280x720 and 1920x1080, half of them less than half of it: 770 bytes and 0.0034 a pixel. x265 can go no
# lower, whatever the target is; where a keyframe takes more, the stage codes it again with less detail.
_KEYFRAME_FLOOR_BYTES = 770
_KEYFRAME_FLOOR_BYTES_PER_PX = 0.0034
# At usual thin rates keyframes take more, up to the VBV's limit: 3.0, 3.9, 4.9 and 5.9 kB up to 1280x720.
_KEYFRAME_BYTES = 2060
_KEYFRAME_BYTES_PER_SIDE_PX = 4.0
# The frames after a keyframe follow a target down to some 300 bits and 0.0045 bit a pixel each: 67 kbps at 1280x720
# and 15 fps.
_FRAME_FLOOR_BITS = 300
_FRAME_FLOOR_BITS_PER_PX = 0.0045

# The fullest rolling second over the target, keyframes on demand included, from 300 kbps up (see encode).
_PEAK = 1.14
_TIGHT_VBV_S = 0.1
_VBV_FRAMES, _TIGHT_VBV_FRAMES = 1.3, 1.15
"""Least depth: with 1.15 x265 uses .8 of its rate, with 1.3 .9; with more, windows of few frames cannot hold them."""
_TIGHT_PEAK = 1.04  # of 1.05 to 1.09; the rest waits some milliseconds (budget.earliest_ns)
_KEYFRAME_EVERY_S = 5.0
"""x265 never takes back the bytes of keyframes beyond a frame's share: at low rates all, at 650 kbps two thirds.
Its rate is lowered by that: for the first keyframe, one each ten seconds, and some that grounds request."""
_KEYFRAME_SHARE = 0.005
"""Largest share of the base's bytes for scheduled keyframes."""
STATUS_BYTES = 320
SLOWEST: Final = "veryfast"
"""The preset of studies, the demo and all of lockstep: there time does not matter."""
_keys = lru_cache(maxsize=64)(EdgeKeys)


@dataclass(frozen=True, slots=True)
class EncoderSettings:
    """Settings of x265; ``bitrate_bps`` is the payload alone, without headers of any transport."""

    size: tuple[int, int]
    fps: float
    bitrate_bps: int
    preset: str = SLOWEST
    vbv_s: float = VBV_S
    threads: int = 1
    """Worker threads; more than one is faster, but the bytes differ from run to run."""


def keyframe_floor_bytes(size: tuple[int, int]) -> int:
    """The smallest keyframe of a textured picture of ``size`` (width, height)."""
    return round(_KEYFRAME_FLOOR_BYTES + _KEYFRAME_FLOOR_BYTES_PER_PX * size[0] * size[1])


def usual_keyframe_bytes(size: tuple[int, int]) -> int:
    """The usual bytes of a keyframe of ``size`` (width, height) at thin rates."""
    return round(_KEYFRAME_BYTES + _KEYFRAME_BYTES_PER_SIDE_PX * math.sqrt(size[0] * size[1]))


def most_keyframe_bytes(size: tuple[int, int], fps: float, base_bps: int) -> int:
    """About the largest keyframe: the VBV's content at this B_v, or the least bytes that x265 can reach."""
    return max(keyframe_floor_bytes(size), round(vbv_s(fps) * base_bps / 8))


def keyframe_interval_s(size: tuple[int, int], base_bps: int) -> float:
    """The default time between scheduled keyframes: 10 s, up to 60 s where the rate is thin.

    A keyframe that the VBV lets through at a low rate is far coarser than the frames before it, and the picture takes
    seconds to recover: at 200 kbps and 1280x720 the objects found fell from 62 to 6. Grounds that join or lose
    frames request keyframes anyhow; the schedule only lets a viewer jump within a recording. So its bytes
    are held to half a percent of the stream.
    """
    return min(60.0, max(10.0, 8 * usual_keyframe_bytes(size) / (_KEYFRAME_SHARE * base_bps)))


def keyframe_total_bps(size: tuple[int, int], *, window_s: float, metadata_bps: int, edge_id: str) -> int:
    """The least total at which each window holds a keyframe, with ``status``, tracks and pose beside it."""
    keyframe_bps = 8 * keyframe_floor_bytes(size) / window_s
    beside_bps = base_overhead_bps(keyframe_bps, fps=1 / window_s, edge_id=edge_id)
    return math.ceil(keyframe_bps + beside_bps + metadata_bps)


def minimum_bps(size: tuple[int, int], fps: float) -> int:
    """The lowest payload rate that x265 can follow at this size and frame rate, keyframes apart."""
    return round(fps * (_FRAME_FLOOR_BITS + size[0] * size[1] * _FRAME_FLOOR_BITS_PER_PX))


def base_overhead_bps(base_bps: float, *, fps: float, edge_id: str) -> float:
    """The share of headers, framing and ``status`` in ``base_bps``: the encoder gets the rest."""
    payload = round(base_bps / 8 / fps)
    keys, encoding = _keys(edge_id), DELIVERIES[Channel.BASE].encoding
    per_frame = BASE_ATTACHMENT_BYTES + overhead_bytes(
        payload, BASE_ATTACHMENT_BYTES, key=keys[Channel.BASE], encoding=encoding
    )
    per_second = STATUS_BYTES + overhead_bytes(STATUS_BYTES, 0, key=keys[Channel.STATUS])
    return 8 * (per_frame * fps + per_second)


def encoder_settings(
    *,
    size: tuple[int, int],
    fps: float,
    preset: str,
    total_bps: int,
    base_bps: int,
    edge_id: str,
    window_s: float = 1.0,
) -> EncoderSettings:
    """Settings of x265 that keep the base stream within B_v, and its fullest second within B_tot.

    Where stills have a share, they yield to the base's peaks. Where video takes (nearly) the whole budget, as in M0,
    nothing can yield: the VBV is made tighter and the target lowered by the remaining peak. Where a window of
    ``window_s`` holds no whole number of frames, the target is lowered until it holds all frames that fall into it.

    ``fps`` is the rate of coded frames: with fewer of them less goes into headers, and the VBV holds more than one.
    """
    tight = base_bps * _PEAK > total_bps
    line_bps = min(base_bps, total_bps / _TIGHT_PEAK) if tight else base_bps
    payload_bps = line_bps - _beside_bps(line_bps, size=size, fps=fps, edge_id=edge_id)
    frames_line_bps = line_bps - _debt_bps(size)
    payload_bps += frames_bps(frames_line_bps, total_bps, fps=fps, window_s=window_s) - frames_line_bps
    return EncoderSettings(
        size=size,
        fps=fps,
        bitrate_bps=max(1, round(payload_bps)),
        preset=preset,
        vbv_s=vbv_s(fps, tight=tight),
    )


def least_base_bps(size: tuple[int, int], fps: float, *, edge_id: str) -> int:
    """The lowest B_v at which x265 can still follow its target."""
    payload_bps = minimum_bps(size, fps)
    return round(payload_bps + _beside_bps(payload_bps, size=size, fps=fps, edge_id=edge_id))


def payload_bps(base_bps: int, *, size: tuple[int, int], fps: float, edge_id: str) -> float:
    """About x265's part of B_v; never below 1."""
    return max(1.0, base_bps - _beside_bps(base_bps, size=size, fps=fps, edge_id=edge_id))


def vbv_s(fps: float, *, tight: bool = False) -> float:
    """Depth of the VBV at this rate of coded frames."""
    return max(_TIGHT_VBV_S, _TIGHT_VBV_FRAMES / fps) if tight else max(VBV_S, _VBV_FRAMES / fps)


def _beside_bps(line_bps: float, *, size: tuple[int, int], fps: float, edge_id: str) -> float:
    # The part of the base's rate beside x265: headers, framing, ``status``, and its debt of keyframes.
    return base_overhead_bps(line_bps, fps=fps, edge_id=edge_id) + _debt_bps(size)


def _debt_bps(size: tuple[int, int]) -> float:
    return 8 * usual_keyframe_bytes(size) / _KEYFRAME_EVERY_S


class Encoder(Protocol):
    """Turns frames into HEVC access units, one for each, at once, and never exceeds the bits it was opened for.

    It is opened anew, with another `EncoderSettings`, for each change of rate, and used from one thread.
    """

    @property
    def mean_qp(self) -> float:
        """Mean quantiser parameter (0…51) of the frame encoded last; NaN where it is not known."""
        ...

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """The unit of ``frame.base_bgr``, uint8 (height, width, 3) BGR, not to be written to, as Annex B.

        4:2:0, 8 bits, BT.709, limited range; each picture refers only to earlier ones. With ``keyframe`` it is an
        IDR with VPS, SPS and PPS before it, and so is the first. ``regions`` are given to x265 alone. May raise
        any error: the frame is left out, and another encoder is opened.
        """
        ...


class CheckedEncoder:
    """An encoder not tested by HVT: raises `ValueError` for a unit that no ground could use. Without regions."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._begun = False

    @property
    def mean_qp(self) -> float:
        """See `Encoder`; NaN where it reports none, or an impossible value."""
        said = getattr(self._encoder, "mean_qp", math.nan)
        return float(said) if isinstance(said, int | float) and 0 <= said <= 51 else math.nan

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """See `Encoder`. The unit itself shows whether it is a keyframe, whatever the encoder reports."""
        from hvt_common.video.hevc import (  # noqa: PLC0415  (the command line needs no decoder)
            is_keyframe,
            parameter_sets,
            without_filler,
        )

        assert not regions, "config.check() refuses regions with another encoder than x265"
        unit = self._encoder.encode(frame, keyframe=keyframe)
        data = getattr(unit, "data", None)
        data = without_filler(data) if isinstance(data, bytes) else b""
        if not data:
            raise ValueError(f"it gave no access unit for frame {frame.index}, and has to give one for each")
        # A decoder can begin only with both; another I picture is a large frame like any other.
        begins = is_keyframe(data) and bool(parameter_sets(data))
        if (keyframe or not self._begun) and not begins:
            raise ValueError(f"frame {frame.index} was to be a keyframe, and is no IDR with VPS, SPS and PPS")
        self._begun = True
        return AccessUnit(frame.index, frame.capture_ns, data, keyframe=begins)

    def close(self) -> None:
        """Release the encoder, and so its device and memory."""
        del self._encoder


ENCODERS = "hvt.encoders"
X265 = "x265"
"""HVT's own, measured encoder: the only one that takes regions and needs no qualification."""
PASSTHROUGH = "passthrough"
"""No encoder: the units come from a camera that makes HEVC itself."""
_WHAT = "encoder"
_BROUGHT = (PASSTHROUGH, "hevc_nvenc", "hevc_qsv", "hevc_v4l2m2m")
"""Those of the extra that comes with HVT."""


def encoder_names() -> tuple[str, ...]:
    """The values of ``--encoder`` here: HVT's own first, whether or not the device is there; none is loaded."""
    return (X265, *sorted(installed(ENCODERS).keys() - {X265}))


def check_encoder(name: str) -> None:
    """Raise `UserError` if no encoder has that name, or more than one; nothing is opened."""
    built_in = name == X265
    entry = the_one(ENCODERS, name, what=_WHAT, built_in=built_in)
    if entry is None and name in _BROUGHT:
        raise not_installed(f"--encoder {name}", "hvt[edge]")
    if not built_in and entry is None:
        raise UserError(f"--encoder {name!r} is not known: choose one of {', '.join(encoder_names())}")


def open_encoder(name: str, settings: EncoderSettings) -> Encoder:
    """Open the encoder. Raises `UserError` if there is none, or it does not load or refuses the settings."""
    # Imported only to open one: at each start only names are checked.
    from hvt_edge.video.x265 import BaseEncoder  # noqa: PLC0415

    if name == X265:
        return BaseEncoder(settings)
    check_encoder(name)
    entry = the_one(ENCODERS, name, what=_WHAT, built_in=False)
    assert entry is not None, "checked"
    made = loaded(entry, lambda make: make(settings), what=_WHAT)
    # A camera's units are checked as they come, and its stage keeps one encoder while rates change.
    return cast("Encoder", made) if name == PASSTHROUGH else CheckedEncoder(made)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderPlan:
    """All settings of an encoder except rates and preset."""

    name: str
    size: tuple[int, int]
    nominal_fps: float
    """Source frames a second."""
    edge_id: str
    window_s: float
    metadata_bps: int
    threads: int
    headroom: float = 1.0
    """The share of its rate that the encoder is set to."""

    def open(self, rates: Rates, *, preset: str) -> Encoder:
        """Open the encoder at its share of the budget. Raises `UserError` if it refuses the settings."""
        settings = encoder_settings(
            size=self.size,
            fps=self.nominal_fps / rates.decimation,
            preset=preset,
            # The rate reserved for tracks may be the base's while none are sent.
            total_bps=max(rates.total_bps - self.metadata_bps, rates.base_bps),
            base_bps=rates.base_bps,
            edge_id=self.edge_id,
            window_s=self.window_s,
        )
        bitrate_bps = max(1, round(settings.bitrate_bps * self.headroom))
        return open_encoder(self.name, replace(settings, bitrate_bps=bitrate_bps, threads=self.threads))
