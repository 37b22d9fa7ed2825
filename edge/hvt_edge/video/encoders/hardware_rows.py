"""Encoders of graphics cards and boards that FFmpeg has, a row for each.

None of them has been run by the project: the rows were written from FFmpeg's documentation. What keeps a wrong row
from a flight is the qualification run at the start.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType


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
