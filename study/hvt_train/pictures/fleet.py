"""The objects of a place: one function a class, each making a varied `Solid`."""

from collections.abc import Callable

import numpy as np

from hvt_train.pictures.solids import (
    TYRES,
    Part,
    Points,
    Solid,
    add_bonnet_lines,
    add_cabin,
    add_mirrors,
    chamfered,
    lit,
    make_body,
    random_glass,
    random_paint,
)

_Rng = np.random.Generator


def make_solid(class_name: str, rng: _Rng) -> Solid:
    """Make one varied object of a class of the scene (`hvt_scene.drawing.vehicles.CLASS_NAMES`)."""
    return _MAKERS[class_name](rng)


def _car(rng: _Rng) -> Solid:
    length, width, height = rng.uniform(3.4, 5.2), rng.uniform(1.62, 2.02), rng.uniform(1.35, 1.9)
    paint, belt = random_paint(rng), float(height * rng.uniform(0.5, 0.62))
    part = make_body(length, width, belt=belt, paint=paint, rng=rng)
    kind = int(rng.integers(4))  # saloon, hatchback, estate, off-roader
    front = length / 2 - rng.uniform(0.85, 1.45)
    back = -length / 2 + (0.95, 0.25, 0.12, 0.12)[kind] * rng.uniform(0.8, 1.25)
    rake_front, rake_back = rng.uniform(0.45, 0.95), (0.75, 0.5, 0.3, 0.2)[kind] * rng.uniform(0.7, 1.3)
    add_bonnet_lines(part, rng, front=front, length=length, z=belt, paint=paint)
    add_mirrors(part, front, width, z=belt, paint=paint)
    roof = lit(paint, 1.0) if rng.random() < 0.9 else random_paint(rng)
    half = width / 2
    add_cabin(
        part,
        rng,
        base=(front, back, half * 0.93),
        roof=(front - rake_front, back + rake_back, half * float(rng.uniform(0.66, 0.8))),
        z=(belt, height),
        paint=roof,
        panes=2 + (kind >= 2),
        rear_glass=True,
    )
    rf, rb, wr = front - rake_front, back + rake_back, half * 0.66
    draw = rng.random()
    if draw < 0.3:  # glass in the roof
        part.decal((max(rb + 0.2, rf - 1.1), rf - 0.15), (-wr * 0.7, wr * 0.7), height, random_glass(rng))
    elif draw < 0.5:  # rails
        for side in (-1, 1):
            a, b = sorted((side * wr * 0.9, side * wr * 0.98))
            part.decal(
                (rb + 0.1, rf - 0.2),
                (a, b),
                height + 0.05,
                lit((190.0, 190.0, 190.0), rng.uniform(0.2, 1.1)),
            )
    elif draw < 0.56:  # a box or a load on the roof
        part.decal((rb + 0.3, rf - 0.3), (-0.4, 0.3), height + 0.2, random_paint(rng))
    return Solid("car", [part], chamfered(length, width, nose=0.2, tail=0.15), height)


def _van(rng: _Rng) -> Solid:
    big = rng.random() < 0.5
    length = rng.uniform(4.4, 5.2) if not big else rng.uniform(5.0, 6.8)
    width, height = rng.uniform(1.8, 2.15), rng.uniform(1.75, 2.2) if not big else rng.uniform(2.1, 2.8)
    paint = (
        random_paint(rng) if rng.random() < 0.5 else lit((236.0, 236.0, 234.0), float(rng.uniform(0.8, 1.05)))
    )
    belt = float(rng.uniform(0.95, 1.2))
    part = make_body(length, width, belt=belt, paint=paint, rng=rng)
    front = length / 2 - rng.uniform(0.3, 0.9)
    add_mirrors(part, front, width, z=belt, paint=paint)
    half = width / 2
    panelled = rng.random() < 0.65
    rake = rng.uniform(0.4, 0.8)
    add_cabin(
        part,
        rng,
        base=(front, -length / 2 + 0.04, half * 0.97),
        roof=(front - rake, -length / 2 + rng.uniform(0.06, 0.2), half * float(rng.uniform(0.85, 0.94))),
        z=(belt, height),
        paint=paint,
        panes=0 if panelled else 3,
        rear_glass=rng.random() < 0.6,
    )
    rf, rb, wr = front - rake, -length / 2 + 0.2, half * 0.84
    draw = rng.random()
    if draw < 0.6:  # pressed ribs
        lighter = float(rng.uniform(0.7, 0.9))
        for x in np.arange(rb + 0.2, rf - 0.2, rng.uniform(0.3, 0.6)):
            part.decal((x, x + 0.09), (-wr, wr), height, lit(paint, lighter))
    elif draw < 0.75:  # a ladder or a rack
        y = float(rng.uniform(-0.5, 0.2))
        for side in (0.0, 0.36):
            part.decal((rb + 0.2, rf - 0.2), (y + side, y + side + 0.07), height + 0.15, (90.0, 150.0, 190.0))
    elif draw < 0.85:
        x = float(rng.uniform(rb + 0.3, max(rf - 1.0, rb + 0.4)))
        part.decal((x, x + 0.6), (-0.3, 0.3), height + 0.08, lit(paint, 0.6))
    return Solid("van", [part], chamfered(length, width, nose=0.2, tail=0.08), height)


