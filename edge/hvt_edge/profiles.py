"""Settings in one word: what ``--profile`` and ``--regime`` stand for. A flag or a file that says otherwise wins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

__all__ = ["PROFILES", "REGIMES", "Regime"]

PROFILES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "thin": MappingProxyType(
            {
                "method": "M6",
                "still_codec": "residual",
                "candidates": "source",
                "tiles": "auto",
                "send_tracks": True,
                "fps": "auto",
                "video_share": "auto",
                "borrow_unused": True,
                "group_stills": True,
                "gate": 32.0,
                "fidelity": 36.0,
                "roi_depth": 0.1,
            }
        ),
    }
)


@dataclass(frozen=True, slots=True)
class Regime:
    """A budget of the paper: so much in all, so much of it for video."""

    budget_bps: int
    video_share: float


REGIMES = {
    "low": Regime(budget_bps=800_000, video_share=0.8125),  # 0.65 + 0.15 Mbps
    "moderate": Regime(budget_bps=1_400_000, video_share=1.2 / 1.4),  # 1.20 + 0.20 Mbps
}
