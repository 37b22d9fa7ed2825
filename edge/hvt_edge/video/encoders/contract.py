"""The frame loop's contract with an encoder, x265's or another's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from hvt_common.values import AccessUnit, Frame
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
