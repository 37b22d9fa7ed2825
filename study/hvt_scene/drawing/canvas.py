"""Drawing in metres: a small canvas on which sprites are painted at a fixed fine resolution."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

SPRITE_M_PER_PX = 0.02
"""Resolution of a freshly drawn sprite; coarser levels are averaged from it."""

OUTLINE_POINTS = 48
"""Points of a sprite's outline, the same for all so that many can be projected at once."""

_SHIFT = 4  # OpenCV's fixed-point drawing: 1/16 pixel

Colour = tuple[float, float, float]
"""B, G, R in 0…255."""

Points = npt.NDArray[np.float64]
"""(N, 2) float64, x y in metres."""


def shade(colour: Colour, gain: float) -> Colour:
    """The colour made lighter (gain > 1) or darker, kept within 0…255."""
    blue, green, red = (min(255.0, max(0.0, c * gain)) for c in colour)
    return (blue, green, red)


class Sprite:
    """A thing ``height_m`` high seen from above, with its outline; averaged to coarser levels when asked.

    ``bgra`` is (h, w, 4) uint8, premultiplied by alpha, `SPRITE_M_PER_PX` a pixel, centre at the middle, nose to +x.
    """

    def __init__(self, bgra: npt.NDArray[np.uint8], *, height_m: float) -> None:
        self.height_m = height_m
        self._levels: dict[int, tuple[npt.NDArray[np.uint8], float, float]] = {}
        self.bgra = bgra
        self.outline_m = _outline(bgra)

    def level(self, m_per_px: float) -> tuple[npt.NDArray[np.uint8], float, float]:
        """The picture for a camera of that resolution, and its metres per pixel on x and on y.

        Levels lie √2 apart, none coarser than asked for, so that bilinear warping neither blurs nor aliases much.
        """
        step = max(0, int(np.floor(2 * np.log2(max(m_per_px, SPRITE_M_PER_PX) / SPRITE_M_PER_PX))))
        if step not in self._levels:
            high, wide = self.bgra.shape[:2]
            shrink = 2.0 ** (step / 2)
            size = (max(2, round(wide / shrink)), max(2, round(high / shrink)))
            small = cv2.resize(self.bgra, size, interpolation=cv2.INTER_AREA) if step else self.bgra
            scale = (wide * SPRITE_M_PER_PX / size[0], high * SPRITE_M_PER_PX / size[1])
            self._levels[step] = (np.asarray(small, np.uint8), *scale)
        return self._levels[step]