def _truck(rng: _Rng) -> Solid:
    return _pickup(rng) if rng.random() < 0.45 else _lorry(rng)


def _pickup(rng: _Rng) -> Solid:
    length, width, height = rng.uniform(4.9, 6.1), rng.uniform(1.8, 2.1), rng.uniform(1.7, 2.0)
    paint, belt = random_paint(rng), float(rng.uniform(1.0, 1.2))
    part = make_body(length, width, belt=belt, paint=paint, rng=rng)
    front = length / 2 - rng.uniform(1.1, 1.6)
    back = front - rng.uniform(1.6, 2.6)
    half = width / 2
    inner = (45.0, 45.0, 48.0) if rng.random() < 0.6 else random_paint(rng)
    bed = ((-length / 2 + 0.12, back - 0.12), (-half + 0.16, half - 0.16))
    part.decal(*bed, belt, inner)
    if rng.random() < 0.5:
        _load(part, bed, belt, rng)
    add_bonnet_lines(part, rng, front=front, length=length, z=belt, paint=paint)
    add_mirrors(part, front, width, z=belt, paint=paint)
    add_cabin(
        part,
        rng,
        base=(front, back, half * 0.95),
        roof=(front - rng.uniform(0.5, 0.8), back + rng.uniform(0.1, 0.35), half * 0.76),
        z=(belt, height),
        paint=paint,
        panes=2,
        rear_glass=True,
    )
    return Solid("truck", [part], chamfered(length, width, nose=0.2, tail=0.06), height)


def _load(part: Part, bed: tuple[tuple[float, float], tuple[float, float]], z: float, rng: _Rng) -> None:
    (x0, x1), (y0, y1) = bed
    kind = int(rng.integers(3))
    if kind == 0:
        for x in np.arange(x0, x1 - 0.5, rng.uniform(0.55, 1.0)):
            for y in np.arange(y0, y1 - 0.4, rng.uniform(0.5, 0.9)):
                if rng.random() < 0.7:
                    part.decal((x, x + 0.5), (y, y + 0.45), z + 0.1, random_paint(rng))
    elif kind == 1:
        tone = (float(rng.uniform(60, 110)), float(rng.uniform(80, 140)), float(rng.uniform(110, 180)))
        part.decal(bed[0], bed[1], z, tone)
        for y in np.arange(y0, y1, 0.2):
            part.decal((x0, x1), (y, y + 0.05), z, lit(tone, 0.65))
    else:
        tone = (float(rng.uniform(70, 130)), float(rng.uniform(85, 140)), float(rng.uniform(95, 160)))
        part.decal(bed[0], bed[1], z, tone)
        part.decal((x0 + 0.3, x1 - 0.3), (y0 + 0.25, y1 - 0.25), z + 0.1, lit(tone, 1.2))


def _rectangle(x0: float, x1: float, half: float) -> Points:
    return np.array([(x0, -half), (x1, -half), (x1, half), (x0, half)])


