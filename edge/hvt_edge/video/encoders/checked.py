"""An encoder that HVT has not tested itself: its units are checked one by one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hvt_common.values import AccessUnit, Frame
from hvt_common.video.annex_b import is_keyframe, parameter_sets
from hvt_edge.video.encoders.contract import Encoder
from hvt_edge.video.regions import Region


class CheckedEncoder:
    """Itself an `Encoder`; `ValueError` for a unit that no ground could use. Without regions."""

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
