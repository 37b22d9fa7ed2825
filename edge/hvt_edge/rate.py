"""From a budget in line bits to the bits that x265 is given."""

from __future__ import annotations

from hvt_edge.encode import VBV_S, EncoderSettings
from hvt_edge.send import base_overhead_bps

__all__ = ["encoder_settings"]

# The fullest rolling second over the target, keyframes on demand included, from 300 kbps up (see encode).
_PEAK = 1.14
_TIGHT_VBV_S = 0.1
_TIGHT_PEAK = 1.04  # of 1.05 to 1.09; what is left waits some milliseconds (budget.earliest_ns)


def encoder_settings(
    *, size: tuple[int, int], fps: float, preset: str, total_bps: int, base_bps: int, edge_id: str
) -> EncoderSettings:
    """What to ask of x265 so that the base stream stays within B_v, and its fullest second within B_tot.

    Where stills have a share, they yield to the base's peaks. Where video takes (nearly) the whole budget, as in M0,
    nothing can yield: the VBV is made tighter and the target lowered by the peak that is left.
    """
    tight = base_bps * _PEAK > total_bps
    line_bps = min(base_bps, total_bps / _TIGHT_PEAK) if tight else base_bps
    payload_bps = line_bps - base_overhead_bps(line_bps, fps=fps, edge_id=edge_id)
    return EncoderSettings(
        size=size,
        fps=fps,
        bitrate_bps=max(1, round(payload_bps)),
        preset=preset,
        vbv_s=_TIGHT_VBV_S if tight else VBV_S,
    )
