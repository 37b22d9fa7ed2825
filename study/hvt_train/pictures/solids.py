"""Vehicles, people and boxes as small solids of flat faces, so that they can be seen at any angle.

The demo's sprites (`hvt_scene.drawing.vehicles`) are flat pictures seen straight from above. A real camera sees
sides, sloping glass, reflections and lean towards the edges; these solids have them, and vary far more in
shape, paint and glass than any real car park. Body axes: x to the nose, y to the right, z up, metres; the origin is
on the ground in the middle.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

_Rng = np.random.Generator
Points = npt.NDArray[np.float64]
Colour = tuple[float, float, float]
"""B, G, R in 0…255."""

TYRES: Colour = (26.0, 26.0, 26.0)
"""The black, lowest part of every vehicle."""


@dataclass(slots=True)
class Part:
    """A convex piece: faces in an order in which each may hide earlier ones."""

    x: float
    """Where it stands along the body, for the order among parts."""
    points_m: list[Points] = field(default_factory=list)
    """(K, 3) corners of each face, positive (x towards y) when seen from outside."""
    colours: list[Colour] = field(default_factory=list)
    matt: list[bool] = field(default_factory=list)
    """Whether light and shade on the face are left as painted (glass, lamps, details)."""

    def face(
        self, points: Points | list[tuple[float, float, float]], colour: Colour, *, matt: bool = False
    ) -> None:
        self.points_m.append(np.asarray(points, np.float64))
        self.colours.append(colour)
        self.matt.append(matt)

    def prism(
        self, low: Points, high: Points, z: tuple[float, float], *, side: Colour, top: Colour | None
    ) -> None:
        """Add walls from the outline ``low`` (K, 2) at z[0] to ``high`` at z[1], and a top where it has a colour."""
        below = np.concatenate([low, np.full((len(low), 1), z[0])], axis=1)
        above = np.concatenate([high, np.full((len(high), 1), z[1])], axis=1)
        for index in range(len(low)):
            after = (index + 1) % len(low)
            self.face(np.stack([below[index], below[after], above[after], above[index]]), side)
        if top is not None:
            self.face(above, top)

    def decal(self, x: tuple[float, float], y: tuple[float, float], z: float, colour: Colour) -> None:
        """Add a flat rectangle on a horizontal surface."""
        corners = [(x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z)]
        self.face(corners, colour, matt=True)

    def pane(self, corners: Points, share: tuple[float, float, float, float], colour: Colour) -> None:
        """Add glass in the wall whose corners are low-left, low-right, high-right, high-left.

        ``share`` is left, right, bottom and top of the pane, 0…1 across and up the wall.
        """
        u0, u1, v0, v1 = share
        low_left, low_right, high_right, high_left = corners
        picked = [
            (1 - v) * ((1 - u) * low_left + u * low_right) + v * ((1 - u) * high_left + u * high_right)
            for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))
        ]
        self.face(np.stack(picked), colour, matt=True)


@dataclass(frozen=True, slots=True)
class Solid:
    """A thing of several parts."""

    class_name: str
    parts: list[Part]
    foot_m: Points
    """(K, 2) outline on the ground."""
    height_m: float


def random_paint(rng: _Rng) -> Colour:
    """A colour of cars: mostly white, black and greys, some colours of any hue."""
    draw = rng.random()
    if draw < 0.68:
        level = float(rng.choice([238, 225, 190, 150, 110, 75, 45, 30, 22])) * float(rng.uniform(0.85, 1.06))
        blue, green, red = np.clip(level + rng.normal(0, 5, 3), 8, 252)
        return (float(blue), float(green), float(red))
    hue, strength = rng.random(), rng.uniform(0.35, 0.95)
    value = rng.uniform(50, 235)
    wheel = np.clip(np.abs((hue * 6 + np.array([4.0, 2.0, 0.0])) % 6 - 3) - 1, 0, 1)
    blue, green, red = value * (1 - strength * (1 - wheel))
    return (float(blue), float(green), float(red))


def random_glass(rng: _Rng) -> Colour:
    """Mostly dark; sometimes it mirrors the sky."""
    level = rng.uniform(18, 70) if rng.random() < 0.75 else rng.uniform(70, 190)
    return (float(level * rng.uniform(1.0, 1.2)), float(level * rng.uniform(0.95, 1.1)), float(level))


def lit(colour: Colour, gain: float) -> Colour:
    """The colour made lighter or darker, kept within 255."""
    return (min(255.0, colour[0] * gain), min(255.0, colour[1] * gain), min(255.0, colour[2] * gain))


def chamfered(length: float, width: float, *, nose: float, tail: float) -> Points:
    """(8, 2) outline with cut corners, positive when seen from above."""
    x, y = length / 2, width / 2
    return np.array(
        [
            (-x, -y + tail),
            (-x + tail, -y),
            (x - 1.5 * nose, -y),
            (x, -y + 1.1 * nose),
            (x, y - 1.1 * nose),
            (x - 1.5 * nose, y),
            (-x + tail, y),
            (-x, y - tail),
        ]
    )


def add_cabin(
    part: Part,
    rng: _Rng,
    *,
    base: tuple[float, float, float],
    roof: tuple[float, float, float],
    z: tuple[float, float],
    paint: Colour,
    panes: int,
    rear_glass: bool,
) -> None:
    """A glazed top; ``base`` and ``roof`` are front x, rear x and half width at the heights ``z``."""
    (xf, xb, wb), (rf, rb, wr) = base, roof
    low = np.array([(xb, -wb, z[0]), (xf, -wb, z[0]), (xf, wb, z[0]), (xb, wb, z[0])])
    high = np.array([(rb, -wr, z[1]), (rf, -wr, z[1]), (rf, wr, z[1]), (rb, wr, z[1])])
    screen, side = random_glass(rng), random_glass(rng)
    walls = [(0, 1), (1, 2), (2, 3), (3, 0)]  # left, front, right, rear
    for number, (a, b) in enumerate(walls):
        wall = np.stack([low[a], low[b], high[b], high[a]])
        part.face(wall, paint)
        if number == 1:
            part.pane(wall, (0.05, 0.95, 0.05, 0.96), screen)
        elif number == 3 and rear_glass:
            part.pane(wall, (0.08, 0.92, 0.10, 0.92), lit(screen, float(rng.uniform(0.7, 1.2))))
        elif number in (0, 2) and panes:
            edges = np.linspace(0.06, 0.94, panes + 1)
            for start, end in pairwise(edges):
                part.pane(wall, (float(start) + 0.015, float(end) - 0.015, 0.08, 0.9), side)
    part.face(high, lit(paint, float(rng.uniform(0.92, 1.12))))
    if rng.random() < 0.5:  # the sky mirrored in the roof
        shift = float(rng.uniform(-0.5, 0.3)) * wr
        part.decal(
            (rb + 0.15, rf - 0.15), (shift, shift + 0.45 * wr), z[1], lit(paint, rng.uniform(0.85, 1.35))
        )


def make_body(length: float, width: float, *, belt: float, paint: Colour, rng: _Rng) -> Part:
    """Wheels' gap, flanks and the surface at the height of the bonnet."""
    part = Part(0.0)
    hull = chamfered(length, width, nose=float(rng.uniform(0.12, 0.4)), tail=float(rng.uniform(0.08, 0.3)))
    part.prism(hull * 0.96, hull, (0.05, 0.28), side=TYRES, top=None)
    part.prism(
        hull, hull * (0.985, 0.94), (0.28, belt), side=paint, top=lit(paint, float(rng.uniform(0.95, 1.08)))
    )
    _lamps(part, length, width, belt, rng)
    return part


