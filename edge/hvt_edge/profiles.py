"""Settings in one word: what ``--profile`` stands for. A flag or a file that says otherwise wins."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

__all__ = ["PROFILES"]

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
