"""Settings in one word: the values of ``--profile`` and ``--regime``. A flag or a file overrides them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

_TRACKS = {"candidates": "source", "tiles": "auto", "send_tracks": True}
_THIN = {
    "method": "M6",
    "still_codec": "residual",
    **_TRACKS,
    "fps": "auto",
    "video_share": "auto",
    "borrow_unused": True,
    "group_stills": True,
    "gate": 32.0,
    "fidelity": 36.0,
    "roi_depth": 0.1,
}
_PAPER = {"method": "M5", "still_codec": "jpeg", "video_share": 0.8125}

PROFILES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "auto": MappingProxyType(_THIN),  # their gain is measured (`EdgeConfig.measures`)
        "paper": MappingProxyType(_PAPER),
        "thin": MappingProxyType(_THIN),
        # The names of hvt-study compare (docs/compare.md); M0 and R0 are methods.
        "M0-fps": MappingProxyType({"method": "M0", "fps": "auto"}),
        "M0-best": MappingProxyType({"method": "M0", "fps": "auto", "size": "auto"}),
        "M5-jpeg": MappingProxyType({"method": "M5", "still_codec": "jpeg"}),
        "M5-residual": MappingProxyType({"method": "M5", "still_codec": "residual"}),
        "tracks": MappingProxyType({"method": "M0", **_TRACKS}),
        "M6": MappingProxyType(_THIN),
    }
)


@dataclass(frozen=True, slots=True)
class Regime:
    """A budget of the paper: the total, and the share for video."""

    budget_bps: int
    video_share: float


REGIMES = {
    "low": Regime(budget_bps=800_000, video_share=0.8125),  # 0.65 + 0.15 Mbps
    "moderate": Regime(budget_bps=1_400_000, video_share=1.2 / 1.4),  # 1.20 + 0.20 Mbps
}
