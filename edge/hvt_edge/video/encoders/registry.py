"""Every encoder by its name: x265, none (passthrough), those of hardware, and those that other packages install.

A third party's is an entry point of the group ``hvt.encoders``: `contract.MakeEncoder`. Its package is imported when
it is named.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from hvt_common.errors import UserError
from hvt_common.runtime.plug_ins import installed, loaded, the_one
from hvt_edge.video.encoder_settings import EncoderSettings
from hvt_edge.video.encoders.contract import Encoder, HardwareRow

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
    from hvt_edge.video.encoders.contract import CheckedEncoder  # noqa: PLC0415
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
