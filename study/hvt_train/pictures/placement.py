"""Who stands where in a place: car parks, roads, yards, buildings, clutter; nothing overlaps."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from hvt_train.pictures.fleet import make_solid
from hvt_train.pictures.solids import Part, Solid
from hvt_train.pictures.surfaces import Surface

_Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Thing:
    """A solid on the ground: where its origin stands in world metres, and its heading in radians."""

    solid: Solid
    x: float
    y: float
    heading: float


class _Occupancy:
    """Which ground is taken, as a raster of 0.2 m."""

    def __init__(self, half_m: float) -> None:
        self._half = half_m
        side = max(8, int(2 * half_m / 0.2))
        self._taken = np.zeros((side, side), np.uint8)

    def take(self, thing: Thing, *, margin: float = 0.0) -> bool:
        """Take the thing's foot, unless some of it is taken already."""
        cosine, sine = math.cos(thing.heading), math.sin(thing.heading)
        foot = thing.solid.foot_m * (1 + margin) @ np.array([[cosine, sine], [-sine, cosine]])
        cells = ((foot + np.array([thing.x, thing.y]) + self._half) / 0.2).astype(np.int32)
        low, high = np.maximum(cells.min(0), 0), np.minimum(cells.max(0) + 1, len(self._taken))
        if (low >= high).any():
            return False
        mask = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
        cv2.fillConvexPoly(mask, cells - low, 1)
        region = self._taken[low[1] : high[1], low[0] : high[0]]
        if (region & mask).any():
            return False
        region |= mask
        return True


def settle(rng: _Rng, surface: Surface) -> list[Thing]:
    """Decide the place of each object, and tell the ground which surface belongs under it."""
    taken = _Occupancy(surface.half_m)
    things: list[Thing] = []

    def put(solid: Solid, x: float, y: float, heading: float, *, margin: float = 0.0) -> None:
        thing = Thing(solid, x, y, heading)
        if len(things) < 400 and taken.take(thing, margin=margin):
            things.append(thing)

    kind = rng.choice(["lot", "lot", "road", "yard", "mixed"])
    half = surface.half_m
    if kind in ("lot", "mixed"):
        _lot(rng, surface, put, half if kind == "lot" else half * 0.5)
    if kind in ("road", "mixed"):
        _road(rng, surface, put, half)
    if kind == "yard":
        _yard(rng, surface, put, half)
    area = (2 * half) ** 2
    for _ in range(int(rng.integers(0, 1 + min(12, int(area / 400))))):
        put(_building(rng), *_spot(rng, half), float(rng.choice([0, math.pi / 2])), margin=0.1)
    for name, most, density in (
        ("car", 25, 250), ("van", 6, 900), ("truck", 6, 1200), ("bus", 3, 3000),
        ("motor", 20, 250), ("pedestrian", 45, 90), ("other", 6, 1200),
    ):  # fmt: skip
        for _ in range(int(rng.integers(0, 1 + min(most, int(area / density))))):
            put(make_solid(name, rng), *_spot(rng, half), float(rng.uniform(0, 2 * math.pi)), margin=0.05)
    for _ in range(int(rng.integers(0, 1 + min(40, int(area / 60))))):
        put(_clutter(rng), *_spot(rng, half), float(rng.uniform(0, 2 * math.pi)))
    return things


def _spot(rng: _Rng, half: float) -> tuple[float, float]:
    return float(rng.uniform(-half, half)), float(rng.uniform(-half, half))


def _stall_solid(rng: _Rng) -> Solid:
    name = str(rng.choice(["car", "van", "truck", "motor", "other"], p=[0.63, 0.15, 0.16, 0.04, 0.02]))
    for _ in range(6):
        solid = make_solid(name, rng)
        if np.ptp(solid.foot_m[:, 0]) < 6.3:
            return solid
    return make_solid("car", rng)


def _lot(rng: _Rng, surface: Surface, put: object, half: float) -> None:
    """Rows of stalls, back to back or single, between aisles."""
    assert callable(put)
    wide, deep, aisle = rng.uniform(2.3, 3.1), rng.uniform(4.7, 6.0), rng.uniform(5.0, 8.5)
    share, jitter = rng.uniform(0.3, 1.0), rng.uniform(0.03, 0.3)
    slant = float(rng.choice([0.0, 0.0, 0.0, rng.uniform(-0.7, 0.7)]))
    surface.rect(-half, -half, half, half, kind="asphalt")
    y, paired = -half + rng.uniform(0, 4), False
    lines = rng.random() < 0.8
    while y + deep < half:
        x = -half + rng.uniform(0, 3)
        while x < half:
            if lines:
                lean = math.tan(slant) * deep / 2
                surface.line((x - lean, y), (x + lean, y + deep), wide_m=0.11, paint="marking")
            if rng.random() < share:
                turn = (
                    math.pi / 2 + slant * 1.0 + (math.pi if rng.random() < 0.5 else 0) + rng.normal(0, 0.03)
                )
                sx = x + wide / math.cos(slant) / 2 + rng.normal(0, jitter * 0.6)
                put(_stall_solid(rng), float(sx), float(y + deep / 2 + rng.normal(0, jitter)), float(turn))
            elif rng.random() < 0.05:
                surface.rect(x, y, x + wide, y + deep, kind="island")
            x += wide / math.cos(slant)
        paired = not paired and rng.random() < 0.75
        if paired and lines and rng.random() < 0.6:
            surface.line((-half, y + deep), (half, y + deep), wide_m=0.11, paint="marking")
        y += deep + (0.0 if paired else aisle)
        if not paired and rng.random() < 0.25:
            surface.rect(-half, y, half, y + 2.5, kind="island")
            y += 2.6


