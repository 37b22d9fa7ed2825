"""Whether a source still shows anything: pictures that are black, or the same, for ten seconds. Pure."""

from __future__ import annotations

import numpy as np

from hvt_common.units import SECOND_NS
from hvt_common.values import Image

_LONG_NS = 10 * SECOND_NS
_BLACK = 24
"""The highest level of a picture in which nobody sees anything."""
_EACH = 8


class PictureCondition:
    """Fed with each new picture; one that is only shown again is not fed again."""

    def __init__(self) -> None:
        self._before: Image | None = None
        self._since_ns: dict[str, int] = {}
        self._said: set[str] = set()

    def note(self, picture_bgr: Image, *, at_ns: int) -> str:
        """The warning, once for each stretch; else empty. ``at_ns`` is the capture time."""
        sample = picture_bgr[::_EACH, ::_EACH].copy()
        before, self._before = self._before, sample
        is_black = int(sample.max()) <= _BLACK
        is_same = before is not None and np.array_equal(before, sample)
        now = {"is black": is_black, "has not changed": is_same and not is_black}
        ended = [kind for kind in self._said if not now[kind]]
        self._said.difference_update(ended)
        for kind, holds in now.items():
            if not holds:
                self._since_ns.pop(kind, None)
            elif at_ns - self._since_ns.setdefault(kind, at_ns) >= _LONG_NS and kind not in self._said:
                self._said.add(kind)
                return f"its picture {kind} for {_LONG_NS // SECOND_NS} s: look at the camera and its cable"
        return "its picture is alive again" if ended and not self._said else ""
