"""Which codes on roofs a flight showed: read in its base pictures, and in its stills."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hvt_common.values import Image
from hvt_scene import CodeInView
from hvt_study.demo.flown import Flown, FlownStill
from hvt_study.reading.observer import INSIDE_SHARE
from hvt_study.reading.reader import CodeReader, code_crop, share_inside
from hvt_study.reading.score import LEAST_VISIBLE, Code

_PICTURES = 6
"""Of the base stream in which a code is read, spread over the time that it is whole in view: reading takes time."""
_CONTEXT = 1.2
"""Around a code where somebody looks at it, in its longer sides."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A still that shows a whole code."""

    object_id: int
    still: FlownStill
    box_base_px: tuple[float, float, float, float]
    """Of the code at the still's frame."""


@dataclass(frozen=True, slots=True)
class Legible:
    """The objects whose codes were read right at least once, of one flight."""

    video: frozenset[int]
    stills: Mapping[int, Shown]
    """By object, the first still that was read right."""

    @property
    def every(self) -> frozenset[int]:
        """Either way."""
        return self.video | self.stills.keys()


def read_codes_of(
    flown: Flown,
    codes: Mapping[int, Code],
    views: Sequence[Sequence[CodeInView]],
    *,
    base_per_source: float,
    reader: CodeReader,
) -> Legible:
    """Read every still that holds a whole code, and each code in some base pictures."""
    video = {
        object_id
        for object_id, code in codes.items()
        if _in_video(flown, code, views, base_per_source=base_per_source, reader=reader)
    }
    read: dict[int, Shown] = {}
    for shown in stills_with_codes(flown, codes, views, base_per_source=base_per_source):
        if shown.object_id not in read:
            (reading,) = reader.read([_still_crop(shown)])
            if reading.text == codes[shown.object_id].text:
                read[shown.object_id] = shown
    return Legible(frozenset(video), read)


def stills_with_codes(
    flown: Flown,
    codes: Mapping[int, Code],
    views: Sequence[Sequence[CodeInView]],
    *,
    base_per_source: float,
) -> Iterator[Shown]:
    """Every still with each code that lies whole in it."""
    for still in flown.stills:
        place = np.array(still.place_base_px)
        for one in _whole(codes, views, still.frame):
            box = one.box_source_px * base_per_source
            if share_inside(box, place) >= INSIDE_SHARE:
                x1, y1, x2, y2 = box.tolist()
                yield Shown(one.object_id, still, (x1, y1, x2, y2))


def code_pictures(shown: Shown, base: Image) -> tuple[Image, Image]:
    """The same roof for the eye: of a base picture, and of the still; each enlarged from what it is."""
    x1, y1, x2, y2 = shown.box_base_px
    reach = _CONTEXT * max(x2 - x1, y2 - y1) / 2
    x, y = (x1 + x2) / 2, (y1 + y2) / 2
    wide = (x - reach, y - reach, x + reach, y + reach)
    return code_crop(base, wide), code_crop(shown.still.image_bgr, _in_still(shown.still, wide))


def _in_video(
    flown: Flown,
    code: Code,
    views: Sequence[Sequence[CodeInView]],
    *,
    base_per_source: float,
    reader: CodeReader,
) -> bool:
    places = [
        (frame, one)
        for frame in flown.pictures
        for one in views[frame - 1]
        if one.object_id == code.object_id and one.visible >= LEAST_VISIBLE
    ]
    some = np.linspace(0, len(places) - 1, min(_PICTURES, len(places))).round().astype(int)
    for frame, one in (places[number] for number in some.tolist()):
        crop = code_crop(flown.pictures[frame], (one.box_source_px * base_per_source).tolist())
        if reader.read([crop])[0].text == code.text:
            return True
    return False


def _whole(codes: Mapping[int, Code], views: Sequence[Sequence[CodeInView]], frame: int) -> list[CodeInView]:
    return [one for one in views[frame - 1] if one.visible >= LEAST_VISIBLE and one.object_id in codes]


def _still_crop(shown: Shown) -> Image:
    return code_crop(shown.still.image_bgr, _in_still(shown.still, shown.box_base_px))


def _in_still(still: FlownStill, box_base_px: Sequence[float]) -> list[float]:
    x1, y1, x2, _ = still.place_base_px
    scale = still.image_bgr.shape[1] / (x2 - x1)
    return [(value - start) * scale for value, start in zip(box_base_px, (x1, y1, x1, y1), strict=True)]
