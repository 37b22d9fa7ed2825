"""Codes painted on roofs: four letters and digits on a panel, as services mark their vehicles for aircraft.

The characters are strokes of our own, because fonts differ between versions of OpenCV. No two of the alphabet look
alike: there is one of O and 0, B and 8, S and 5, Z and 2, G and 6 or C, I and 1, V and Y, and none that is
another one upside down.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from hvt_scene.drawing.canvas import SPRITE_M_PER_PX, Colour, Points, Sprite

CODE_LENGTH = 4
HEIGHTS_PX = (5.0, 14.0)
"""Height of the characters in pixels of the source, least and greatest, at the camera's mean altitude."""

_Strokes = tuple[tuple[tuple[float, float], ...], ...]
_P: _Strokes = (((0, 6), (0, 0), (3, 0), (4, 1), (4, 2.2), (3, 3.2), (0, 3.2)),)
_THREE: _Strokes = (
    ((0, 0.8), (1, 0), (3, 0), (4, 1), (4, 2), (3, 3), (1.6, 3)),
    ((3, 3), (4, 4), (4, 5), (3, 6), (1, 6), (0, 5.2)),
)
_GLYPHS: dict[str, _Strokes] = {
    "A": (((0, 6), (2, 0), (4, 6)), ((0.8, 4), (3.2, 4))),
    "C": (((4, 1), (3, 0), (1, 0), (0, 1), (0, 5), (1, 6), (3, 6), (4, 5)),),
    "E": (((4, 0), (0, 0), (0, 6), (4, 6)), ((0, 3), (3, 3))),
    "F": (((4, 0), (0, 0), (0, 6)), ((0, 3), (3, 3))),
    "H": (((0, 0), (0, 6)), ((4, 0), (4, 6)), ((0, 3), (4, 3))),
    "J": (((4, 0), (4, 5), (3, 6), (1, 6), (0, 5)),),
    "K": (((0, 0), (0, 6)), ((4, 0), (0, 3.4)), ((1.2, 2.6), (4, 6))),
    "M": (((0, 6), (0, 0), (2, 3), (4, 0), (4, 6)),),
    "N": (((0, 6), (0, 0), (4, 6), (4, 0)),),
    "P": _P,
    "R": (*_P, ((2, 3.2), (4, 6))),
    "T": (((0, 0), (4, 0)), ((2, 0), (2, 6))),
    "U": (((0, 0), (0, 5), (1, 6), (3, 6), (4, 5), (4, 0)),),
    "X": (((0, 0), (4, 6)), ((4, 0), (0, 6))),
    "Y": (((0, 0), (2, 3), (4, 0)), ((2, 3), (2, 6))),
    "3": _THREE,
    "4": (((3, 6), (3, 0), (0, 4), (4, 4)),),
    "7": (((0, 0), (4, 0), (1.5, 6)),),
    "9": (((4, 2.6), (3, 3.4), (1, 3.4), (0, 2.4), (0, 1), (1, 0), (3, 0), (4, 1), (4, 5), (3, 6), (1, 6)),),
}
"""Strokes on a grid of 4 by 6 units, y down; a stroke is one unit wide, so a character is 7 units high."""
ALPHABET = "".join(_GLYPHS)

_UNITS_HIGH, _ADVANCE = 7.0, 6.4
_LONG = (_ADVANCE * CODE_LENGTH - (_ADVANCE - 5.0)) / _UNITS_HIGH  # of a code, in heights of its characters
_MARGIN = 0.35  # of the panel around it, likewise
_FINER = 4  # the panel is drawn so many times finer than a sprite and averaged
_COLOURS: tuple[tuple[Colour, Colour], ...] = (
    ((30.0, 28.0, 28.0), (236.0, 238.0, 238.0)),
    ((30.0, 28.0, 28.0), (60.0, 205.0, 245.0)),
    ((240.0, 240.0, 240.0), (120.0, 52.0, 26.0)),
    ((240.0, 240.0, 240.0), (44.0, 40.0, 40.0)),
    ((238.0, 238.0, 240.0), (40.0, 36.0, 170.0)),
)
"""B, G, R of characters and panel: black on white and on yellow, white on blue, black and red."""
_PLACES: dict[str, tuple[float, float]] = {
    "van": (-0.13, 0.60),
    "truck": (-0.16, 0.56),
    "bus": (-0.06, 0.60),
}
"""Class with roofs that bear codes: where the panel's middle lies, and how long it may be, in lengths of the body."""
_MOST_WIDE = 0.80  # of the body's width


