"""Resampling in time and space: any frame rate and any picture size to those of the base stream. Pure functions.

In time the rule is *hold*: the base frame of instant k / fps shows the latest source frame at or before it. Nothing
is blended; a slower source is repeated, a faster one loses frames. In space the picture is scaled by one factor on
both axes and centred: whole between black borders (letterbox) or filling the frame (crop); see `View`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from fractions import Fraction
from typing import TypeVar

import cv2
import numpy as np

from hvt_common.units import SECOND_NS
from hvt_common.values import Fit, Frame, Image, View
from hvt_edge.source.contract import BaseSize

_log = logging.getLogger(__name__)

_T = TypeVar("_T")

_MOST_SIZES = 4
"""Number of sizes that are logged: in a folder of photographs each picture may have one of its own."""


def capture_time_ns(index: int, *, fps: Fraction, start_ns: int) -> int:
    """Media time of base frame ``index`` as Unix time in nanoseconds, rounded once."""
    return start_ns + round(index * 1_000_000_000 / fps)


def base_frame_count(duration_s: Fraction, *, fps: Fraction) -> int:
    """Number of instants k / fps in a clip of that duration, the first at 0."""
    return -int(-duration_s * fps // 1)


def hold(
    stamped: Iterable[tuple[Fraction, _T]],
    *,
    fps: Fraction,
    tail_s: Fraction,
    slack_s: Fraction = Fraction(0),
) -> Iterator[tuple[int, _T]]:
    """Resample (seconds, frame) in order to the base rate: (index, frame) for index 0, 1, 2 … without a gap.

    Each index gets the latest frame at or before index / fps; the first is the clip's zero, and the last is
    shown for ``tail_s``. A frame that does not come after its predecessor replaces it. A time stamp ``slack_s`` too
    late still counts as on time: rounded to milliseconds, 2/30 s becomes 0.067 s.
    """
    slack = min(slack_s, 1 / (4 * fps))
    index = 0
    zero: Fraction | None = None
    shown: tuple[Fraction, _T] | None = None
    for time_s, frame in stamped:
        zero = time_s if zero is None else zero
        elapsed = time_s - zero - slack
        while shown is not None and index / fps < elapsed:
            yield index, shown[1]
            index += 1
        shown = (elapsed + slack, frame)
    if shown is None:
        return
    end_s = shown[0] + tail_s - slack
    while index / fps < end_s or index == 0:
        yield index, shown[1]
        index += 1


class Gate:
    """Selects frames of a live camera so that the base rate holds on average, whatever the jitter.

    All frames of a camera slower than the base rate are taken; none is repeated.
    """

    def __init__(self, fps: float) -> None:
        self._period_ns = round(1e9 / fps)
        self._due_ns: int | None = None
        # A frame a little early is taken, or a 30 fps camera at 15 fps would slip to every third frame.
        self._early_ns = self._period_ns // 4

    def accept(self, capture_ns: int) -> bool:
        """Whether the frame of that capture time is wanted; call it once for each frame, in order."""
        if self._due_ns is not None and capture_ns < self._due_ns - self._early_ns:
            return False
        late = self._due_ns is None or capture_ns > self._due_ns + self._period_ns
        self._due_ns = (capture_ns if late or self._due_ns is None else self._due_ns) + self._period_ns
        return True

    def wanted(self, count: int, *, before_ns: int) -> int:
        """How many of ``count`` frames were due that did not come before the one of that time."""
        due_ns = before_ns if self._due_ns is None else self._due_ns
        return min(count, max(0, (before_ns + self._early_ns - due_ns) // self._period_ns))


class Resizer:
    """Makes base frames out of source pictures of one size.

    Attributes:
        view: the map from source to base pixels. Pictures follow it to within half a pixel of the base, because
            borders and cuts lie on whole pixels.

    Pictures of another size, and those that are black or the same for long, are logged under ``name``.
    """

    def __init__(
        self, source_size: tuple[int, int], base_size: BaseSize, *, fit: Fit, name: str = "source"
    ) -> None:
        size = base_size(source_size) if callable(base_size) else base_size
        self.view = View.fitted(source_size, size, fit=fit)
        self._fit, self._name = fit, name
        self._condition = PictureCondition()
        self._sizes = {source_size}

    def frame(self, source_bgr: Image, *, index: int, capture_ns: int) -> Frame:
        """The base frame of a picture, which is first fitted to the source size if it has another. Both read-only."""
        self._tell_size(source_bgr.shape[1], source_bgr.shape[0])
        whole = into_canvas(source_bgr, self.view.source_size)
        whole.flags.writeable = False
        base = self._resized(whole)
        base.flags.writeable = False
        if said := self._condition.note(base, at_ns=capture_ns):
            _log.warning("%s: %s", self._name, said)
        return Frame(index=index, capture_ns=capture_ns, source_bgr=whole, base_bgr=base)

    def _tell_size(self, wide: int, high: int) -> None:
        if (wide, high) not in self._sizes and len(self._sizes) < _MOST_SIZES:
            self._sizes.add((wide, high))
            first = f"{self.view.source_size[0]}x{self.view.source_size[1]}"
            _log.warning(
                "%s: a picture is %dx%d, the first was %s: it is fitted into %s, in video and stills; a new start of"
                " the edge goes by its first picture again",
                *(self._name, wide, high, first, first),
            )

    def _resized(self, source: Image) -> Image:
        if self.view.source_size == self.view.base_size:
            return source
        return _letterboxed(source, self.view) if self._fit == "letterbox" else _cropped(source, self.view)


def into_canvas(picture: Image, size: tuple[int, int]) -> Image:
    """The whole picture centred in a black canvas of that (width, height); itself where it fits exactly."""
    high, wide = picture.shape[:2]
    if (wide, high) == size:
        return picture
    return _letterboxed(picture, View.fitted((wide, high), size, fit="letterbox"))


def _letterboxed(source: Image, view: View) -> Image:
    (wide, high), (base_wide, base_high) = view.source_size, view.base_size
    inner = (min(base_wide, round(wide * view.scale)), min(base_high, round(high * view.scale)))
    scaled = _scaled(source, (max(inner[0], 1), max(inner[1], 1)))
    if inner == view.base_size:
        return scaled
    base = np.zeros((base_high, base_wide, 3), np.uint8)
    left, top = (base_wide - scaled.shape[1]) // 2, (base_high - scaled.shape[0]) // 2
    base[top : top + scaled.shape[0], left : left + scaled.shape[1]] = scaled
    return base


def _cropped(source: Image, view: View) -> Image:
    (wide, high), (base_wide, base_high) = view.source_size, view.base_size
    if view.scale > 1:  # cut on the finer grid, which is the base's here
        grown = _scaled(
            source, (max(base_wide, round(wide * view.scale)), max(base_high, round(high * view.scale)))
        )
        left, top = (grown.shape[1] - base_wide) // 2, (grown.shape[0] - base_high) // 2
        return np.ascontiguousarray(grown[top : top + base_high, left : left + base_wide])
    crop = (
        min(wide, max(1, round(base_wide / view.scale))),
        min(high, max(1, round(base_high / view.scale))),
    )
    left, top = (wide - crop[0]) // 2, (high - crop[1]) // 2
    return _scaled(source[top : top + crop[1], left : left + crop[0]], view.base_size)


def _scaled(picture: Image, size: tuple[int, int]) -> Image:
    # Averaged when it shrinks, so that nothing aliases; cubic when it grows.
    high, wide = picture.shape[:2]
    if (wide, high) == size:
        return np.ascontiguousarray(picture)
    shrinks = size[0] < wide or size[1] < high
    how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


_LONG_NS = 10 * SECOND_NS
_BLACK = 24
"""The highest level of a picture that counts as black."""
_EACH = 8


class PictureCondition:
    """Notes each new picture; a picture that is only shown again is not passed again."""

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
