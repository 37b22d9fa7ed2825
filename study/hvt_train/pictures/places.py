"""Places that the demo scene does not have: any ground, rows as tight as in a real car park, any tilt and lean.

A place is drawn as one large picture from which training cuts many views. The camera is a pinhole over the point
``nadir``; a point z metres high is drawn ``z * lean`` pixels away from its foot, away from the nadir, and the
ground is foreshortened along the direction of the tilt. That is exact for a distant camera and near enough for ours.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes, Image
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.pictures.placement import Thing, settle
from hvt_train.pictures.surfaces import Surface, paint_surface

_Rng = np.random.Generator
_SHIFT = 4


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture with its objects, as parallel arrays."""

    image_bgr: Image
    boxes_px: Boxes
    """(N, 4) float32 in pixels of the picture, tight around the body, clipped to the picture."""
    class_ids: npt.NDArray[np.int32]
    """(N,) index into the scene's class names."""
    visible: npt.NDArray[np.float32]
    """(N,) share of the body that is in the picture and not hidden, 0…1."""


def draw_place(rng: _Rng, *, size: int = 1280, aslant: bool = False) -> Picture:
    """Draw one place of ``size`` by ``size`` pixels; the same generator state draws the same bytes.

    ``aslant`` is as from a far camera at 45 to 74 degrees from straight down: cars of 25 to 100 pixels.
    """
    view = _View.aslant(rng, size=size) if aslant else _View.random(rng, size=size)
    surface = Surface(view.to_px, size=size, px_per_m=view.px_per_m, half_m=view.half_m)
    things = settle(rng, surface)
    image = paint_surface(surface, rng)
    return _Stage(image, view).show(things, rng)


