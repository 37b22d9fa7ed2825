"""The ground of a place: materials, noise of several scales, markings, cracks, stains, and text laid over it."""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Image

_Rng = np.random.Generator
_Floats = npt.NDArray[np.float64]
_SHIFT = 4
_MATERIALS: dict[str, tuple[float, float, float]] = {
    "asphalt": (96.0, 96.0, 96.0),
    "concrete": (160.0, 166.0, 170.0),
    "soil": (104.0, 133.0, 160.0),
    "grass": (62.0, 110.0, 96.0),
    "snow": (225.0, 222.0, 218.0),
    "brick": (90.0, 105.0, 150.0),
}


class Surface:
    """The surfaces of a square picture of ``size`` pixels, in world metres, to be painted later."""

    def __init__(
        self, to_px: Callable[[_Floats], _Floats], *, size: int, px_per_m: float, half_m: float
    ) -> None:
        self.to_px, self.size, self.px_per_m, self.half_m = to_px, size, px_per_m, half_m
        self.areas: list[tuple[str, _Floats]] = []
        self.lines: list[tuple[_Floats, float, str]] = []

    def rect(self, x0: float, y0: float, x1: float, y1: float, *, kind: str) -> None:
        """Cover a rectangle with a material; ``island`` is whatever islands are made of here."""
        self.areas.append((kind, np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])))

    def line(
        self, start: tuple[float, float], end: tuple[float, float], *, wide_m: float, paint: str
    ) -> None:
        self.lines.append((np.array([start, end]), wide_m, paint))

    def road(self, middle: float, half_width: float, *, along_x: bool, lanes: int) -> None:
        """Draw a road with dashed lanes across the whole world."""
        reach = self.half_m

        def at(along: float, across: float) -> tuple[float, float]:
            return (along, across) if along_x else (across, along)

        (x0, y0), (x1, y1) = at(-reach, middle - half_width), at(reach, middle + half_width)
        self.rect(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1), kind="asphalt")
        for lane in range(lanes + 1):
            across = middle - half_width + lane * 2 * half_width / lanes
            if lane in (0, lanes, lanes // 2):
                self.line(at(-reach, across), at(reach, across), wide_m=0.14, paint="marking")
                continue
            for dash in np.arange(-reach, reach, 8.0):
                self.line(at(dash, across), at(dash + 3.2, across), wide_m=0.13, paint="marking")


def paint_surface(surface: Surface, rng: _Rng) -> Image:
    """Paint the ground, (size, size, 3) uint8."""
    size = surface.size
    base = _tint(rng, str(rng.choice(list(_MATERIALS))))
    image = np.full((size, size, 3), base, np.uint8)
    _patches(image, surface, rng, count=int(rng.integers(0, 10)))
    island = _tint(rng, str(rng.choice(["grass", "soil", "concrete"])))
    asphalt = _tint(rng, "asphalt")
    for kind, corners in surface.areas:
        colour = {"island": island, "asphalt": asphalt}.get(kind) or _tint(rng, kind)
        cv2.fillPoly(image, [_fixed(surface.to_px(corners))], colour, cv2.LINE_AA, _SHIFT)
    _patches(image, surface, rng, count=int(rng.integers(0, 8)), like=asphalt)
    for _ in range(int(rng.integers(0, 10))):
        _crack(image, rng, px_per_m=surface.px_per_m)
    textured = _textured(image, rng, px_per_m=surface.px_per_m)
    _markings(textured, surface, rng)
    return textured


def _tint(rng: _Rng, material: str) -> tuple[float, float, float]:
    gain, spread = rng.uniform(0.45, 1.5), rng.normal(0, 8, 3)
    blue, green, red = np.clip(np.array(_MATERIALS[material]) * gain + spread, 6, 246)
    return (float(blue), float(green), float(red))


def _patches(
    image: Image, surface: Surface, rng: _Rng, *, count: int, like: tuple[float, float, float] | None = None
) -> None:
    """Rectangles and blots of other materials, or of nearly the same one (repairs)."""
    half = surface.half_m
    for _ in range(count):
        x, y = rng.uniform(-half, half, 2)
        w, d = np.exp(rng.uniform(np.log(1.0), np.log(half), 2))
        angle = rng.choice([0.0, 0.0, rng.uniform(0, 3.1)])
        if rng.random() < 0.6:
            shape = np.array([(-w, -d), (w, -d), (w, d), (-w, d)]) / 2
        else:
            turn = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(5, 14))))
            shape = np.stack([w * np.cos(turn), d * np.sin(turn)], 1) / 2
        spin = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        colour = _tint(rng, str(rng.choice(list(_MATERIALS))))
        if like is not None:
            blue, green, red = np.clip(np.array(like) * rng.uniform(0.8, 1.2), 5, 250)
            colour = (float(blue), float(green), float(red))
        cv2.fillPoly(
            image, [_fixed(surface.to_px(shape @ spin + np.array([x, y])))], colour, cv2.LINE_AA, _SHIFT
        )


