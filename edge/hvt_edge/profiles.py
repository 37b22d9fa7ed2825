"""Settings in one word: what ``--profile`` stands for. A flag or a file that says otherwise wins."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvt_edge.config import EdgeConfig

__all__ = ["PROFILES", "with_profile"]

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


def with_profile(config: EdgeConfig, *, given: Collection[str]) -> EdgeConfig:
    """The configuration with the profile's settings, except for fields that the user has ``given``."""
    if config.profile is None:
        return config
    settings = dict(PROFILES[config.profile])
    if config.regime is not None:  # which says the share itself
        del settings["video_share"]
    if "candidates" in given and config.candidates != "source":
        del settings["tiles"]
    return replace(config, **{name: value for name, value in settings.items() if name not in given})