def _lorry(rng: _Rng) -> Solid:
    length, width = rng.uniform(6.2, 12.0), rng.uniform(2.2, 2.55)
    half, paint = width / 2, random_paint(rng)
    cab_long = rng.uniform(1.6, 2.3)
    cab = Part(length / 2 - cab_long / 2)
    cab_height = float(rng.uniform(2.3, 3.2))
    x0, x1 = length / 2 - cab_long, length / 2
    cab.prism(
        _rectangle(x0, x1, half * 0.95), _rectangle(x0, x1, half * 0.95), (0.2, 1.2), side=paint, top=None
    )
    add_cabin(
        cab,
        rng,
        base=(x1, x0, half * 0.95),
        roof=(x1 - rng.uniform(0.1, 0.5), x0 + 0.05, half * 0.88),
        z=(1.2, cab_height),
        paint=paint,
        panes=1,
        rear_glass=False,
    )
    chassis = Part(0.0)
    chassis.prism(
        _rectangle(-length / 2, x1, half * 0.8),
        _rectangle(-length / 2, x1, half * 0.8),
        (0.3, 1.0),
        side=TYRES,
        top=(44.0, 44.0, 46.0),
    )
    load = Part(-cab_long / 2)
    tail, head = -length / 2 + 0.02, x0 - rng.uniform(0.1, 0.6)
    skin = random_paint(rng) if rng.random() < 0.6 else (232.0, 232.0, 230.0)
    closed = rng.random() < 0.6
    top = float(rng.uniform(2.6, 3.9)) if closed else float(rng.uniform(1.3, 1.9))
    outline = _rectangle(tail, head, half)
    load.prism(outline, outline, (1.0, top), side=skin, top=lit(skin, float(rng.uniform(0.9, 1.1))))
    if closed:
        if rng.random() < 0.6:
            tone = lit(skin, float(rng.uniform(0.7, 0.93)))
            for x in np.arange(tail + 0.3, head, rng.uniform(0.5, 1.6)):
                load.decal((x, x + 0.07), (-half, half), top, tone)
    else:
        bed = ((tail + 0.1, head - 0.1), (-half + 0.1, half - 0.1))
        load.decal(*bed, top, (60.0, 62.0, 64.0))
        if rng.random() < 0.8:
            _load(load, bed, top, rng)
    return Solid(
        "truck", [chassis, load, cab], _rectangle(-length / 2, length / 2, half), max(top, cab_height)
    )


def _bus(rng: _Rng) -> Solid:
    length, width, height = rng.uniform(8.0, 13.0), rng.uniform(2.35, 2.6), rng.uniform(2.7, 3.3)
    paint = random_paint(rng)
    roof = lit((236.0, 236.0, 234.0), float(rng.uniform(0.75, 1.05))) if rng.random() < 0.6 else paint
    half = width / 2
    part = Part(0.0)
    hull = chamfered(length, width, nose=0.15, tail=0.12)
    part.prism(hull, hull, (0.1, 1.2), side=paint, top=None)
    add_cabin(
        part,
        rng,
        base=(length / 2, -length / 2, half),
        roof=(length / 2 - rng.uniform(0.05, 0.35), -length / 2 + 0.08, half * 0.94),
        z=(1.2, height),
        paint=paint,
        panes=int(rng.integers(5, 9)),
        rear_glass=rng.random() < 0.6,
    )
    part.decal((-length / 2 + 0.25, length / 2 - 0.5), (-half * 0.88, half * 0.88), height, roof)
    for x in np.linspace(-length / 2 + 1.5, length / 2 - 1.8, int(rng.integers(2, 5))):
        part.decal((x, x + 0.7), (-0.38, 0.38), height + 0.05, lit(roof, float(rng.uniform(0.6, 0.9))))
    if rng.random() < 0.8:
        x = float(rng.uniform(-length / 2 + 1, length / 2 - 3.6))
        part.decal(
            (x, x + rng.uniform(1.4, 2.8)),
            (-0.8, 0.8),
            height + 0.15,
            lit(roof, float(rng.uniform(0.7, 1.0))),
        )
        for fan in (x + 0.2, x + 0.9):
            part.decal((fan, fan + 0.45), (-0.25, 0.25), height + 0.18, (50.0, 50.0, 50.0))
    return Solid("bus", [part], hull, height)


def _ring(x: float, y: float, radii: tuple[float, float]) -> Points:
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    return np.stack([x + radii[0] * np.cos(turn), y + radii[1] * np.sin(turn)], axis=1)


