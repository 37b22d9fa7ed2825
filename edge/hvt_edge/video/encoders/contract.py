"""The frame loop's contract with an encoder, x265's or another's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from hvt_common.values import AccessUnit, Frame
from hvt_common.video.annex_b import is_keyframe, parameter_sets
from hvt_edge.video.encoder_settings import EncoderSettings

if TYPE_CHECKING:
    from hvt_edge.video.regions import Region


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
