"""Moving objects: vehicles that follow their leader and the lights, cars that circle car parks, people on foot."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_scene.appearance import Appearance
from hvt_scene.world.layout import MAIN_HALF_M, PAVEMENT_M, SIDE_HALF_M, WORLD_M, Layout

SAMPLES_HZ = 20
"""Positions are computed at this rate and interpolated between."""

_WARM_UP_S = 15.0  # simulated before the clip begins, so that queues have formed
_OUTSIDE_M = 25.0

_Rng = np.random.Generator
Places = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Mover:
    """A class and its track: (T, 4) float64 x, y, cos and sin of the heading at `SAMPLES_HZ` from time 0."""

    class_name: str
    small: bool
    track: Places


@dataclass(slots=True)
class _Driver:
    class_name: str
    s_m: float
    v_mps: float
    desired_mps: float
    length_m: float


@dataclass(frozen=True, slots=True)
class _Lane:
    """A straight lane: where s = 0 lies, its direction, length, where to stop, which light, how fast."""

    origin: tuple[float, float]
    direction: tuple[int, int]
    length_m: float
    stop_m: float
    main: bool
    desired_mps: float


def set_in_motion(layout: Layout, appearance: Appearance, *, rng: _Rng, duration_s: float) -> list[Mover]:
    """Simulate everybody for the whole clip; the same generator state gives the same tracks."""
    movers: list[Mover] = []
    for lane in _lanes(layout):
        movers += _drive(lane, appearance=appearance, rng=rng, duration_s=duration_s)
    for loop in layout.loops:
        movers.append(_circle(loop, rng=rng, duration_s=duration_s))
    for walk in layout.walks:
        length = math.dist(walk[:2], walk[2:])
        movers += [_walk(walk, rng=rng, duration_s=duration_s) for _ in range(1 + int(length // 22))]
    movers += _crossers(layout, rng=rng, duration_s=duration_s)
    return movers


def _lanes(layout: Layout) -> list[_Lane]:
    """Traffic keeps right; y points south, so eastbound lanes lie south of the middle."""
    wide, deep = WORLD_M
    out = _OUTSIDE_M
    back = SIDE_HALF_M + PAVEMENT_M + 2.0
    lanes = []
    for offset, desired in ((1.8, 14.0), (5.3, 12.0)):
        y = layout.main_y
        lanes.append(
            _Lane((-out, y + offset), (1, 0), wide + 2 * out, layout.side_x - back + out, True, desired)
        )
        stop = wide - layout.side_x - back + out
        lanes.append(_Lane((wide + out, y - offset), (-1, 0), wide + 2 * out, stop, True, desired))
    back = MAIN_HALF_M + PAVEMENT_M + 2.0
    x = layout.side_x
    lanes.append(_Lane((x - 2.0, -out), (0, 1), deep + 2 * out, layout.main_y - back + out, False, 10.0))
    lanes.append(
        _Lane((x + 2.0, deep + out), (0, -1), deep + 2 * out, deep - layout.main_y - back + out, False, 10.0)
    )
    return lanes


def _green(t_s: float, *, main: bool) -> bool:
    """The lights of the crossing: the main road has -15…5 s and from 17 s on, the side road 7…15 s."""
    return (t_s < 5 or t_s >= 17) if main else 7 <= t_s < 15


def _road_class(draw: float) -> tuple[str, float]:
    table = ((0.50, "car", 4.6), (0.67, "van", 5.4), (0.82, "truck", 9.0), (0.90, "bus", 12.0))
    return next(((name, length) for bound, name, length in table if draw < bound), ("motor", 2.2))


def _drive(lane: _Lane, *, appearance: Appearance, rng: _Rng, duration_s: float) -> list[Mover]:
    """A column of vehicles along one lane, by the Intelligent Driver Model (Treiber et al., 2000)."""
    column: list[_Driver] = []
    s = lane.length_m - float(rng.uniform(0, appearance.traffic_gap_m))
    reach = -lane.desired_mps * (duration_s + _WARM_UP_S)
    while s > reach:
        name, length = _road_class(float(rng.random()))
        desired = lane.desired_mps * float(rng.uniform(0.88, 1.12))
        column.append(_Driver(name, s, desired, desired, length))
        s -= length + 6.0 + float(rng.exponential(max(appearance.traffic_gap_m - 6.0, 1.0)))
    steps = round((duration_s + _WARM_UP_S) * SAMPLES_HZ) + 1
    history = np.empty((steps, len(column)))
    for step in range(steps):
        history[step] = [driver.s_m for driver in column]
        green = _green(step / SAMPLES_HZ - _WARM_UP_S, main=lane.main)
        _advance(column, stop_m=None if green else lane.stop_m)
    history = history[round(_WARM_UP_S * SAMPLES_HZ) :]
    movers = []
    for driver, places in zip(column, history.T, strict=True):
        if places[-1] < 0 or places[0] > lane.length_m:
            continue
        side = float(rng.normal(0, 0.5 if driver.class_name == "motor" else 0.12))
        dx, dy = lane.direction
        track = np.stack(
            [
                lane.origin[0] + dx * places - dy * side,
                lane.origin[1] + dy * places + dx * side,
                np.full_like(places, dx),
                np.full_like(places, dy),
            ],
            axis=1,
        )
        movers.append(Mover(driver.class_name, small=False, track=track))
    return movers


def _advance(column: list[_Driver], *, stop_m: float | None) -> None:
    """One step of 1 / `SAMPLES_HZ` s: each follows the one ahead and, at red, the stop line."""
    step_s = 1 / SAMPLES_HZ
    speed_up, brake, headway_s, standstill_m = 1.6, 2.2, 1.1, 2.2
    ahead: tuple[float, float] | None = None  # rear bumper and speed of the one ahead
    for driver in column:
        front, v = driver.s_m + driver.length_m / 2, driver.v_mps
        gaps = [] if ahead is None else [(ahead[0] - front, v - ahead[1])]
        if stop_m is not None and stop_m - front > v * v / (2 * 3.5):  # who cannot stop drives on
            gaps.append((stop_m - front + standstill_m - 0.5, v))
        interaction = 0.0
        for gap, closing in gaps:
            desired_gap = standstill_m + max(
                0.0, v * headway_s + v * closing / (2 * math.sqrt(speed_up * brake))
            )
            interaction = max(interaction, desired_gap / max(gap, 0.3))
        ratio = v / driver.desired_mps
        accel = speed_up * (1 - ratio * ratio * ratio * ratio - interaction * interaction)
        ahead = (driver.s_m - driver.length_m / 2, v)
        driver.v_mps = max(0.0, v + max(accel, -7.0) * step_s)
        driver.s_m += (v + driver.v_mps) / 2 * step_s


def _circle(loop: list[tuple[float, float]], *, rng: _Rng, duration_s: float) -> Mover:
    """A car that looks for a stall: round the aisles at walking to cycling speed, cutting no corner."""
    corners = np.array([*loop, loop[0]])
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    s = float(rng.uniform(0, lengths[-1])) + float(rng.uniform(3.0, 4.5)) * _times(duration_s)

    def at(distance: Places) -> Places:
        wrapped = distance % lengths[-1]
        return np.stack([np.interp(wrapped, lengths, corners[:, axis]) for axis in (0, 1)], axis=1)

    # The mean of three points of the polyline rounds its corners; the outer two give the heading.
    rear, middle, front = at(s - 2.6), at(s), at(s + 2.6)
    chord = front - rear
    heading = chord / np.maximum(np.hypot(*chord.T), 1e-6)[:, None]
    kind = "car" if rng.random() < 0.6 else "van"
    return Mover(kind, small=True, track=np.concatenate([(rear + middle + front) / 3, heading], axis=1))


def _walk(walk: tuple[float, float, float, float], *, rng: _Rng, duration_s: float) -> Mover:
    """Somebody who walks along a footpath, one in five standing still."""
    start, end = np.array(walk[:2]), np.array(walk[2:])
    if rng.random() < 0.5:
        start, end = end, start
    length = float(np.hypot(*(end - start)))
    direction = (end - start) / length
    pace = 0.0 if rng.random() < 0.2 else float(rng.uniform(0.9, 1.7))
    s = float(rng.uniform(0, max(length - pace * duration_s, 1.0))) + pace * _times(duration_s)
    s = np.minimum(s, length)
    aside = float(rng.normal(0, 0.4)) + 0.08 * np.sin(0.7 * s + float(rng.uniform(0, 6)))
    normal = np.array([-direction[1], direction[0]])
    places = start + s[:, None] * direction + aside[:, None] * normal
    return Mover("pedestrian", small=True, track=_heading(places, direction))


def _crossers(layout: Layout, *, rng: _Rng, duration_s: float) -> list[Mover]:
    """People on the zebra crossings over the side road, while its traffic waits."""
    movers = []
    times = _times(duration_s)
    for _ in range(6):
        side = 1 if rng.random() < 0.5 else -1
        y = layout.main_y + side * (MAIN_HALF_M + 1.7) + float(rng.normal(0, 0.5))
        way = 1 if rng.random() < 0.5 else -1
        reach = SIDE_HALF_M + 4.0 + float(rng.uniform(0, 4))
        moving_s = np.clip(times - float(rng.uniform(-4, -0.5)), 0, 2 * reach / 1.6)
        x = layout.side_x + way * (-reach + 1.6 * moving_s)
        places = np.stack([x, np.full_like(x, y)], axis=1)
        movers.append(Mover("pedestrian", small=True, track=_heading(places, np.array([way, 0.0]))))
    return movers


def _heading(places: Places, direction: Places) -> Places:
    return np.concatenate([places, np.broadcast_to(direction, places.shape)], axis=1)


def _times(duration_s: float) -> Places:
    return np.arange(round(duration_s * SAMPLES_HZ) + 1) / SAMPLES_HZ
