"""The frame loop's contract with an encoder, and every one by its name.

There are x265, none (passthrough), those of hardware, and those that other packages install.

A third party's is an entry point of the group ``hvt.encoders``: `MakeEncoder`. Its package is imported when
it is named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Protocol

from hvt_common.errors import UserError
from hvt_common.runtime.plug_ins import installed, loaded, the_one
from hvt_common.values import AccessUnit, Frame
from hvt_edge.operating import Rates
from hvt_edge.video.encoder_settings import EncoderSettings, encoder_settings

if TYPE_CHECKING:
    from hvt_edge.video.x265 import Region


class Encoder(Protocol):
    """Turns frames into HEVC access units, one for each, at once, and never more bits than it was opened for.

    It is opened anew, with another `EncoderSettings`, for each change of rate, and used from one thread.
    """

    @property
    def mean_qp(self) -> float:
        """Of the frame encoded last: the quantiser parameter (0…51); NaN where it is not known."""
        ...

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """The unit of ``frame.base_bgr``, uint8 (height, width, 3) BGR, not to be written to, as Annex B.

        4:2:0, 8 bits, BT.709, limited range; each picture refers to earlier ones alone. With ``keyframe`` it is an
        IDR with VPS, SPS and PPS before it, and so is the first. ``regions`` are given to x265 alone. Raises
        whatever it likes: the frame is left out, and another encoder is opened.
        """
        ...


MakeEncoder = Callable[[EncoderSettings], Encoder]
"""The entry point of the group ``hvt.encoders``; it raises if it refuses the settings."""


class CheckedEncoder:
    """One that HVT has not tested itself: `ValueError` for a unit that no ground could use. Without regions."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._begun = False

    @property
    def mean_qp(self) -> float:
        """See `Encoder`; NaN for one that says nothing, or an impossible value."""
        said = getattr(self._encoder, "mean_qp", math.nan)
        return float(said) if isinstance(said, int | float) and 0 <= said <= 51 else math.nan

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """See `Encoder`. The unit itself tells whether it is a keyframe, whatever the encoder says of it."""
        from hvt_common.video.hevc import is_keyframe, parameter_sets  # noqa: PLC0415  (the command line needs no decoder)

        assert not regions, "config.check() refuses regions with another encoder than x265"
        unit = self._encoder.encode(frame, keyframe=keyframe)
        data = getattr(unit, "data", None)
        if not isinstance(data, bytes) or not data:
            raise ValueError(f"it gave no access unit for frame {frame.index}, and has to give one for each")
        # To begin a decoder with it takes both; another I picture is a large frame like any other.
        begins = is_keyframe(data) and bool(parameter_sets(data))
        if (keyframe or not self._begun) and not begins:
            raise ValueError(f"frame {frame.index} was to be a keyframe, and is no IDR with VPS, SPS and PPS")
        self._begun = True
        return AccessUnit(frame.index, frame.capture_ns, data, keyframe=begins)

    def close(self) -> None:
        """Let go of it, and so of its device and memory."""
        del self._encoder


@dataclass(frozen=True, slots=True)
class HardwareRow:
    """One encoder of FFmpeg."""

    codec: str
    """Its name there, and of ``--encoder``."""
    pixel_format: str
    needs: str
    """The hardware that it needs."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Zero latency, constant rate, and an IDR where a keyframe is forced."""


GROUP = "hvt.encoders"
"""The entry points' group."""
X265 = "x265"
"""HVT's own, measured encoder: the only one that takes regions and needs no qualification."""
PASSTHROUGH = "passthrough"
"""None at all: the units of a camera that makes HEVC itself."""
_WHAT = "encoder"


# None of them has been run by the project: the rows were written from FFmpeg's documentation. What keeps a wrong row
# from a flight is the qualification run at the start.
_ROWS = (
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
HARDWARE: Mapping[str, HardwareRow] = MappingProxyType({row.codec: row for row in _ROWS})
"""By name."""
_OWN = frozenset({X265, PASSTHROUGH}) | HARDWARE.keys()


def encoder_names() -> tuple[str, ...]:
    """The values of ``--encoder`` here: HVT's own first, whether or not the device is there; none is loaded."""
    return (X265, PASSTHROUGH, *HARDWARE, *sorted(installed(GROUP).keys() - _OWN))


def check_encoder(name: str) -> None:
    """Raise `UserError` where there is none of that name, or more than one; nothing is opened."""
    built_in = name in _OWN
    entry = the_one(GROUP, name, what=_WHAT, built_in=built_in)
    if not built_in and entry is None:
        raise UserError(f"--encoder {name!r} is not known: choose one of {', '.join(encoder_names())}")


def open_encoder(name: str, settings: EncoderSettings) -> Encoder:
    """Open it. Raises `UserError` where there is none, or it does not load or take the settings."""
    # Imported for who opens one: names alone are checked at each start.
    from hvt_edge.video.encoders.hardware import HardwareEncoder  # noqa: PLC0415
    from hvt_edge.video.encoders.passthrough import Passthrough  # noqa: PLC0415
    from hvt_edge.video.x265 import BaseEncoder  # noqa: PLC0415

    if name == X265:
        return BaseEncoder(settings)
    if name == PASSTHROUGH:
        return Passthrough()
    check_encoder(name)
    if name in HARDWARE:
        return CheckedEncoder(HardwareEncoder(settings, row=HARDWARE[name]))
    entry = the_one(GROUP, name, what=_WHAT, built_in=False)
    assert entry is not None, "checked"
    return CheckedEncoder(loaded(entry, lambda make: make(settings), what=_WHAT))


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderPlan:
    """All that an encoder is opened with but rates and preset."""

    name: str
    size: tuple[int, int]
    nominal_fps: float
    """Source frames a second."""
    edge_id: str
    window_s: float
    metadata_bps: int
    side_data: bool
    threads: int
    headroom: float = 1.0
    """The share of its rate that the encoder is set to."""

    def open(self, rates: Rates, *, preset: str) -> Encoder:
        """Open it at the rate that the budget leaves it. Raises `UserError` where it does not take the settings."""
        settings = encoder_settings(
            size=self.size,
            fps=self.nominal_fps / rates.decimation,
            preset=preset,
            # What is kept for tracks may be the base's while none are sent.
            total_bps=max(rates.total_bps - self.metadata_bps, rates.base_bps),
            base_bps=rates.base_bps,
            edge_id=self.edge_id,
            window_s=self.window_s,
            side_data=self.side_data,
        )
        bitrate_bps = max(1, round(settings.bitrate_bps * self.headroom))
        return open_encoder(self.name, replace(settings, bitrate_bps=bitrate_bps, threads=self.threads))