class Canvas:
    """A transparent picture of ``length_m`` by ``width_m`` around the origin, drawn on with smooth edges."""

    def __init__(self, length_m: float, width_m: float) -> None:
        self._half = (length_m / 2 + 0.06, width_m / 2 + 0.06)
        size = (round(2 * self._half[1] / SPRITE_M_PER_PX), round(2 * self._half[0] / SPRITE_M_PER_PX))
        self.bgr = np.zeros((*size, 3), np.uint8)
        self.alpha = np.zeros(size, np.uint8)

    def body(self, points: Sequence[Sequence[float]] | Points, colour: Colour) -> None:
        """Fill a convex polygon that makes the sprite opaque there."""
        fixed = self._fixed(points)
        cv2.fillConvexPoly(self.alpha, fixed, 255, cv2.LINE_AA, _SHIFT)
        cv2.fillPoly(self.bgr, [cv2.convexHull(fixed)], colour, cv2.LINE_8, _SHIFT)
        # The colour reaches past the soft edge of the mask, so that the edge does not turn black.
        cv2.polylines(self.bgr, [fixed], True, colour, 3, cv2.LINE_8, _SHIFT)

    def poly(self, points: Sequence[Sequence[float]] | Points, colour: Colour) -> None:
        cv2.fillPoly(self.bgr, [self._fixed(points)], colour, cv2.LINE_AA, _SHIFT)

    def rect(self, x0: float, y0: float, x1: float, y1: float, *, colour: Colour) -> None:
        self.poly([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour)

    def line(
        self, start: Sequence[float], end: Sequence[float], *, colour: Colour, wide_m: float = 0.04
    ) -> None:
        ends = self._fixed([start, end])
        thick = max(1, round(wide_m / SPRITE_M_PER_PX))
        cv2.line(self.bgr, ends[0].tolist(), ends[1].tolist(), colour, thick, cv2.LINE_AA, _SHIFT)

    def ellipse(
        self, x: float, y: float, *, radii: tuple[float, float], colour: Colour, solid: bool = False
    ) -> None:
        """Fill an upright ellipse; ``solid`` makes the sprite opaque there."""
        turn = np.linspace(0, 2 * np.pi, 25)[:-1]
        points = np.stack([x + radii[0] * np.cos(turn), y + radii[1] * np.sin(turn)], axis=1)
        (self.body if solid else self.poly)(points, colour)

    def speckle(
        self, box: tuple[float, float, float, float], *, rng: np.random.Generator, sigma: float
    ) -> None:
        """Add grain to a rectangle x0 y0 x1 y1: gravel, rust, worn planks."""
        corners = self._fixed([box[:2], box[2:]]) >> _SHIFT
        (left, top), (right, bottom) = np.maximum(corners, 0).tolist()
        patch = self.bgr[top:bottom, left:right]
        coarse = rng.normal(0, sigma, ((bottom - top) // 3 + 1, (right - left) // 3 + 1)).astype(np.float32)
        grain = cv2.resize(coarse, (patch.shape[1], patch.shape[0]), interpolation=cv2.INTER_LINEAR)
        patch[:] = np.clip(patch + grain[..., None], 0, 255).astype(np.uint8)

    def sprite(self, *, height_m: float) -> Sprite:
        """The drawing, with light that falls off towards the edges as on a rounded body."""
        distance = cv2.distanceTransform((self.alpha > 127).astype(np.uint8), cv2.DIST_L2, 3)
        gain = 0.80 + 0.20 * np.minimum(distance * SPRITE_M_PER_PX / 0.16, 1.0)
        share = self.alpha / 255.0
        bgra = np.empty((*self.alpha.shape, 4), np.uint8)
        for channel in range(3):  # plane by plane: numpy is slow along an axis of three
            lit = self.bgr[..., channel] * gain * share + 0.5
            bgra[..., channel] = np.minimum(lit.clip(0, 255).astype(np.uint8), self.alpha)
        bgra[..., 3] = self.alpha
        return Sprite(bgra, height_m=height_m)

    def _fixed(self, points: Sequence[Sequence[float]] | Points) -> npt.NDArray[np.int32]:
        metres = np.asarray(points, np.float64) + self._half
        return np.round((metres / SPRITE_M_PER_PX - 0.5) * (1 << _SHIFT)).astype(np.int32)


def _outline(bgra: npt.NDArray[np.uint8]) -> Points:
    """Convex outline of the opaque part, (`OUTLINE_POINTS`, 2) metres about the centre, by the edges of its pixels.

    They are the extreme points in evenly spread directions, so that the box around the turned outline is tight.
    """
    high, wide = bgra.shape[:2]
    solid = bgra[..., 3] > 127
    rows = np.nonzero(solid.any(1))[0]
    left = solid[rows].argmax(1)
    right = wide - solid[rows, ::-1].argmax(1)
    corners = np.concatenate([np.stack([x, rows + below], 1) for x in (left, right) for below in (0, 1)])
    angles = np.arange(OUTLINE_POINTS) * (2 * np.pi / OUTLINE_POINTS)
    directions = np.stack([np.cos(angles), np.sin(angles)])
    extremes = corners[(corners @ directions).argmax(0)]
    return np.asarray((extremes - np.array([wide / 2, high / 2])) * SPRITE_M_PER_PX, np.float64)