def _crack(image: Image, rng: _Rng, *, px_per_m: float) -> None:
    steps = int(rng.integers(8, 60))
    heading = rng.uniform(0, 6.28) + np.cumsum(rng.normal(0, 0.35, steps))
    stride = px_per_m * rng.uniform(0.2, 0.6)
    path = (
        rng.uniform(0, len(image), 2) + np.cumsum(np.stack([np.cos(heading), np.sin(heading)], 1), 0) * stride
    )
    tone = float(rng.uniform(15, 75))
    cv2.polylines(
        image, [_fixed(path)], False, (tone, tone, tone), max(1, round(px_per_m * 0.05)), cv2.LINE_AA, _SHIFT
    )


def _textured(image: Image, rng: _Rng, *, px_per_m: float) -> Image:
    """Multiply by noise whose grain runs from a pixel to a third of the picture, and add stains."""
    size = len(image)
    noise = np.zeros((size, size), np.float32)
    strength = rng.uniform(0.3, 1.6)
    for cell, share in (
        (1.0, 0.035),
        (3.0, 0.03),
        (px_per_m * 0.5, 0.03),
        (px_per_m * 3, 0.05),
        (size / 3, 0.08),
    ):
        side = max(2, int(size / max(cell, 1.0))) + 2
        small = rng.standard_normal((side, side), np.float32)
        grain = (
            cv2.resize(small, (size, size), interpolation=cv2.INTER_LINEAR)
            if side < size
            else small[:size, :size]
        )
        noise += grain * float(share * strength * rng.uniform(0.2, 1.6))
    stains = np.zeros((size // 4, size // 4), np.float32)
    for _ in range(int(rng.integers(0, 25))):
        centre = tuple(int(v) for v in rng.integers(0, size // 4, 2))
        axes = tuple(max(1, int(v)) for v in rng.uniform(0.1, 2.0, 2) * px_per_m / 4)
        cv2.ellipse(
            stains, centre, axes, float(rng.uniform(0, 180)), 0, 360, float(rng.uniform(-0.3, 0.2)), -1
        )
    noise += cv2.resize(cv2.GaussianBlur(stains, (0, 0), 2), (size, size))
    return np.asarray((image * (1 + noise)[..., None]).clip(0, 255), np.uint8)


def _markings(image: Image, surface: Surface, rng: _Rng) -> None:
    """Lines of stalls and lanes, zebra bars, hatches, arrows, letters."""
    paints = [(225.0, 228.0, 230.0), (225.0, 228.0, 230.0), (70.0, 190.0, 225.0), (200.0, 140.0, 80.0)]
    wear = float(rng.uniform(0.5, 1.05))
    blue, green, red = (c * wear for c in paints[int(rng.integers(len(paints)))])
    for ends, wide_m, _ in surface.lines:
        thick = max(1, round(wide_m * surface.px_per_m))
        a, b = _fixed(surface.to_px(ends)).tolist()
        cv2.line(image, a, b, (blue, green, red), thick, cv2.LINE_AA, _SHIFT)
    half = surface.half_m
    for _ in range(int(rng.integers(0, 6))):  # zebra crossings, hatched areas
        x, y = rng.uniform(-half, half, 2)
        bars, step, long = int(rng.integers(3, 14)), rng.uniform(0.5, 1.2), rng.uniform(1.2, 4.5)
        slant = float(rng.choice([0.0, rng.uniform(-1, 1)]))
        for bar in range(bars):
            shape = np.array([(0, 0), (step * 0.5, 0), (step * 0.5 + slant, long), (slant, long)])
            corners = surface.to_px(shape + np.array([x + bar * step, y]))
            cv2.fillPoly(image, [_fixed(corners)], (blue, green, red), cv2.LINE_AA, _SHIFT)
    for _ in range(int(rng.integers(0, 5))):
        place = tuple(int(v) for v in rng.integers(0, len(image), 2))
        word = "".join(rng.choice(list("ABCEFHKLMNPRSTXYZ0123456789"), int(rng.integers(1, 7))))
        scale, thick = float(rng.uniform(0.5, 3.5)), int(rng.integers(1, 6))
        cv2.putText(
            image, word, place, int(rng.integers(0, 5)), scale, (blue, green, red), thick, cv2.LINE_AA
        )


def _fixed(points_px: _Floats) -> npt.NDArray[np.int32]:
    return np.round((points_px - 0.5) * (1 << _SHIFT)).clip(-(1 << 24), 1 << 24).astype(np.int32)
