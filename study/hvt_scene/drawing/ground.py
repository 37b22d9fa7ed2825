"""The ground as one large picture: surfaces with noise of several scales, markings, roofs, trees, their shadows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from hvt_scene.appearance import Appearance, Bgr
from hvt_scene.drawing.foliage import CANOPY_SPAN
from hvt_scene.world.layout import MAIN_HALF_M, PAVEMENT_M, SIDE_HALF_M, WORLD_M, Building, Layout, Rect, Tree

_Rng = np.random.Generator
_SHIFT = 4
_WHITE: Bgr = (214.0, 218.0, 220.0)
_YELLOW: Bgr = (90.0, 190.0, 220.0)


@dataclass(frozen=True, slots=True)
class Ground:
    """The painted ground.

    Attributes:
        bgra: (H, W, 4) uint8, the world from its north-west corner; the fourth channel means nothing.
        m_per_px: its resolution.
        light: (h, w) float32 at ``light_m_per_px``: 1 in the sun, lower in the shade of roofs and trees.
        light_m_per_px: resolution of ``light``.
    """

    bgra: npt.NDArray[np.uint8]
    m_per_px: float
    light: npt.NDArray[np.float32]
    light_m_per_px: float

    def light_at(self, points_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
        """(N,) light at (N, ≥2) places x, y."""
        limit = np.array(self.light.shape[::-1]) - 1
        cells = np.clip((points_m[:, :2] / self.light_m_per_px).astype(np.int64), 0, limit)
        return self.light[cells[:, 1], cells[:, 0]]


def paint_ground(
    layout: Layout,
    appearance: Appearance,
    *,
    rng: _Rng,
    canopies: Sequence[npt.NDArray[np.uint8]],
    m_per_px: float,
) -> Ground:
    """Paint everything that neither moves nor hides anything; all trees are painted, as flat as the grass."""
    painter = _Painter(appearance, rng=rng, m_per_px=m_per_px)
    painter.surface("grass", Rect(0, 0, *WORLD_M))
    for kind, rect in layout.surfaces:
        painter.surface(kind, rect)
    for x0, y0, x1, y1 in layout.lines:
        painter.stroke((x0, y0), (x1, y1), wide_m=0.12, colour=_WHITE)
    _paint_roads(painter, layout)
    painter.shadows(layout)
    for building in layout.buildings:
        _paint_roof(painter, building, rng)
    for tree in layout.trees:
        painter.canopy(tree, canopies[tree.variant])
    return painter.finish()


class _Painter:
    """The picture under work, addressed in metres."""

    def __init__(self, appearance: Appearance, *, rng: _Rng, m_per_px: float) -> None:
        self._appearance, self._m_per_px = appearance, m_per_px
        high, wide = (round(metres / m_per_px) for metres in (WORLD_M[1], WORLD_M[0]))
        self.bgr = np.zeros((high, wide, 3), np.uint8)
        self._shade = np.zeros((high, wide), np.uint8)
        # Each of these pictures of the world takes 43 MB: never more than three at once.
        self._fine = rng.standard_normal((high, wide), np.float32)
        fine, middle, coarse, broad = (
            _noise(rng, (high, wide), cell_px=cell_m / m_per_px) for cell_m in (0.16, 0.9, 5, 19)
        )
        self._fine *= np.float32(0.6)
        self._fine += _enlarged(fine, (high, wide), gain=0.8)
        self._coarse = _enlarged(coarse, (high, wide), gain=0.7)
        self._coarse += _enlarged(broad, (high, wide), gain=0.7)
        self._middle = _enlarged(middle, (high, wide), gain=1.0)

    def surface(self, kind: str, rect: Rect) -> None:
        appearance = self._appearance
        materials: dict[
            str, tuple[Bgr, float, float, float]
        ] = {  # colour, strength of fine, middle, coarse noise
            "grass": (appearance.grass_bgr, 0.11, 0.07, 0.10),
            "island": (_gain(appearance.grass_bgr, 0.92), 0.13, 0.10, 0.05),
            "soil": (appearance.soil_bgr, 0.08, 0.07, 0.09),
            "lot": (_gain(appearance.asphalt_bgr, 1.06), 0.05, 0.025, 0.06),
            "road": (_gain(appearance.asphalt_bgr, 0.9), 0.05, 0.02, 0.04),
            "concrete": (_gain(appearance.paving_bgr, 0.94), 0.035, 0.025, 0.06),
            "paving": (appearance.paving_bgr, 0.04, 0.02, 0.05),
            "gravelpath": (_mix(appearance.soil_bgr, appearance.paving_bgr), 0.09, 0.04, 0.04),
            "court": ((118.0, 96.0, 62.0), 0.03, 0.015, 0.02),
            "gravel": ((138.0, 142.0, 144.0), 0.12, 0.03, 0.04),
            "metal": ((176.0, 172.0, 164.0), 0.02, 0.015, 0.04),
            "solar": ((122.0, 124.0, 126.0), 0.08, 0.02, 0.04),
            "tiles": ((70.0, 86.0, 150.0), 0.07, 0.05, 0.04),
        }
        colour, fine, middle, coarse = materials[kind]
        gain = self._appearance.texture_gain
        natural = kind in {"grass", "island"}  # dry patches lean towards the soil
        for region in _strips(*self._slice(rect)):
            fine_noise, middle_noise, coarse_noise = (
                one[region] for one in (self._fine, self._middle, self._coarse)
            )
            noise = (fine * fine_noise + middle * middle_noise + coarse * coarse_noise) * gain + 1
            if natural:
                dry = np.clip(0.20 + 0.22 * coarse_noise + 0.1 * middle_noise, 0, 0.75)
                fresh = 1 - dry
            for channel in range(3):  # plane by plane: numpy is slow along an axis of three
                tint, soil = np.float32(colour[channel]), np.float32(appearance.soil_bgr[channel])
                plane = (tint * fresh + soil * dry) * noise if natural else tint * noise
                self.bgr[region][..., channel] = np.clip(plane, 0, 255, out=plane)
        if kind in {"lot", "court"}:
            self.frame(rect, wide_m=0.25, colour=_gain(appearance.paving_bgr, 0.98))
        if kind == "court":
            _paint_court(self, rect)
        if kind in {"paving", "concrete"}:
            self._slabs(rect, step_m=1.5 if kind == "paving" else 5.0)

    def _slabs(self, rect: Rect, *, step_m: float) -> None:
        colour = _gain(self._appearance.paving_bgr, 0.84)
        for x in np.arange(rect.x0 + step_m, rect.x1, step_m):
            self.stroke((x, rect.y0), (x, rect.y1), wide_m=0.05, colour=colour)
        for y in np.arange(rect.y0 + step_m, rect.y1, step_m):
            self.stroke((rect.x0, y), (rect.x1, y), wide_m=0.05, colour=colour)

    def frame(self, rect: Rect, *, wide_m: float, colour: Bgr) -> None:
        for start, end in zip(rect.corners, rect.corners[1:] + rect.corners[:1], strict=True):
            self.stroke(start, end, wide_m=wide_m, colour=colour)

    def stroke(self, start: Sequence[float], end: Sequence[float], *, wide_m: float, colour: Bgr) -> None:
        half = wide_m / 2
        x0, x1 = min(start[0], end[0]) - half, max(start[0], end[0]) + half
        y0, y1 = min(start[1], end[1]) - half, max(start[1], end[1]) + half
        self.block(Rect(x0, y0, x1, y1), colour=colour)

    def block(self, rect: Rect, *, colour: Bgr) -> None:
        self.poly(rect.corners, colour=colour)

    def poly(self, points: Sequence[Sequence[float]], *, colour: Bgr) -> None:
        cv2.fillPoly(self.bgr, [self._fixed(points)], colour, cv2.LINE_AA, _SHIFT)

    def disc(self, x: float, y: float, *, radius: float, colour: Bgr) -> None:
        centre = self._fixed([(x, y)])[0]
        cv2.circle(
            self.bgr, centre.tolist(), round(radius / self._m_per_px * 16), colour, -1, cv2.LINE_AA, _SHIFT
        )

    def shadows(self, layout: Layout) -> None:
        """Darken the shade of buildings and trees."""
        dx, dy = self._appearance.shadow_vector
        for building in layout.buildings:
            foot = np.array(building.rect.corners)
            roof = foot + np.array([dx, dy]) * building.height_m
            hull = cv2.convexHull(self._fixed(np.concatenate([foot, roof])))
            cv2.fillConvexPoly(self._shade, hull, 255, cv2.LINE_AA, _SHIFT)
        for tree in layout.trees:
            reach = 1.1 * tree.r
            centre = self._fixed([(tree.x + dx * reach, tree.y + dy * reach)])[0]
            radius = round(0.92 * tree.r / self._m_per_px * 16)
            cv2.circle(self._shade, centre.tolist(), radius, 225, -1, cv2.LINE_AA, _SHIFT)
        self._shade = np.asarray(cv2.blur(self._shade, (5, 5)), np.uint8)
        where = np.flatnonzero(self._shade)
        dark = 1 - self._appearance.shadow_strength * (self._shade.ravel()[where].astype(np.float32) / 255)
        pixels = self.bgr.reshape(-1, 3)
        # Skylight is blue, so a shadow keeps a little more of it.
        for channel, share in enumerate((1.10, 1.03, 1.0)):
            pixels[where, channel] = pixels[where, channel] * np.minimum(
                dark * np.where(dark < 1, share, 1), 1
            )

    def canopy(self, tree: Tree, picture: npt.NDArray[np.uint8]) -> None:
        side = max(3, round(CANOPY_SPAN * tree.r / self._m_per_px))
        small = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
        left, top = (round(at / self._m_per_px - side / 2) for at in (tree.x, tree.y))
        region = (slice(max(top, 0), max(top + side, 0)), slice(max(left, 0), max(left + side, 0)))
        ground = self.bgr[region]
        inside = small[max(-top, 0) :, max(-left, 0) :][: ground.shape[0], : ground.shape[1]]
        ground[:] = (ground * (1 - inside[..., 3:] / 255.0) + inside[..., :3]).astype(np.uint8)

    def finish(self) -> Ground:
        if self._appearance.exposure != 1.0:
            self.bgr[:] = cv2.convertScaleAbs(self.bgr, alpha=self._appearance.exposure)
        step = 0.5
        size = (round(WORLD_M[0] / step), round(WORLD_M[1] / step))
        shade = cv2.resize(self._shade, size, interpolation=cv2.INTER_AREA)
        light = (1 - self._appearance.shadow_strength * shade / 255.0).astype(np.float32)
        del self._fine, self._middle, self._coarse
        bgra = np.asarray(cv2.cvtColor(self.bgr, cv2.COLOR_BGR2BGRA), np.uint8)
        return Ground(bgra, self._m_per_px, light, step)

    def _slice(self, rect: Rect) -> tuple[slice, slice]:
        x0, y0, x1, y1 = (max(0, round(v / self._m_per_px)) for v in (rect.x0, rect.y0, rect.x1, rect.y1))
        return (slice(y0, y1), slice(x0, x1))

    def _fixed(self, points: Sequence[Sequence[float]] | npt.NDArray[np.float64]) -> npt.NDArray[np.int32]:
        return np.round((np.asarray(points, np.float64) / self._m_per_px - 0.5) * (1 << _SHIFT)).astype(
            np.int32
        )


def _paint_roads(painter: _Painter, layout: Layout) -> None:
    wide, deep = WORLD_M
    y, x = layout.main_y, layout.side_x
    main, side = MAIN_HALF_M, SIDE_HALF_M
    painter.surface("paving", Rect(0, y - main - PAVEMENT_M, wide, y + main + PAVEMENT_M))
    painter.surface("paving", Rect(x - side - PAVEMENT_M, 0, x + side + PAVEMENT_M, deep))
    for rect in (Rect(0, y - main, wide, y + main), Rect(x - side, 0, x + side, deep)):
        painter.frame(rect, wide_m=0.36, colour=(184.0, 188.0, 190.0))  # kerb
    painter.surface("road", Rect(0, y - main, wide, y + main))
    painter.surface("road", Rect(x - side, 0, x + side, deep))
    clear = side + PAVEMENT_M + 1.2
    for x0, x1 in ((0.0, x - clear), (x + clear, wide)):
        for offset in (-0.14, 0.14):
            painter.stroke((x0, y + offset), (x1, y + offset), wide_m=0.13, colour=_YELLOW)
        for offset in (-3.55, 3.55):
            for dash in np.arange(x0, x1 - 3, 7.5):
                painter.stroke((dash, y + offset), (dash + 3, y + offset), wide_m=0.13, colour=_WHITE)
        for offset in (-main + 0.35, main - 0.35):
            painter.stroke((x0, y + offset), (x1, y + offset), wide_m=0.12, colour=_WHITE)
    clear = main + PAVEMENT_M + 1.2
    for y0, y1 in ((0.0, y - clear), (y + clear, deep)):
        for dash in np.arange(y0, y1 - 2, 5.0):
            painter.stroke((x, dash), (x, dash + 2), wide_m=0.13, colour=_WHITE)
    _paint_crossing(painter, layout)


def _paint_crossing(painter: _Painter, layout: Layout) -> None:
    """Stop lines and zebra crossings on all four arms."""
    y, x = layout.main_y, layout.side_x
    for side in (-1, 1):
        stop = x + side * (SIDE_HALF_M + PAVEMENT_M + 1.0)
        painter.stroke((stop, y), (stop, y - side * (MAIN_HALF_M - 0.4)), wide_m=0.45, colour=_WHITE)
        stop = y + side * (MAIN_HALF_M + PAVEMENT_M + 1.0)
        painter.stroke((x, stop), (x + side * (SIDE_HALF_M - 0.4), stop), wide_m=0.45, colour=_WHITE)
        for bar in np.arange(-MAIN_HALF_M + 0.5, MAIN_HALF_M, 1.0):
            across = x + side * (SIDE_HALF_M + 1.7)
            painter.stroke((across - 1.3, y + bar), (across + 1.3, y + bar), wide_m=0.48, colour=_WHITE)
        for bar in np.arange(-SIDE_HALF_M + 0.5, SIDE_HALF_M, 1.0):
            across = y + side * (MAIN_HALF_M + 1.7)
            painter.stroke((x + bar, across - 1.3), (x + bar, across + 1.3), wide_m=0.48, colour=_WHITE)


def _paint_court(painter: _Painter, rect: Rect) -> None:
    middle = (rect.x0 + rect.x1) / 2
    for x0, x1 in ((rect.x0 + 2, middle - 1), (middle + 1, rect.x1 - 2)):
        field = Rect(x0, rect.y0 + 2, x1, rect.y1 - 2)
        painter.block(field, colour=(72.0, 104.0, 58.0))
        painter.frame(field, wide_m=0.12, colour=_WHITE)
        high = (field.y0 + field.y1) / 2
        painter.stroke((field.x0, high), (field.x1, high), wide_m=0.16, colour=(60.0, 60.0, 60.0))
        for share in (0.25, 0.75):
            y = field.y0 + share * field.size[1]
            painter.stroke((field.x0, y), (field.x1, y), wide_m=0.1, colour=_WHITE)


def _paint_roof(painter: _Painter, building: Building, rng: _Rng) -> None:
    rect = building.rect
    painter.surface(building.roof, rect)
    if building.roof == "tiles":
        _paint_ridge(painter, rect)
        return
    painter.frame(rect.inset(0.2), wide_m=0.5, colour=(190.0, 194.0, 196.0))
    painter.frame(rect.inset(0.5), wide_m=0.12, colour=(96.0, 98.0, 100.0))
    if building.roof == "metal":
        for x in np.arange(rect.x0 + 1.2, rect.x1 - 0.8, 0.6):
            painter.stroke((x, rect.y0 + 0.7), (x, rect.y1 - 0.7), wide_m=0.07, colour=(146.0, 142.0, 136.0))
        for y in np.arange(rect.y0 + 4, rect.y1 - 4, 6.5):
            painter.stroke((rect.x0 + 4, y), (rect.x1 - 4, y), wide_m=1.1, colour=(206.0, 206.0, 200.0))
    if building.roof == "solar":
        _paint_panels(painter, rect.inset(2.0))
    else:
        _paint_units(painter, rect.inset(2.5), rng)


def _paint_panels(painter: _Painter, area: Rect) -> None:
    for y in np.arange(area.y0, area.y1 - 1.8, 2.9):
        painter.stroke((area.x0 + 1, y + 0.9), (area.x1 - 1, y + 0.9), wide_m=1.8, colour=(92.0, 62.0, 44.0))
        for x in np.arange(area.x0, area.x1, 1.05):
            painter.stroke((x, y + 0.1), (x, y + 1.7), wide_m=0.06, colour=(168.0, 160.0, 150.0))
        painter.stroke((area.x0, y + 0.9), (area.x1, y + 0.9), wide_m=0.06, colour=(168.0, 160.0, 150.0))


def _paint_units(painter: _Painter, area: Rect, rng: _Rng) -> None:
    for _ in range(int(area.size[0] * area.size[1] / 70) + 1):
        x, y = float(rng.uniform(area.x0, area.x1)), float(rng.uniform(area.y0, area.y1))
        wide, deep = float(rng.uniform(0.6, 1.6)), float(rng.uniform(0.5, 1.2))
        for shift, tone in ((0.45, 84.0), (0.0, 196.0)):
            box = Rect(x - wide + shift, y - deep + shift, x + wide + shift, y + deep + shift)
            painter.block(box, colour=(tone, tone, tone))
        painter.disc(x, y, radius=0.7 * deep, colour=(70.0, 70.0, 70.0))
        painter.disc(x, y, radius=0.2 * deep, colour=(150.0, 150.0, 150.0))


def _paint_ridge(painter: _Painter, rect: Rect) -> None:
    """A hipped roof: four sides with courses of tiles, each catching the light differently."""
    middle = (rect.x0 + rect.x1) / 2
    hip = rect.size[0] / 2
    ends = ((middle, rect.y0 + hip * 0.8), (middle, rect.y1 - hip * 0.8))
    corners = rect.corners
    sides = (
        ([corners[0], corners[1], ends[0]], 1.12),
        ([corners[1], corners[2], ends[1], ends[0]], 0.84),
        ([corners[2], corners[3], ends[1]], 0.76),
        ([corners[3], corners[0], ends[0], ends[1]], 1.0),
    )
    for points, gain in sides:
        painter.poly(points, colour=_gain((70.0, 84.0, 146.0), gain))
    for y in np.arange(rect.y0 + 0.4, rect.y1, 0.42):
        for x0, x1, gain in ((rect.x0 + 0.1, middle, 0.9), (middle, rect.x1 - 0.1, 0.74)):
            reach = min(1.0, min(y - rect.y0, rect.y1 - y) / (hip * 0.8)) * hip
            near, far = (x0, x0 + reach) if x0 < middle else (x1 - reach, x1)
            painter.stroke((near, y), (far, y), wide_m=0.06, colour=_gain((70.0, 84.0, 146.0), gain))
    painter.stroke(ends[0], ends[1], wide_m=0.3, colour=(120.0, 130.0, 180.0))
    painter.disc(middle - 1.2, ends[0][1] + 1, radius=0.35, colour=(90.0, 100.0, 110.0))


def _gain(colour: Bgr, gain: float) -> Bgr:
    return (colour[0] * gain, colour[1] * gain, colour[2] * gain)


def _mix(first: Bgr, second: Bgr) -> Bgr:
    return ((first[0] + second[0]) / 2, (first[1] + second[1]) / 2, (first[2] + second[2]) / 2)


def _strips(rows: slice, columns: slice, *, height: int = 32) -> Iterator[tuple[slice, slice]]:
    """The region in strips, for steps with many numbers a pixel."""
    for top in range(rows.start, rows.stop, height):
        yield slice(top, min(top + height, rows.stop)), columns


def _noise(rng: _Rng, shape: tuple[int, int], *, cell_px: float) -> npt.NDArray[np.float32]:
    """Noise of unit strength, one number for each ``cell_px``."""
    return rng.standard_normal((int(shape[0] / cell_px) + 3, int(shape[1] / cell_px) + 3), np.float32)


def _enlarged(
    noise: npt.NDArray[np.float32], shape: tuple[int, int], *, gain: float
) -> npt.NDArray[np.float32]:
    large = np.asarray(cv2.resize(noise, shape[::-1], interpolation=cv2.INTER_CUBIC), np.float32)
    large *= np.float32(gain)
    return large