def _road(rng: _Rng, surface: Surface, put: object, half: float) -> None:
    """One or two straight roads with columns of traffic."""
    assert callable(put)
    for turn in (0.0, math.pi / 2)[: int(rng.integers(1, 3))]:
        lanes, wide = int(rng.integers(2, 7)), rng.uniform(2.9, 3.7)
        middle, gap = rng.uniform(-half / 2, half / 2), rng.uniform(2, 25)
        surface.road(middle, lanes * wide / 2, along_x=turn == 0.0, lanes=lanes)
        for lane in range(lanes):
            across = middle + (lane - (lanes - 1) / 2) * wide
            s = -half + rng.exponential(gap)
            while s < half:
                name = str(
                    rng.choice(["car", "van", "truck", "bus", "motor"], p=[0.58, 0.14, 0.15, 0.06, 0.07])
                )
                solid = make_solid(name, rng)
                length = float(np.ptp(solid.foot_m[:, 0]))
                aside = across + rng.normal(0, 0.15)
                x, y = (s + length / 2, aside) if turn == 0.0 else (aside, s + length / 2)
                put(
                    solid,
                    float(x),
                    float(y),
                    turn + (math.pi if lane < lanes / 2 else 0) + rng.normal(0, 0.02),
                )
                s += length + 1.0 + rng.exponential(gap)


def _yard(rng: _Rng, surface: Surface, put: object, half: float) -> None:
    """Trucks, buses, containers and trailers side by side."""
    assert callable(put)
    surface.rect(-half, -half, half, half, kind=str(rng.choice(["soil", "concrete", "asphalt"])))
    step, deep = rng.uniform(2.9, 4.2), rng.uniform(9, 15)
    for y in np.arange(-half, half, deep):
        for x in np.arange(-half, half, step):
            if rng.random() < 0.55:
                name = str(
                    rng.choice(["truck", "bus", "other", "van", "car"], p=[0.34, 0.18, 0.3, 0.1, 0.08])
                )
                put(
                    make_solid(name, rng),
                    float(x),
                    float(y + rng.normal(0, 0.6)),
                    math.pi / 2 + (math.pi if rng.random() < 0.5 else 0) + float(rng.normal(0, 0.03)),
                )


def _building(rng: _Rng) -> Solid:
    """A block with a flat roof and boxes on it: everything on it is background."""
    wide, deep, high = rng.uniform(6, 30), rng.uniform(6, 20), float(rng.uniform(2.5, 9))
    outline = np.array([(-wide, -deep), (wide, -deep), (wide, deep), (-wide, deep)]) / 2
    tone = tuple(float(c) for c in np.clip(rng.uniform(50, 220) + rng.normal(0, 18, 3), 10, 245))
    part = Part(0.0)
    part.prism(outline, outline, (0, high), side=tone, top=tone)  # type: ignore[arg-type]
    for _ in range(int(rng.integers(0, 14))):
        x, y = rng.uniform(-wide / 2, wide / 2 - 1), rng.uniform(-deep / 2, deep / 2 - 1)
        w, d = rng.uniform(0.4, 3.5), rng.uniform(0.4, 2.0)
        shift, level = rng.uniform(0.1, 0.5), float(rng.uniform(20, 245))
        part.decal((x + shift, x + w + shift), (y + shift, y + d + shift), high, (level * 0.4,) * 3)
        part.decal((x, x + w), (y, y + d), high + 0.02, (level, level, level * float(rng.uniform(0.8, 1.1))))
    if rng.random() < 0.4:
        for x in np.arange(-wide / 2 + 0.5, wide / 2 - 0.5, rng.uniform(0.6, 2.0)):
            part.decal((x, x + 0.1), (-deep / 2 + 0.3, deep / 2 - 0.3), high, tuple(c * 0.8 for c in tone))  # type: ignore[arg-type]
    return Solid("building", [part], outline, high)


def _clutter(rng: _Rng) -> Solid:
    """Posts, bins, benches, boxes, bushes, parasols: plain, so that a vehicle's inner pattern decides."""
    high = float(rng.uniform(0.1, 3.0))
    level = rng.uniform(20, 245)
    tone = tuple(float(c) for c in np.clip(level + rng.normal(0, 30, 3), 5, 250))
    part = Part(0.0)
    kind = int(rng.integers(4))
    if kind == 0:  # thin
        outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 0.08
        high *= 2.5
    elif kind == 1:  # long or square box, plain
        outline = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (
            rng.uniform(0.3, 2.6),
            rng.uniform(0.2, 1.1),
        )
    else:  # round
        turn = np.linspace(0, 2 * np.pi, 13)[:-1]
        outline = (
            np.stack([np.cos(turn), np.sin(turn)], 1) * rng.uniform(0.2, 1.8) * rng.uniform(0.8, 1.2, (12, 1))
        )
        outline = cv2.convexHull(outline.astype(np.float32))[::-1, 0].astype(np.float64)
        x, y = outline[:, 0], outline[:, 1]
        if (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() < 0:
            outline = outline[::-1]
        if rng.random() < 0.6:
            tone = (float(rng.uniform(20, 80)), float(rng.uniform(50, 140)), float(rng.uniform(30, 110)))
    part.prism(outline, outline * float(rng.uniform(0.6, 1.0)), (0, high), side=tone, top=tone)  # type: ignore[arg-type]
    if kind >= 2:
        for scale in (0.7, 0.4):
            ring = outline * scale + rng.normal(0, 0.1, 2)
            face = np.concatenate([ring, np.full((len(ring), 1), high)], axis=1)
            part.face(face, tuple(min(255.0, c * float(rng.uniform(0.8, 1.3))) for c in tone), matt=True)  # type: ignore[arg-type]
    return Solid("clutter", [part], outline, high)
