"""Vehicles and people seen from above: one function a class, each drawing a varied sprite, nose to +x.

The classes overlap in size, outline and paint on purpose. Fine detail tells them apart: window rows, roof rails
and ribs, planks and cargo in a bed, hatches and fans on a bus. Base resolution and bitrate lose it.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from hvt_scene.drawing.canvas import Canvas, Colour, Points, Sprite, shade

CLASS_NAMES = ("car", "van", "truck", "bus", "motor", "pedestrian", "other")

_GLASS: Colour = (52.0, 44.0, 38.0)
_DARK: Colour = (38.0, 38.0, 40.0)
_LAMP: Colour = (215.0, 240.0, 250.0)
_TAIL: Colour = (40.0, 36.0, 190.0)
_PAINTS: tuple[Colour, ...] = (
    (238.0, 238.0, 236.0),
    (225.0, 226.0, 228.0),
    (188.0, 186.0, 182.0),
    (128.0, 126.0, 122.0),
    (70.0, 68.0, 66.0),
    (42.0, 40.0, 40.0),
    (46.0, 40.0, 158.0),
    (142.0, 84.0, 38.0),
    (92.0, 58.0, 30.0),
    (70.0, 92.0, 52.0),
    (120.0, 160.0, 186.0),
    (58.0, 150.0, 208.0),
)
_WORK_PAINTS: tuple[Colour, ...] = (*_PAINTS[:4], *_PAINTS[:3], _PAINTS[6], _PAINTS[7], _PAINTS[11])

_Rng = np.random.Generator


def draw_vehicle(class_name: str, rng: _Rng, *, small: bool = False) -> Sprite:
    """Draw one of `CLASS_NAMES`, the same from the same state; ``small`` ones fit into a stall."""
    return _DRAW[class_name](rng) if class_name in _DRAW else _DRAW_SIZED[class_name](rng, small=small)


def _pick(rng: _Rng, colours: tuple[Colour, ...]) -> Colour:
    return shade(colours[int(rng.integers(len(colours)))], float(rng.uniform(0.9, 1.06)))


def _hull(length: float, width: float, *, nose: float, tail: float) -> Points:
    """A body outline whose corners are cut by ``nose`` and ``tail`` metres."""
    x, y = length / 2, width / 2
    right = [
        (-x, y - tail),
        (-x + 0.4 * tail, y - 0.25 * tail),
        (-x + tail, y),
        (x - 1.6 * nose, y),
        (x - 0.45 * nose, y - 0.35 * nose),
        (x, y - 1.2 * nose),
    ]
    return np.array(right + [(px, -py) for px, py in reversed(right)])


def _lamps(canvas: Canvas, length: float, width: float) -> None:
    x, y = length / 2, width / 2
    for side in (-1, 1):
        canvas.poly(
            [(x - 0.34, side * (y - 0.14)), (x - 0.12, side * (y - 0.42)), (x - 0.3, side * (y - 0.5))], _LAMP
        )
        canvas.rect(-x + 0.05, side * (y - 0.14), -x + 0.17, side * (y - 0.46), colour=_TAIL)


def _windscreen(canvas: Canvas, front: float, back: float, *, width: float) -> None:
    """A dark pane from ``front`` (x of its lower edge) to ``back`` (x of its upper edge), narrower at the roof."""
    near, far = width / 2 - 0.12, width / 2 - 0.27
    canvas.poly([(front, -near), (front, near), (back, far), (back, -far)], _GLASS)
    glint = 0.35 * front + 0.65 * back
    canvas.line((glint, -0.5 * far), (glint, 0.35 * far), colour=shade(_GLASS, 1.9), wide_m=0.05)


def _side_windows(canvas: Canvas, front: float, back: float, *, width: float, panes: int) -> None:
    edges = np.linspace(front, back, panes + 1)
    for side in (-1, 1):
        low, high = side * (width / 2 - 0.10), side * (width / 2 - 0.25)
        for start, end in pairwise(edges):
            canvas.poly(
                [(start - 0.06, low), (end + 0.06, low), (end + 0.10, high), (start - 0.1, high)], _GLASS
            )


def _car(rng: _Rng) -> Sprite:
    length, width = rng.uniform(3.8, 4.95), rng.uniform(1.74, 1.92)
    paint = _pick(rng, _PAINTS)
    canvas = Canvas(length, width)
    canvas.body(_hull(length, width, nose=0.26, tail=0.22), paint)
    kind = int(rng.integers(3))  # saloon, hatchback, estate
    bonnet = length / 2 - rng.uniform(1.05, 1.3)
    back = -length / 2 + (1.15, 0.42, 0.3)[kind] * rng.uniform(0.9, 1.15)
    roof_front, roof_back = bonnet - 0.72, back + (0.62, 0.45, 0.35)[kind]
    for side in (-1, 1):  # creases of the bonnet
        canvas.line((bonnet, side * 0.52), (length / 2 - 0.3, side * 0.4), colour=shade(paint, 0.8))
    _windscreen(canvas, bonnet, roof_front, width=width)
    _windscreen(canvas, back, roof_back, width=width)
    _side_windows(canvas, roof_front, roof_back, width=width, panes=2 + (kind == 2))
    roof = width / 2 - 0.27
    canvas.rect(roof_back, -roof, roof_front, roof, colour=shade(paint, 1.05))
    canvas.line(
        (roof_back + 0.1, -0.3 * roof), (roof_front - 0.1, -0.3 * roof), colour=shade(paint, 1.14), wide_m=0.2
    )
    if rng.random() < 0.3:  # sunroof
        canvas.rect(roof_front - 0.75, -0.45, roof_front - 0.15, 0.45, colour=_GLASS)
    if kind == 2 and rng.random() < 0.7:  # roof rails
        for side in (-1, 1):
            rail = side * (roof - 0.06)
            canvas.line(
                (roof_back + 0.1, rail), (roof_front - 0.1, rail), colour=(190, 190, 190), wide_m=0.06
            )
    if rng.random() < 0.08:  # taxi sign
        canvas.rect(roof_front - 0.9, -0.32, roof_front - 0.65, 0.32, colour=(60, 210, 250))
    _lamps(canvas, length, width)
    return canvas.sprite(height_m=float(rng.uniform(1.4, 1.7)))


def _van(rng: _Rng, *, small: bool) -> Sprite:
    length, width = rng.uniform(4.5, 5.2 if small else 5.8), rng.uniform(1.86, 2.08)
    paint = _pick(rng, _WORK_PAINTS)
    canvas = Canvas(length, width)
    canvas.body(_hull(length, width, nose=0.24, tail=0.1), paint)
    bonnet = length / 2 - rng.uniform(0.55, 0.85)
    roof_front, roof_back = bonnet - 0.62, -length / 2 + 0.14
    _windscreen(canvas, bonnet, roof_front, width=width)
    _side_windows(canvas, roof_front, roof_front - 0.75, width=width, panes=1)
    roof = width / 2 - 0.16
    canvas.rect(roof_back, -roof, roof_front - 0.06, roof, colour=shade(paint, 1.04))
    for x in np.arange(roof_back + 0.2, roof_front - 0.15, 0.34):  # pressed ribs across the roof
        canvas.line((x, -roof + 0.1), (x, roof - 0.1), colour=shade(paint, 0.74), wide_m=0.07)
        canvas.line((x + 0.08, -roof + 0.1), (x + 0.08, roof - 0.1), colour=shade(paint, 1.2), wide_m=0.05)
    if rng.random() < 0.4:  # ladder
        y = rng.uniform(-0.4, 0.3)
        for side in (0.0, 0.36):
            canvas.line(
                (roof_back + 0.3, y + side), (roof_front - 0.4, y + side), colour=(70, 150, 200), wide_m=0.06
            )
        for x in np.arange(roof_back + 0.35, roof_front - 0.4, 0.3):
            canvas.line((x, y), (x, y + 0.36), colour=(70, 150, 200), wide_m=0.05)
    elif rng.random() < 0.5:  # vent
        canvas.ellipse(roof_back + 1.0, 0, radii=(0.24, 0.24), colour=shade(paint, 0.55))
    canvas.line((-length / 2 + 0.02, 0), (-length / 2 + 0.16, 0), colour=_DARK)  # split of the rear doors
    _lamps(canvas, length, width)
    return canvas.sprite(height_m=float(rng.uniform(2.0, 2.6)))


def _truck(rng: _Rng, *, small: bool) -> Sprite:
    pickup = small or rng.random() < 0.35
    length = rng.uniform(4.9, 5.3 if small else 5.9) if pickup else rng.uniform(6.6, 10.5)
    width = rng.uniform(1.86, 2.04) if pickup else rng.uniform(2.3, 2.5)
    paint = _pick(rng, _WORK_PAINTS)
    canvas = Canvas(length, width)
    canvas.body(_hull(length, width, nose=0.24 if pickup else 0.12, tail=0.06), shade(paint, 0.95))
    bonnet = length / 2 - (rng.uniform(1.1, 1.35) if pickup else 0.12)
    cab_back = bonnet - (rng.uniform(1.6, 2.3) if pickup else rng.uniform(1.7, 2.1))
    _windscreen(canvas, bonnet, bonnet - (0.6 if pickup else 0.35), width=width)
    _side_windows(canvas, bonnet - 0.6, cab_back + 0.2, width=width, panes=1)
    roof = width / 2 - 0.24
    canvas.rect(cab_back, -roof, bonnet - 0.62, roof, colour=shade(paint, 1.05))
    if not pickup:  # gap behind the cab, with the chassis in it
        canvas.rect(cab_back - 0.35, -width / 2, cab_back, width / 2, colour=_DARK)
        if rng.random() < 0.6:  # wind deflector
            canvas.rect(cab_back + 0.1, -0.8, cab_back + 0.7, 0.8, colour=shade(paint, 0.8))
    bed = (-length / 2 + 0.1, -width / 2 + 0.1, cab_back - (0.1 if pickup else 0.42), width / 2 - 0.1)
    _cargo(canvas, bed, rng=rng, open_only=pickup)
    _lamps(canvas, length, width)
    return canvas.sprite(height_m=float(rng.uniform(1.7, 1.9) if pickup else rng.uniform(2.6, 3.6)))


def _cargo(canvas: Canvas, bed: tuple[float, float, float, float], *, rng: _Rng, open_only: bool) -> None:
    """Fill a load bed x0 y0 x1 y1: planks, gravel, crates, or (closed bodies only) a box or a tarpaulin on bows."""
    x0, y0, x1, y1 = bed
    kind = int(rng.integers(3 if open_only else 5))
    if kind == 0:  # empty planks
        canvas.rect(x0, y0, x1, y1, colour=(72, 96, 122))
        for y in np.arange(y0 + 0.14, y1, 0.19):
            canvas.line((x0, y), (x1, y), colour=(42, 56, 74), wide_m=0.05)
        canvas.speckle(bed, rng=rng, sigma=12)
    elif kind == 1:  # gravel
        canvas.rect(x0, y0, x1, y1, colour=(92, 116, 138))
        canvas.ellipse((x0 + x1) / 2, 0, radii=((x1 - x0) * 0.38, (y1 - y0) * 0.34), colour=(112, 140, 164))
        canvas.speckle(bed, rng=rng, sigma=26)
    elif kind == 2:  # crates
        canvas.rect(x0, y0, x1, y1, colour=(52, 54, 56))
        for x in np.arange(x0 + 0.1, x1 - 0.55, 0.66):
            for y in np.arange(y0 + 0.06, y1 - 0.5, 0.6):
                if rng.random() < 0.75:
                    tint = shade(((86, 140, 184), (60, 120, 90), (176, 176, 172))[int(rng.integers(3))], 0.95)
                    canvas.rect(x, y, x + 0.56, y + 0.52, colour=tint)
                    canvas.line((x, y), (x + 0.56, y + 0.52), colour=shade(tint, 0.6), wide_m=0.05)
    else:
        skin = _pick(rng, ((228, 228, 226), (150, 90, 40), (60, 120, 70), (80, 80, 176), (170, 176, 180)))
        canvas.rect(x0, y0, x1, y1, colour=skin)
        step = 0.8 if kind == 3 else 0.52
        for x in np.arange(x0 + step / 2, x1, step):  # seams of a box, bows under a tarpaulin
            canvas.line((x, y0), (x, y1), colour=shade(skin, 0.78), wide_m=0.05 if kind == 3 else 0.12)
            if kind == 4:
                canvas.line((x + 0.13, y0), (x + 0.13, y1), colour=shade(skin, 1.15), wide_m=0.1)
        canvas.rect(x0, y0, x1, y0 + 0.06, colour=shade(skin, 0.7))
        canvas.rect(x0, y1 - 0.06, x1, y1, colour=shade(skin, 0.7))


def _bus(rng: _Rng) -> Sprite:
    length, width = rng.uniform(10.2, 12.4), rng.uniform(2.48, 2.56)
    paint = _pick(rng, ((236, 236, 232), (44, 44, 176), (60, 176, 220), (150, 96, 40), (110, 150, 70)))
    roof_paint = (232.0, 234.0, 234.0) if rng.random() < 0.6 else shade(paint, 1.08)
    canvas = Canvas(length, width)
    canvas.body(_hull(length, width, nose=0.2, tail=0.16), paint)
    x, y = length / 2, width / 2
    canvas.rect(x - 0.5, -y + 0.2, x - 0.12, y - 0.2, colour=_GLASS)
    _side_windows(canvas, x - 0.9, -x + 0.5, width=width - 0.06, panes=7)
    canvas.rect(-x + 0.3, -y + 0.27, x - 0.6, y - 0.27, colour=roof_paint)
    for side in (-1, 1):
        canvas.line(
            (-x + 0.4, side * (y - 0.5)), (x - 0.8, side * (y - 0.5)), colour=shade(paint, 0.85), wide_m=0.1
        )
    for hatch in np.linspace(-x + 2.4, x - 2.2, 3):
        canvas.rect(hatch, -0.36, hatch + 0.7, 0.36, colour=shade(roof_paint, 0.72))
        canvas.rect(hatch + 0.08, -0.28, hatch + 0.62, 0.28, colour=shade(roof_paint, 0.9))
    unit = float(rng.uniform(-x + 3.4, x - 5.5))  # air conditioning: a ribbed box with two fans
    canvas.rect(unit, -0.8, unit + 2.2, 0.8, colour=shade(roof_paint, 0.84))
    for rib in np.arange(unit + 0.1, unit + 2.2, 0.16):
        canvas.line((rib, -0.72), (rib, 0.72), colour=shade(roof_paint, 0.68), wide_m=0.04)
    for fan in (unit + 0.6, unit + 1.6):
        canvas.ellipse(fan, 0, radii=(0.34, 0.34), colour=_DARK)
        canvas.ellipse(fan, 0, radii=(0.1, 0.1), colour=shade(roof_paint, 0.8))
    _lamps(canvas, length, width)
    return canvas.sprite(height_m=3.1)


def _motor(rng: _Rng) -> Sprite:
    paint, shirt = _pick(rng, _PAINTS), _pick(rng, _PAINTS)
    canvas = Canvas(2.2, 0.86)
    canvas.body(
        [(-1.08, -0.1), (-1.0, -0.16), (1.0, -0.12), (1.08, 0.0), (1.0, 0.12), (-1.0, 0.16), (-1.08, 0.1)],
        _DARK,
    )
    canvas.body([(0.48, -0.38), (0.58, -0.38), (0.62, 0.38), (0.52, 0.38)], (70, 70, 72))
    canvas.poly([(-0.7, -0.14), (0.6, -0.12), (0.8, 0), (0.6, 0.12), (-0.7, 0.14)], paint)
    if rng.random() < 0.85:
        canvas.body([(-0.3, -0.28), (0.1, -0.31), (0.2, 0.0), (0.1, 0.31), (-0.3, 0.28)], shirt)
        for side in (-1, 1):
            canvas.body(
                [(0.05, side * 0.3), (0.1, side * 0.2), (0.56, side * 0.28), (0.54, side * 0.36)],
                shade(shirt, 0.85),
            )
        canvas.ellipse(0.06, 0, radii=(0.16, 0.14), colour=_pick(rng, _PAINTS), solid=True)
        canvas.ellipse(0.1, -0.03, radii=(0.06, 0.05), colour=(235, 235, 235))
    canvas.ellipse(0.96, 0, radii=(0.07, 0.08), colour=_LAMP)
    return canvas.sprite(height_m=1.4)


def _pedestrian(rng: _Rng) -> Sprite:
    shirt, trousers = _pick(rng, _PAINTS), shade(_pick(rng, _PAINTS[2:]), 0.8)
    canvas = Canvas(0.8, 0.62)
    stride = float(rng.uniform(0.1, 0.3))
    for side in (-1, 1):
        ahead = side * stride
        canvas.ellipse(ahead, 0.11 * side, radii=(0.17, 0.09), colour=trousers, solid=True)
    canvas.ellipse(0, 0, radii=(0.16, 0.27), colour=shirt, solid=True)
    for side in (-1, 1):
        canvas.ellipse(
            -side * 0.5 * stride, 0.24 * side, radii=(0.14, 0.07), colour=shade(shirt, 0.85), solid=True
        )
    if rng.random() < 0.3:
        canvas.rect(-0.28, -0.16, -0.1, 0.16, colour=_pick(rng, _PAINTS))
    canvas.ellipse(
        0.03,
        0,
        radii=(0.12, 0.105),
        colour=_pick(rng, ((30, 40, 60), (90, 130, 170), (50, 50, 50))),
        solid=True,
    )
    return canvas.sprite(height_m=1.72)


def _other(rng: _Rng, *, small: bool) -> Sprite:
    """Objects that are no vehicles but look like them: containers, flat trailers, skips."""
    kind = 2 if small else int(rng.integers(3))
    length, width = ((6.06, 2.44), (float(rng.uniform(6.5, 9)), 2.4), (float(rng.uniform(3.4, 4.4)), 1.85))[
        kind
    ]
    paint = _pick(
        rng, ((60, 80, 150), (130, 90, 40), (80, 120, 60), (60, 130, 200), (140, 140, 136), (50, 50, 130))
    )
    canvas = Canvas(length, width)
    x, y = length / 2, width / 2
    canvas.body([(-x, -y), (x, -y), (x, y), (-x, y)], paint)
    if kind == 0:  # corrugated container
        for rib in np.arange(-x + 0.15, x, 0.25):
            canvas.line((rib, -y + 0.08), (rib, y - 0.08), colour=shade(paint, 0.78), wide_m=0.09)
        canvas.speckle((-x, -y, x, y), rng=rng, sigma=7)
    elif kind == 1:  # flat trailer of planks
        canvas.rect(-x + 0.08, -y + 0.08, x - 0.08, y - 0.08, colour=(84, 112, 140))
        for plank in np.arange(-x + 0.2, x, 0.22):
            canvas.line((plank, -y + 0.1), (plank, y - 0.1), colour=(52, 70, 90), wide_m=0.04)
    else:  # skip of rubble
        canvas.rect(-x + 0.12, -y + 0.12, x - 0.12, y - 0.12, colour=shade(paint, 0.45))
        canvas.ellipse(0, 0, radii=(x - 0.4, y - 0.3), colour=(110, 124, 134))
        canvas.speckle((-x + 0.2, -y + 0.2, x - 0.2, y - 0.2), rng=rng, sigma=30)
    return canvas.sprite(height_m=(2.6, 1.1, 1.3)[kind])


_DRAW: dict[str, Callable[[_Rng], Sprite]] = {
    "car": _car,
    "bus": _bus,
    "motor": _motor,
    "pedestrian": _pedestrian,
}
_DRAW_SIZED: dict[str, Callable[..., Sprite]] = {"van": _van, "truck": _truck, "other": _other}