@dataclass(frozen=True, slots=True)
class _View:
    """The camera and the sun."""

    size: int
    px_per_m: float
    spin: float
    tilt: float
    up: npt.NDArray[np.float64]
    height_px: float
    centre: npt.NDArray[np.float64]
    sun: npt.NDArray[np.float64]
    ambient: float
    shadow: float

    @classmethod
    def random(cls, rng: _Rng, *, size: int) -> _View:
        oblique = rng.random() < 0.35
        tilt = math.radians(rng.uniform(12, 55) if oblique else rng.uniform(0, 10))
        way = rng.uniform(-math.pi, math.pi) if not oblique else -math.pi / 2 + rng.normal(0, 0.3)
        azimuth, per_m = rng.uniform(-math.pi, math.pi), rng.uniform(0.1, 1.8)
        sun = np.array([-per_m * math.cos(azimuth), -per_m * math.sin(azimuth), 1.0])
        return cls(
            size=size,
            px_per_m=float(np.exp(rng.uniform(math.log(8), math.log(30)))),
            spin=float(rng.uniform(-math.pi, math.pi)),
            tilt=tilt,
            up=np.array([math.cos(way), math.sin(way)]),
            height_px=float(rng.uniform(0.8, 2.2)) * size,
            centre=np.array([size / 2, size / 2]) + rng.normal(0, size / 5, 2),
            sun=sun / np.linalg.norm(sun),
            ambient=float(rng.uniform(0.35, 0.9)),
            shadow=float(rng.uniform(0.1, 0.75)) if rng.random() < 0.85 else 0.0,
        )

    @classmethod
    def aslant(cls, rng: _Rng, *, size: int) -> _View:
        way = -math.pi / 2 + rng.normal(0, 0.12)
        return dataclasses.replace(
            cls.random(rng, size=size),
            px_per_m=float(np.exp(rng.uniform(math.log(5), math.log(22)))),
            tilt=math.radians(rng.uniform(45, 74)),
            up=np.array([math.cos(way), math.sin(way)]),
            height_px=float(rng.uniform(1.5, 6)) * size,
        )

    @property
    def half_m(self) -> float:
        """Half the side of the square of world that the picture can show."""
        return 0.75 * self.size / self.px_per_m / math.cos(self.tilt)

    def linear(self, heading: float = 0.0) -> npt.NDArray[np.float64]:
        """(2, 2) metres in axes turned by ``heading`` to pixels on the ground."""
        angle = self.spin + heading
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        flatten = np.eye(2) - (1 - math.cos(self.tilt)) * np.outer(self.up, self.up)
        return np.asarray(self.px_per_m * flatten @ turn, np.float64)

    def to_px(self, points_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(points_m @ self.linear().T + self.size / 2, np.float64)

    def lean(self, foot_px: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(2,) pixels by which a point one metre above ``foot_px`` is displaced."""
        lean_m = math.sin(self.tilt) * self.up + (foot_px - self.centre) / self.height_px
        return np.asarray(lean_m * self.px_per_m, np.float64)

    def shade_px(self) -> npt.NDArray[np.float64]:
        """(2,) pixels of shadow on the ground per metre of height; the sun's azimuth is that of the picture."""
        flatten = np.eye(2) - (1 - math.cos(self.tilt)) * np.outer(self.up, self.up)
        return np.asarray(-self.px_per_m * flatten @ self.sun[:2] / self.sun[2], np.float64)

    def distance(self, foot_px: npt.NDArray[np.float64]) -> float:
        """How far from the camera's foot, for the order of drawing."""
        nadir = self.centre - self.up * math.sin(self.tilt) * self.height_px
        return float(np.linalg.norm(foot_px - nadir))


class _Stage:
    """The picture while things are put on it."""

    def __init__(self, image: Image, view: _View) -> None:
        self._image = image
        self._view = view
        self._owner = np.full(image.shape[:2], -1, np.int16)

    def show(self, things: list[Thing], rng: _Rng) -> Picture:
        view = self._view
        feet = [view.to_px(np.array([thing.x, thing.y])) for thing in things]
        self._shade(things, feet, rng)
        order = sorted(range(len(things)), key=lambda index: -view.distance(feet[index]))
        hulls: dict[int, npt.NDArray[np.float64]] = {}
        for index in order:
            hulls[index] = self._draw(things[index], feet[index], index)
        return self._picture(things, hulls)

    def _picture(self, things: list[Thing], hulls: dict[int, npt.NDArray[np.float64]]) -> Picture:
        size = self._view.size
        drawn = np.bincount(self._owner.ravel() + 1, minlength=len(things) + 1)[1:]
        rows = [i for i, thing in enumerate(things) if thing.solid.class_name in CLASS_NAMES]
        boxes = np.array([(*hulls[i].min(0), *hulls[i].max(0)) for i in rows], np.float32).reshape(-1, 4)
        area = np.array([cv2.contourArea(hulls[i].astype(np.float32)) for i in rows])
        boxes = boxes.clip(0, size)
        large = ((boxes[:, 2:] - boxes[:, :2]) >= 1).all(1)
        visible = np.minimum(drawn[rows] / np.maximum(area, 1), 1).astype(np.float32)
        kinds = np.array([CLASS_NAMES.index(things[i].solid.class_name) for i in rows], np.int32)
        return Picture(self._image, boxes[large], kinds[large], visible[large])

    def _shade(self, things: list[Thing], feet: list[npt.NDArray[np.float64]], rng: _Rng) -> None:
        """Cast shadows, and a little darkness right around whatever touches the ground."""
        view = self._view
        cast = np.zeros(self._image.shape[:2], np.uint8)
        near = np.zeros(self._image.shape[:2], np.uint8)
        lean_m = view.shade_px()
        for thing, foot in zip(things, feet, strict=True):
            ground = thing.solid.foot_m @ view.linear(thing.heading).T + foot
            both = np.concatenate([ground, ground + lean_m * thing.solid.height_m * 0.92])
            _fill(cast, cv2.convexHull(both.astype(np.float32))[:, 0], 255)
            _fill(near, (ground - foot) * 1.1 + foot, 255)
        blur = float(rng.uniform(0.5, 3.0))
        dark = cv2.GaussianBlur(cast, (0, 0), blur).astype(np.float32) * (view.shadow / 255)
        soft = cv2.GaussianBlur(near, (0, 0), 0.25 * view.px_per_m).astype(np.float32)
        light = (1 - dark) * (1 - soft * (float(rng.uniform(0.0, 0.5)) / 255))
        tint = 1 - (1 - light[..., None]) * np.array([0.9, 0.96, 1.0], np.float32)
        self._image[:] = (self._image * tint).astype(np.uint8)

    def _draw(self, thing: Thing, foot: npt.NDArray[np.float64], number: int) -> npt.NDArray[np.float64]:
        view = self._view
        lean, linear = view.lean(foot), view.linear(thing.heading)
        lean_m = linear.T @ lean
        parts = sorted(thing.solid.parts, key=lambda part: -part.x * lean_m[0])
        points = np.concatenate([corners for part in parts for corners in part.points_m])
        pixels = points[:, :2] @ linear.T + points[:, 2:] * lean + foot
        hull = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)
        if (hull.max(0) < 0).any() or (hull.min(0) > view.size).any():
            return hull
        _fill(self._owner, hull, number)
        start = 0
        for part in parts:
            for corners, colour, matt in zip(part.points_m, part.colours, part.matt, strict=True):
                face = pixels[start : start + len(corners)]
                start += len(corners)
                if _faces_back(face):
                    continue
                light = 1.0 if matt else self._light(corners, thing.heading)
                _fill(self._image, face, tuple(min(255.0, c * light) for c in colour))
        return hull

    def _light(self, corners: npt.NDArray[np.float64], heading: float) -> float:
        """Lambert's law with skylight, relative to a level surface."""
        view = self._view
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= max(float(np.linalg.norm(normal)), 1e-9)
        angle = heading + view.spin
        x = normal[0] * math.cos(angle) - normal[1] * math.sin(angle)
        y = normal[0] * math.sin(angle) + normal[1] * math.cos(angle)
        direct = max(0.0, x * view.sun[0] + y * view.sun[1] + normal[2] * view.sun[2])
        level = view.ambient + (1 - view.ambient) * view.sun[2]
        return float((view.ambient + (1 - view.ambient) * direct) / level)


def _faces_back(face: npt.NDArray[np.float64]) -> bool:
    x, y = face[:, 0], face[:, 1]
    return bool((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() <= 0)


def _fill(image: npt.NDArray[Any], points_px: npt.NDArray[Any], colour: object) -> None:
    fixed = np.round((points_px - 0.5) * (1 << _SHIFT)).astype(np.int32)
    soft = cv2.LINE_AA if image.dtype == np.uint8 else cv2.LINE_8
    cv2.fillConvexPoly(image, fixed, colour, soft, _SHIFT)  # type: ignore[call-overload]
