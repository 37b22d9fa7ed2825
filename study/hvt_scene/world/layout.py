"""The plan of the world in metres: a crossing of two roads and blocks of car parks, roofs, parks and yards."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from hvt_scene.appearance import Appearance

WORLD_M = (270.0, 136.0)
"""Size of the world: x to the east, y to the south, origin in the north-west corner."""

MAIN_HALF_M = 7.2
SIDE_HALF_M = 4.0
PAVEMENT_M = 3.2

_STALL_M = (2.7, 5.5)
_AISLE_M = 6.6

_Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Rect:
    """An upright rectangle, metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @property
    def size(self) -> tuple[float, float]:
        """(width, depth) in metres."""
        return (self.x1 - self.x0, self.y1 - self.y0)

    @property
    def corners(self) -> list[tuple[float, float]]:
        """From the north-west one, clockwise."""
        return [(self.x0, self.y0), (self.x1, self.y0), (self.x1, self.y1), (self.x0, self.y1)]

    def inset(self, margin: float) -> Rect:
        """The rectangle with ``margin`` taken off every side."""
        return Rect(self.x0 + margin, self.y0 + margin, self.x1 - margin, self.y1 - margin)


@dataclass(frozen=True, slots=True)
class Building:
    """A block with a flat roof (``gravel``, ``metal``, ``solar``) or a ridge (``tiles``)."""

    rect: Rect
    height_m: float
    roof: str


@dataclass(frozen=True, slots=True)
class Tree:
    """A canopy of radius ``r``; ``variant`` picks the drawing."""

    x: float
    y: float
    r: float
    variant: int


@dataclass(frozen=True, slots=True)
class Parked:
    """A thing that stands still: class, place, heading as quarter turns from east, clockwise."""

    class_name: str
    x: float
    y: float
    turn: float
    small: bool


@dataclass(slots=True)
class Layout:
    """Everything that does not move. ``surfaces`` are painted in order: (kind, rectangle)."""

    main_y: float
    side_x: float
    surfaces: list[tuple[str, Rect]] = field(default_factory=list)
    lines: list[tuple[float, float, float, float]] = field(default_factory=list)
    buildings: list[Building] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)
    parked: list[Parked] = field(default_factory=list)
    loops: list[list[tuple[float, float]]] = field(default_factory=list)
    """Closed tours along the aisles of car parks."""
    walks: list[tuple[float, float, float, float]] = field(default_factory=list)
    """Straight footpaths x0 y0 x1 y1 that people use."""


def plan(rng: _Rng, appearance: Appearance) -> Layout:
    """Lay out a world; the same generator state gives the same one."""
    layout = Layout(main_y=WORLD_M[1] / 2 + float(rng.uniform(-3, 3)), side_x=float(rng.uniform(122, 144)))
    for block, kinds in zip(_blocks(layout), _kinds(rng), strict=True):
        split = block.x0 + block.size[0] * float(rng.uniform(0.46, 0.56))
        plots = Rect(block.x0, block.y0, split, block.y1), Rect(split, block.y0, block.x1, block.y1)
        for plot, kind in zip(plots, kinds, strict=True):
            _fill(layout, plot, kind=kind, rng=rng, appearance=appearance)
    _roadside(layout, rng)
    return layout


def _kinds(rng: _Rng) -> list[tuple[str, str]]:
    """The kinds of the four blocks (two plots each); a yard and two car parks are always near the middle."""
    near = ["parking", "parking", "yard", "roofs"]
    far = ["parking", "houses", "park", "court"]
    rng.shuffle(near)
    rng.shuffle(far)
    # West blocks have their inner plot on the right, east blocks on the left.
    return [(far[0], near[0]), (near[1], far[1]), (far[2], near[2]), (near[3], far[3])]


def _blocks(layout: Layout) -> list[Rect]:
    """North-west, north-east, south-west, south-east, inside the pavements."""
    main, side = MAIN_HALF_M + PAVEMENT_M, SIDE_HALF_M + PAVEMENT_M
    north, south = layout.main_y - main, layout.main_y + main
    west, east = layout.side_x - side, layout.side_x + side
    return [
        Rect(x0, y0, x1, y1)
        for y0, y1 in ((0.0, north), (south, WORLD_M[1]))
        for x0, x1 in ((0.0, west), (east, WORLD_M[0]))
    ]


def _fill(layout: Layout, plot: Rect, *, kind: str, rng: _Rng, appearance: Appearance) -> None:
    if kind == "parking":
        _parking(layout, plot, rng=rng, appearance=appearance)
    elif kind == "yard":
        _yard(layout, plot, rng=rng)
    elif kind == "roofs":
        _roofs(layout, plot, rng=rng)
    elif kind == "houses":
        _houses(layout, plot, rng=rng)
    else:
        _park(layout, plot, rng=rng, court=kind == "court")