@dataclass(frozen=True, slots=True)
class RoofCode:
    """A code on one body."""

    text: str
    height_m: float
    """Height of its characters."""
    centre_m: tuple[float, float]
    """In body axes, nose to +x; the code is read along +x."""
    colours: tuple[Colour, Colour]
    """Colours of characters and panel."""

    @property
    def corners_m(self) -> Points:
        """(4, 2) of the characters, body axes: where reading begins, clockwise in the picture (y down)."""
        return self._corners(self.height_m * _LONG / 2, self.height_m / 2)

    @property
    def panel_m(self) -> Points:
        """(4, 2) of the panel, likewise."""
        margin = self.height_m * _MARGIN
        return self._corners(self.height_m * _LONG / 2 + margin, self.height_m / 2 + margin)

    def _corners(self, x: float, y: float) -> Points:
        return np.array([(-x, -y), (x, -y), (x, y), (-x, y)]) + self.centre_m


def draw_code(
    class_name: str, sprite: Sprite, rng: np.random.Generator, *, m_per_px: float
) -> RoofCode | None:
    """Draw a code for a body; None where its class bears none, or not even the smallest characters fit.

    Characters are of `HEIGHTS_PX` at ``m_per_px`` of the source. As much is drawn from ``rng`` whether a code fits or
    not.
    """
    text = "".join(ALPHABET[one] for one in rng.integers(len(ALPHABET), size=CODE_LENGTH))
    share, colours = float(rng.random()), _COLOURS[int(rng.integers(len(_COLOURS)))]
    if class_name not in _PLACES:
        return None
    place, long = _PLACES[class_name]
    length, width = np.ptp(sprite.outline_m, axis=0).tolist()
    most = min(long * length / (_LONG + 2 * _MARGIN), _MOST_WIDE * width / (1 + 2 * _MARGIN))
    least, greatest = HEIGHTS_PX[0] * m_per_px, min(HEIGHTS_PX[1] * m_per_px, most)
    if greatest < least:
        return None
    return RoofCode(text, least + share * (greatest - least), (place * length, 0.0), colours)


def paint_code(sprite: Sprite, code: RoofCode) -> Sprite:
    bgra = sprite.bgra.copy()
    high, wide = bgra.shape[:2]
    corners = code.panel_m / SPRITE_M_PER_PX + np.array([wide / 2, high / 2])
    left, top = np.floor(corners.min(0)).astype(int).tolist()
    right, bottom = np.ceil(corners.max(0)).astype(int).tolist()
    colour, opacity = _panel(code, (left - wide / 2, top - high / 2), (right - left, bottom - top))
    place = bgra[top:bottom, left:right]
    # Nothing is painted beside the body, whatever its outline.
    solid = place[..., 3:] / 255.0
    mixed = place[..., :3] * (1 - opacity) + colour * solid * opacity
    place[..., :3] = np.minimum(np.rint(mixed), place[..., 3:]).astype(np.uint8)
    return Sprite(bgra, height_m=sprite.height_m)


def _panel(
    code: RoofCode, origin: tuple[float, float], size: tuple[int, int]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Colour (h, w, 3) and opacity (h, w, 1) on sprite pixels from ``origin`` (about the body's centre) on."""
    fine = SPRITE_M_PER_PX / _FINER
    shape = (size[1] * _FINER, size[0] * _FINER)
    start = np.array(origin) * SPRITE_M_PER_PX

    def fixed(points_m: Points) -> npt.NDArray[np.int32]:
        return np.round(((points_m - start) / fine - 0.5) * 16).astype(np.int32)

    picture = np.full((*shape, 3), code.colours[1], np.uint8)
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, fixed(code.panel_m), 255, cv2.LINE_AA, 4)
    unit = code.height_m / _UNITS_HIGH
    thick = max(1, round(unit / fine))
    corner = code.corners_m[0] + unit / 2
    for number, letter in enumerate(code.text):
        for stroke in _GLYPHS[letter]:
            points = corner + np.add(stroke, (number * _ADVANCE, 0)) * unit
            cv2.polylines(picture, [fixed(points)], False, code.colours[0], thick, cv2.LINE_AA, 4)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    opacity = cv2.resize(mask, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return small, opacity[..., None] / np.float32(255)