def _lamps(part: Part, length: float, width: float, belt: float, rng: _Rng) -> None:
    x, y = length / 2, width / 2
    lamp = lit((225.0, 235.0, 240.0), float(rng.uniform(0.4, 1.05)))
    tail = (float(rng.uniform(20, 70)), float(rng.uniform(20, 60)), float(rng.uniform(110, 210)))
    for side in (-1, 1):
        a, b = sorted((side * (y - 0.12), side * (y - 0.45)))
        part.decal((x - 0.34, x - 0.1), (a, b), belt, lamp)
        part.decal((-x + 0.03, -x + 0.14), (a, b), belt, tail)


def add_bonnet_lines(part: Part, rng: _Rng, *, front: float, length: float, z: float, paint: Colour) -> None:
    """Creases and a reflection on a bonnet that begins at x ``front``."""
    if rng.random() < 0.6:
        tone = lit(paint, float(rng.uniform(0.75, 0.92)))
        for side in (-1, 1):
            a, b = sorted((side * 0.5, side * 0.54))
            part.decal((front, length / 2 - 0.3), (a, b), z, tone)
    if rng.random() < 0.5:  # a reflection on the bonnet
        y = float(rng.uniform(-0.6, 0.2))
        part.decal(
            (front + 0.1, length / 2 - 0.25), (y, y + 0.4), z, lit(paint, float(rng.uniform(0.9, 1.4)))
        )


def add_mirrors(part: Part, front: float, width: float, *, z: float, paint: Colour) -> None:
    for side in (-1, 1):
        a, b = sorted((side * width * 0.47, side * (width / 2 + 0.16)))
        part.decal((front - 0.35, front - 0.18), (a, b), z + 0.1, paint)
