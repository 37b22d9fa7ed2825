"""The machine of an edge, read as somebody asks."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

_ZONES = "sys/class/thermal/thermal_zone*/temp"
_WIRELESS = "proc/net/wireless"
_HEAD_LINES = 2


@dataclass(frozen=True, slots=True)
class SystemReading:
    """The machine's temperature and the quality of its wireless link; None where the system gives none."""

    temperature_c: float | None = None
    wireless_quality: float | None = None
    """The driver's count, of 70 with most drivers."""
    wireless_dbm: float | None = None


def read_system(root: Path = Path("/")) -> SystemReading:
    """Read the present values; ``root`` is the folder of ``sys`` and ``proc``."""
    quality, level = _wireless(root / _WIRELESS)
    return SystemReading(_hottest_c(root), quality, level)


def _hottest_c(root: Path) -> float | None:
    hottest: float | None = None
    for zone in root.glob(_ZONES):
        with contextlib.suppress(OSError, ValueError):  # a sensor that is switched off answers with an error
            here = int(zone.read_text(encoding="ascii")) / 1000
            hottest = here if hottest is None else max(hottest, here)
    return hottest


def _wireless(path: Path) -> tuple[float | None, float | None]:
    # Quality and level of the first interface (proc(5)): ``wlan0: 0000 54. -56. -256 …``.
    with contextlib.suppress(OSError, ValueError, IndexError):
        _, _, rest = path.read_text(encoding="ascii").splitlines()[_HEAD_LINES].partition(":")
        _, quality, level = (float(one) for one in rest.split()[:3])
        return quality, level if level < 0 else None  # above, an old driver counts in units of its own
    return None, None