def _person(part: Part, rng: _Rng, *, z: tuple[float, float, float], x: float = 0.0) -> None:
    """Torso and head on legs or a vehicle; ``z`` are hips, shoulders and crown."""
    shirt, hair = random_paint(rng), lit((60.0, 80.0, 110.0), float(rng.uniform(0.3, 1.8)))
    radii = (float(rng.uniform(0.13, 0.2)), float(rng.uniform(0.2, 0.29)))
    torso = _ring(x, 0, radii)
    part.prism(torso * 0.9 + (0.1 * x, 0), torso, (z[0], z[1]), side=shirt, top=lit(shirt, 1.05))
    head = _ring(x + 0.03, 0, (0.12, 0.1))
    part.prism(head, head, (z[1], z[2]), side=(110.0, 140.0, 180.0), top=hair)


def _motor(rng: _Rng) -> Solid:
    length, paint = rng.uniform(1.75, 2.3), random_paint(rng)
    part = Part(0.0)
    thin = chamfered(length, 0.26, nose=0.08, tail=0.06)
    part.prism(thin, thin, (0.0, 0.6), side=TYRES, top=TYRES)
    tank = chamfered(length * 0.66, float(rng.uniform(0.3, 0.46)), nose=0.1, tail=0.06)
    part.prism(tank, tank * 0.9, (0.5, 0.95), side=paint, top=paint)
    bars = _rectangle(0.42 * length / 2, 0.42 * length / 2 + 0.08, float(rng.uniform(0.3, 0.42)))
    part.prism(bars, bars, (0.95, 1.05), side=TYRES, top=(70.0, 70.0, 72.0))
    ridden = rng.random() < 0.8
    if ridden:
        _person(part, rng, z=(0.8, 1.35, 1.65), x=-0.1)
        if rng.random() < 0.2:
            _person(part, rng, z=(0.8, 1.35, 1.65), x=-0.5)
    return Solid("motor", [part], chamfered(length, 0.6, nose=0.1, tail=0.1), 1.6 if ridden else 1.1)


def _pedestrian(rng: _Rng) -> Solid:
    part = Part(0.0)
    trousers = lit(random_paint(rng), 0.75)
    stride = float(rng.uniform(0.02, 0.26))
    for side in (-1, 1):
        leg = _ring(side * stride, 0.1 * side, (0.13, 0.09))
        part.prism(leg, leg * 0.9, (0.0, 0.85), side=trousers, top=trousers)
    height = float(rng.uniform(1.5, 1.9))
    _person(part, rng, z=(0.8, height - 0.3, height))
    return Solid("pedestrian", [part], _ring(0, 0, (0.22, 0.27)), height)


def _other(rng: _Rng) -> Solid:
    kind = int(rng.integers(3))  # container, flat trailer, skip
    length = (float(rng.choice([6.06, 12.2])), float(rng.uniform(5.5, 12)), float(rng.uniform(3.0, 4.8)))[
        kind
    ]
    half = (1.22, 1.2, float(rng.uniform(0.85, 1.0)))[kind]
    height = (2.6, float(rng.uniform(0.8, 1.3)), float(rng.uniform(1.0, 1.6)))[kind]
    paint = (
        random_paint(rng)
        if rng.random() < 0.3
        else lit(
            (
                (60.0, 80.0, 150.0),
                (130.0, 90.0, 40.0),
                (80.0, 120.0, 60.0),
                (60.0, 130.0, 200.0),
                (140.0, 140.0, 136.0),
            )[int(rng.integers(5))],
            float(rng.uniform(0.6, 1.3)),
        )
    )
    part = Part(0.0)
    outline = _rectangle(-length / 2, length / 2, half)
    part.prism(outline, outline, (0.0, height), side=paint, top=paint)
    if kind == 0:
        tone = lit(paint, float(rng.uniform(0.7, 0.88)))
        for x in np.arange(-length / 2 + 0.15, length / 2 - 0.1, 0.27):
            part.decal((x, x + 0.1), (-half + 0.08, half - 0.08), height, tone)
    else:
        bed = ((-length / 2 + 0.12, length / 2 - 0.12), (-half + 0.12, half - 0.12))
        part.decal(*bed, height, lit(paint, 0.5))
        _load(part, bed, height, rng)
    return Solid("other", [part], outline, height)


_MAKERS: dict[str, Callable[[_Rng], Solid]] = {
    "car": _car,
    "van": _van,
    "truck": _truck,
    "bus": _bus,
    "motor": _motor,
    "pedestrian": _pedestrian,
    "other": _other,
}