def _parking(layout: Layout, plot: Rect, *, rng: _Rng, appearance: Appearance) -> None:
    """Double rows of stalls between aisles, planted islands at their ends, and a tour around the aisles."""
    layout.surfaces.append(("grass", plot))
    lot = plot.inset(2.2)
    layout.surfaces.append(("lot", lot))
    wide, deep = _STALL_M
    stalls = int((lot.size[0] - 15) // wide)
    left = lot.x0 + (lot.size[0] - stalls * wide) / 2
    aisles: list[float] = []
    y = lot.y0 + 0.3
    while y + deep <= lot.y1:
        _stall_row(layout, (left, y), stalls=stalls, rng=rng, appearance=appearance)
        y += deep
        paired = len(aisles) > 0 and y + deep + _AISLE_M <= lot.y1
        if paired:
            _stall_row(layout, (left, y), stalls=stalls, rng=rng, appearance=appearance)
            for x in (left - 1.6, left + stalls * wide + 1.6):
                island = Rect(x - 1.2, y - deep + 0.4, x + 1.2, y + deep - 0.4)
                layout.surfaces.append(("island", island))
                layout.trees.append(
                    Tree(x, y + float(rng.uniform(-2, 2)), float(rng.uniform(1.8, 3.0)), int(rng.integers(8)))
                )
            y += deep
        aisles.append(y + _AISLE_M / 2)
        y += _AISLE_M
    if len(aisles) > 1 and aisles[1] < lot.y1:
        x0, x1 = left - 4.8, left + stalls * wide + 4.8
        layout.loops.append([(x0, aisles[0]), (x1, aisles[0]), (x1, aisles[1]), (x0, aisles[1])])
        layout.walks.extend(
            (left + 2, aisle + 1.9, left + stalls * wide - 2, aisle + 2.2) for aisle in aisles[:2]
        )


def _stall_row(
    layout: Layout, corner: tuple[float, float], *, stalls: int, rng: _Rng, appearance: Appearance
) -> None:
    wide, deep = _STALL_M
    left, top = corner
    layout.lines.extend((left + i * wide, top, left + i * wide, top + deep) for i in range(stalls + 1))
    layout.lines.append((left, top + deep / 2, left, top + deep / 2))
    for index in range(stalls):
        if rng.random() > appearance.occupancy:
            continue
        kind = _stall_class(float(rng.random()))
        x = left + (index + 0.5) * wide + float(rng.normal(0, 0.1))
        y = top + deep / 2 + float(rng.normal(0, 0.16))
        turn = (1.0 if rng.random() < 0.5 else 3.0) + float(rng.normal(0, 0.018))
        layout.parked.append(Parked(kind, x, y, turn, small=True))


def _stall_class(draw: float) -> str:
    bounds = ((0.64, "car"), (0.80, "van"), (0.93, "truck"), (0.97, "motor"))
    return next((name for bound, name in bounds if draw < bound), "other")


def _yard(layout: Layout, plot: Rect, *, rng: _Rng) -> None:
    """Bare soil with containers, trailers and parked trucks, and one shed."""
    layout.surfaces.append(("soil", plot))
    apron = Rect(plot.x0 + 4, plot.y0 + 8, plot.x1 - 6, plot.y0 + 36)
    layout.surfaces.append(("concrete", apron))
    shed = Rect(plot.x0 + 6, plot.y1 - 20, plot.x0 + 6 + plot.size[0] * 0.4, plot.y1 - 5)
    layout.buildings.append(Building(shed, 7.0, "metal"))
    for row in range(3):
        for column in range(int(plot.size[0] // 9) - 1):
            if rng.random() < 0.28:
                continue
            kind = ("other", "truck", "other", "van", "bus", "truck")[int(rng.integers(6))]
            if kind == "bus" and (row != 1 or column % 2):
                kind = "truck"
            x = plot.x0 + 9 + column * 9 + float(rng.normal(0, 0.4))
            y = plot.y0 + 9 + row * 13.2 + float(rng.normal(0, 0.4))
            layout.parked.append(
                Parked(kind, x, y, float(1 + 2 * rng.integers(2) + rng.normal(0, 0.04)), small=False)
            )
    layout.walks.append((plot.x0 + 10, plot.y1 - 22, plot.x1 - 6, plot.y1 - 24))
    _scatter(
        layout, Rect(plot.x0 + plot.size[0] * 0.55, plot.y1 - 16, plot.x1 - 3, plot.y1 - 3), count=7, rng=rng
    )


def _roofs(layout: Layout, plot: Rect, *, rng: _Rng) -> None:
    """Two or three large flat roofs on paving."""
    layout.surfaces.append(("paving", plot))
    layout.surfaces.append(("grass", Rect(plot.x0 + 3, plot.y1 - 9, plot.x1 - 3, plot.y1 - 3)))
    edges = np.linspace(plot.x0 + 5, plot.x1 - 3, 3 + int(plot.size[0] > 62))
    for x0, x1 in pairwise(edges):
        deep = float(rng.uniform(0.55, 0.75)) * plot.size[1]
        roof = ("gravel", "metal", "solar")[int(rng.integers(3))]
        rect = Rect(float(x0), plot.y0 + 5, float(x1) - 5, plot.y0 + 5 + deep)
        layout.buildings.append(Building(rect, float(rng.uniform(6, 11)), roof))
    layout.walks.append((plot.x0 + 3, plot.y1 - 10.5, plot.x1 - 3, plot.y1 - 10.5))
    _scatter(layout, Rect(plot.x0 + 3, plot.y1 - 9, plot.x1 - 3, plot.y1 - 4), count=8, rng=rng)


def _houses(layout: Layout, plot: Rect, *, rng: _Rng) -> None:
    """Detached houses with tiled roofs, drives and gardens."""
    layout.surfaces.append(("grass", plot))
    columns = max(2, int(plot.size[0] // 17))
    step = plot.size[0] / columns
    for row in range(2):
        for column in range(columns):
            x = plot.x0 + column * step + 3
            y = plot.y0 + 5 + row * (plot.size[1] - 8) / 2
            rect = Rect(x, y, x + float(rng.uniform(8.5, 11)), y + float(rng.uniform(9, 13)))
            layout.buildings.append(Building(rect, float(rng.uniform(5, 6.5)), "tiles"))
            drive = Rect(rect.x1 + 0.5, rect.y0 + 1, min(rect.x1 + 3.6, plot.x1 - 0.5), rect.y1 + 5)
            layout.surfaces.append(("paving", drive))
            if rng.random() < 0.7:
                kind = ("car", "van", "car")[int(rng.integers(3))]
                layout.parked.append(Parked(kind, (drive.x0 + drive.x1) / 2, drive.y1 - 3.2, 1.0, small=True))
            _scatter(layout, Rect(rect.x0, rect.y1 + 3, rect.x1, rect.y1 + 9), count=2, rng=rng)


def _park(layout: Layout, plot: Rect, *, rng: _Rng, court: bool) -> None:
    """Grass with paths and trees; with ``court`` also two playing courts."""
    layout.surfaces.append(("grass", plot))
    middle = (plot.y0 + plot.y1) / 2
    layout.surfaces.append(("gravelpath", Rect(plot.x0, middle - 1.3, plot.x1, middle + 1.3)))
    centre = (plot.x0 + plot.x1) / 2
    layout.surfaces.append(("gravelpath", Rect(centre - 1.2, plot.y0, centre + 1.2, plot.y1)))
    layout.walks.append((plot.x0 + 2, middle, plot.x1 - 2, middle))
    layout.walks.append((centre, plot.y0 + 2, centre, plot.y1 - 2))
    wooded = [plot.inset(3)]
    if court:
        court_rect = Rect(plot.x0 + 4, middle + 4, centre - 4, min(middle + 20, plot.y1 - 3))
        layout.surfaces.append(("court", court_rect))
        wooded = [
            Rect(plot.x0 + 3, plot.y0 + 3, plot.x1 - 3, middle - 3),
            Rect(centre + 3, middle + 3, plot.x1 - 3, plot.y1 - 3),
        ]
    for wood in wooded:
        _scatter(layout, wood, count=int(wood.size[0] * wood.size[1] / 75), rng=rng)


def _roadside(layout: Layout, rng: _Rng) -> None:
    """Street trees whose canopies reach over the outer lanes, people on the pavements, a few kerbside things."""
    offset = MAIN_HALF_M + PAVEMENT_M / 2
    for side in (-1, 1):
        y = layout.main_y + side * offset
        for x in np.arange(6.0, WORLD_M[0] - 4, 14.0):
            if abs(x - layout.side_x) > 14 and rng.random() < 0.6:
                reach = float(rng.uniform(2.4, 4.8))
                layout.trees.append(
                    Tree(float(x + rng.normal(0, 2)), y - side * 0.4, reach, int(rng.integers(8)))
                )
        layout.walks.append((0.0, y, layout.side_x - 9, y))
        layout.walks.append((layout.side_x + 9, y, WORLD_M[0], y))
    for side in (-1, 1):
        x = layout.side_x + side * (SIDE_HALF_M + PAVEMENT_M / 2)
        layout.walks.append((x, 0.0, x, layout.main_y - offset))
        layout.walks.append((x, layout.main_y + offset, x, WORLD_M[1]))


def _scatter(layout: Layout, area: Rect, *, count: int, rng: _Rng) -> None:
    """Trees at random, not closer to one another than three quarters of their radii."""
    placed: list[Tree] = []
    for _ in range(count * 3):
        if len(placed) >= count:
            break
        tree = Tree(
            float(rng.uniform(area.x0, area.x1)),
            float(rng.uniform(area.y0, area.y1)),
            float(rng.uniform(1.5, 4.2)),
            int(rng.integers(8)),
        )
        if all((tree.x - o.x) ** 2 + (tree.y - o.y) ** 2 > (0.75 * (tree.r + o.r)) ** 2 for o in placed):
            placed.append(tree)
    layout.trees.extend(placed)
