"""A sensor's levels of heat as eight bits that a person and a network can read. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

_LOW_PCT, _HIGH_PCT = 0.5, 99.5
_LEAST_SPAN = 64
"""Sensor levels: a wall of one temperature is not to become noise from black to white."""
_LEAST_DEGREES = 1.0
"""The same of floating-point pictures, which are in degrees, or from 0 to 1."""
_SETTLING_S = 3.0
"""A warm body that comes in must not darken all else at once."""
_LONGEST_S = 1.0
_EACH = 4
"""Each fourth pixel of each fourth row says enough."""


class Stretch:
    """Between its percentiles 0.5 and 99.5, which follow the scene with a time constant of three seconds.

    ``note`` is told the first levels.
    """

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note = note
        self._range: tuple[float, float] | None = None
        self._at_s = 0.0

    def bgr(self, levels: npt.NDArray[Any], *, at_s: float, bits: int = 0) -> Image:
        """(height, width) numbers as (height, width, 3) uint8; ``at_s`` is the picture's time in seconds.

        What is not finite, as where a sensor saw nothing, is black. ``bits`` are those of the source, where the array
        has more.
        """
        first, bits = self._range is None, bits or 8 * levels.itemsize
        least: float = _LEAST_SPAN
        if np.issubdtype(levels.dtype, np.floating):
            seen = np.isfinite(levels)
            levels = np.where(seen, levels, levels[seen].min() if seen.any() else 0)
            least = _LEAST_DEGREES
        low, high = self._settle(np.percentile(levels[::_EACH, ::_EACH], (_LOW_PCT, _HIGH_PCT)), at_s)
        missing = max(0.0, least - (high - low)) / 2
        low, high = low - missing, high + missing
        if first:
            self._note(
                f"its {bits}-bit grey is a sensor's: levels {low:.5g} to {high:.5g} are stretched to black and "
                f"white, the percentiles {_LOW_PCT} and {_HIGH_PCT}, which follow the scene slowly"
            )
        scaled = (levels.astype(np.float32) - np.float32(low)) * np.float32(255 / (high - low))
        return np.repeat(np.clip(np.rint(scaled), 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)

    def _settle(self, found: npt.NDArray[np.float64], at_s: float) -> tuple[float, float]:
        passed_s = min(_LONGEST_S, max(0.0, at_s - self._at_s))
        self._at_s = at_s
        if self._range is None:
            self._range = float(found[0]), float(found[1])
        share = 1 - math.exp(-passed_s / _SETTLING_S)
        low, high = (old + share * (float(new) - old) for old, new in zip(self._range, found, strict=True))
        self._range = low, high
        return low, high
