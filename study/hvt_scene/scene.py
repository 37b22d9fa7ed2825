"""A drawn aerial scene as a continuous function of time: pictures and their exact ground truth."""

import math
from collections.abc import Collection
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.files import at_once
from hvt_common.geodesy import moved
from hvt_common.units import SECOND_NS, exact_rate
from hvt_common.values import Image, Orientation, Pose, View
from hvt_scene.appearance import Appearance
from hvt_scene.drawing.canvas import OUTLINE_POINTS
from hvt_scene.drawing.codes import RoofCode, draw_code, paint_code
from hvt_scene.drawing.foliage import Grove
from hvt_scene.drawing.ground import Ground, paint_ground
from hvt_scene.drawing.vehicles import CLASS_NAMES, draw_vehicle
from hvt_scene.truth import CodeInView, Truth
from hvt_scene.view import (
    Bgra,
    Camera,
    Floats,
    Matrix,
    blend,
    bounds,
    darken,
    near_frame,
    project,
    sprite_matrix,
    tangents,
    to_centres,
    turns,
)
from hvt_scene.world.layout import Layout, Parked, plan
from hvt_scene.world.traffic import SAMPLES_HZ, Mover, set_in_motion


class Cast:
    """Everybody, as parallel arrays: those that move first, then those that stand still. Index i has the id i + 1.

    Attributes:
        sprites: their pictures.
        class_ids: (N,) int32.
        outlines_m: (N, `OUTLINE_POINTS`, 2) convex outlines about their centres, metres, body axes.
        heights_m: (N,).
        reach_m: (N,) from the centre to the farthest point of the outline.
        codes: the texts painted on roofs, by index; empty until `paint_codes`.
    """

    def __init__(self, movers: list[Mover], parked: list[Parked], *, rng: np.random.Generator) -> None:
        everybody: list[Mover | Parked] = [*movers, *parked]
        kinds = [(one.class_name, one.small) for one in everybody]
        self.sprites = [draw_vehicle(name, rng, small=small) for name, small in kinds]
        self.class_ids = np.array([CLASS_NAMES.index(name) for name, _ in kinds], np.int32)
        self.outlines_m = np.stack([sprite.outline_m for sprite in self.sprites])
        self.heights_m = np.array([sprite.height_m for sprite in self.sprites])
        self.reach_m = np.linalg.norm(self.outlines_m, axis=2).max(1)
        self.codes: dict[int, RoofCode] = {}
        self._tracks = np.stack([mover.track for mover in movers])
        turn = np.array([one.turn for one in parked]) * (np.pi / 2)
        spots = np.array([(one.x, one.y) for one in parked])
        self._standing = np.stack([spots[:, 0], spots[:, 1], np.cos(turn), np.sin(turn)], axis=1)
        assert self.outlines_m.shape[1:] == (OUTLINE_POINTS, 2)

    def paint_codes(self, rng: np.random.Generator, *, m_per_px: float) -> None:
        """Paint a code on each roof that bears one; nothing else of the scene changes. ``m_per_px`` of the source."""
        for index, sprite in enumerate(self.sprites):
            code = draw_code(CLASS_NAMES[self.class_ids[index]], sprite, rng, m_per_px=m_per_px)
            if code is not None:
                self.codes[index] = code
                self.sprites[index] = paint_code(sprite, code)

    def places(self, t_s: float) -> Floats:
        """(N, 4) x, y, cos and sin of the heading, world metres."""
        low = min(int(t_s * SAMPLES_HZ), self._tracks.shape[1] - 2)
        share = t_s * SAMPLES_HZ - low
        moving = self._tracks[:, low] * (1 - share) + self._tracks[:, low + 1] * share
        moving[:, 2:] /= np.hypot(moving[:, 2], moving[:, 3])[:, None]
        return np.concatenate([moving, self._standing])


_ORIGIN_DEG = (52.0, 13.0)
_GROUND_M = 40.0
_MARGIN_PX = 2
_LONGEST_SHADOW_M = 4.0  # beyond a body's own reach, when deciding whether it may touch the frame


class Scene:
    """Twenty seconds over a crossing, car parks, yards and roofs; the same seed, size and look draw the same bytes.

    Time is continuous, so any frame rate may be drawn, in any order. Layout, motion and truth come from PCG64 and
    basic arithmetic and are the same everywhere; the pictures are the same wherever OpenCV's warps are.

    Args:
        seed: of layout, traffic, paint and camera.
        size: (width, height) of the pictures in pixels; the width of ground seen does not depend on it.
        appearance: light, surfaces, altitude, tilt; the default is the demo's.
        codes: paint codes on the roofs of vans, trucks and buses (`hvt_scene.drawing.codes`); the rest is the same.
    """

    class_names = CLASS_NAMES
    duration_s = 20.0

    def __init__(
        self,
        seed: int = 0,
        *,
        size: tuple[int, int] = (1920, 1080),
        appearance: Appearance | None = None,
        codes: bool = False,
    ) -> None:
        self.size = size
        self._appearance = appearance = appearance or Appearance()
        # Separate streams: a change in how a car is drawn must not move the trees.
        streams = np.random.SeedSequence(seed).spawn(6)
        plans, moves, paints, grounds, flight, letters = (
            np.random.Generator(np.random.PCG64(s)) for s in streams
        )
        layout = plan(plans, appearance)
        movers = set_in_motion(layout, appearance, rng=moves, duration_s=self.duration_s)
        self.cast = Cast(movers, layout.parked, rng=paints)
        if codes:
            self.cast.paint_codes(
                letters, m_per_px=sum(appearance.width_m) / len(appearance.width_m) / size[0]
            )
        self._camera = _flight(layout, appearance, size=size, rng=flight, duration_s=self.duration_s)
        self._grove = Grove(layout, appearance, rng=grounds)
        self._layout, self._grounds = layout, grounds

    @cached_property
    def _ground(self) -> Ground:
        """Painted for the first picture: it takes longer than all else, and truth needs none of it."""
        finest = max(min(self._appearance.width_m) / self.size[0], 0.05)
        return paint_ground(
            self._layout,
            self._appearance,
            rng=self._grounds,
            canopies=self._grove.canopies,
            m_per_px=finest,
        )

    def image(self, t_s: float, *, without: Collection[int] = ()) -> Image:
        """The picture at ``t_s`` (0…`duration_s`), (height, width, 3) uint8 BGR; ids in ``without`` are not drawn."""
        pose, chosen, places, local = self._view(t_s, without=without)
        frame = self._warp_ground(pose)
        light = self._ground.light_at(places)
        if self._appearance.shadow_strength > 0:
            self._cast_shadows(frame, chosen[light > 0.8], places[light > 0.8], local[light > 0.8])
        self._draw_bodies(frame, chosen, places, local, gains=light * self._appearance.exposure)
        self._draw_trees(frame, pose)
        return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGRA2BGR), np.uint8)

    def truth(self, t_s: float) -> Truth:
        """The objects of the picture at ``t_s``, from the same geometry that draws it."""
        _, chosen, places, local = self._view(t_s)
        pixels = project(self.cast.outlines_m[chosen] @ turns(places).transpose(0, 2, 1), local)
        limit = np.array(self.size)
        boxes = np.concatenate([np.clip(pixels.min(1), 0, limit), np.clip(pixels.max(1), 0, limit)], axis=1)
        large = ((boxes[:, 2:] - boxes[:, :2]) >= 1).all(1)
        return Truth(
            ids=chosen[large] + 1,
            boxes_source_px=boxes[large].astype(np.float32),
            class_ids=self.cast.class_ids[chosen[large]],
            visible=self._visible(_half(self.cast.outlines_m[chosen[large]]), places[large], local[large]),
        )

    def codes(self, t_s: float) -> tuple[CodeInView, ...]:
        """The codes that the picture at ``t_s`` shows, by object; none where none were painted."""
        _, chosen, places, local = self._view(t_s)
        marked = np.array([index in self.cast.codes for index in chosen.tolist()], bool)
        chosen, places, local = chosen[marked], places[marked], local[marked]
        codes = [self.cast.codes[index] for index in chosen.tolist()]
        if not codes:
            return ()
        world = turns(places).transpose(0, 2, 1)
        corners_m = np.stack([code.corners_m for code in codes])
        corners = project(corners_m @ world, local)
        centres_m = corners_m.mean(1)
        visible = self._visible(_half(corners_m - centres_m[:, None]), places, local, centres_m=centres_m)
        return tuple(
            CodeInView(index + 1, code.text, spots.astype(np.float32), float(share))
            for index, code, spots, share in zip(chosen.tolist(), codes, corners, visible, strict=True)
            if share > 0
        )

    def pose(self, t_s: float) -> Pose:
        """Where the camera is at ``t_s``; ``capture_ns`` counts from the scene's beginning.

        The scene's origin lies at 52° N, 13° E, its upper edge to the north. The errors are about those of a good
        gimbal: the picture shakes, and the pose does not say so.
        """
        place = self._camera.place(t_s)
        latitude, longitude = self.geographic(place.x_m, place.y_m)
        return Pose(
            capture_ns=round(t_s * SECOND_NS),
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=place.height_m,
            altitude_m=place.height_m + _GROUND_M,
            camera=Orientation(place.yaw_deg, place.pitch_deg, 0.0),
            platform=Orientation(place.yaw_deg, 0.0, 0.0),
            hfov_deg=place.hfov_deg,
            position_error_m=0.5,
            height_error_m=0.5,
            angle_error_deg=0.3,
        )

    def geographic(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Latitude and longitude of a place in the scene, degrees."""
        return moved(*_ORIGIN_DEG, north_m=-y_m, east_m=x_m)

    def places(self, t_s: float) -> dict[int, tuple[float, float]]:
        """X and y in metres of the middle of each object that may be in the picture, by its id in `truth`."""
        _, chosen, places, _ = self._view(t_s)
        return dict(zip((chosen + 1).tolist(), map(tuple, places[:, :2].tolist()), strict=True))

    def write_truth(self, path: Path, *, fps: float, view: View) -> None:
        """Write the truth as MOTChallenge's gt.txt, in base pixels.

        A line is ``frame,id,x,y,w,h,1,class,visibility``: frames, pixels and classes count from 1 (class 1 is the
        first name), boxes are clipped to the base frame; objects wholly outside it are left out.
        """
        rate = exact_rate(fps)
        with open(path, "w", encoding="ascii", opener=at_once) as file:
            for index in range(math.ceil(self.duration_s * rate)):
                truth = self.truth(float(index / rate))
                boxes = np.clip(view.to_base(truth.boxes_source_px), 0, view.base_size * 2)
                rows = zip(truth.ids, boxes, truth.class_ids, truth.visible, strict=True)
                for number, (x1, y1, x2, y2), kind, share in rows:
                    if x2 > x1 and y2 > y1:
                        box = f"{x1 + 1:.2f},{y1 + 1:.2f},{x2 - x1:.2f},{y2 - y1:.2f}"
                        file.write(f"{index + 1},{number},{box},1,{kind + 1},{share:.3f}\n")

    def _view(
        self, t_s: float, *, without: Collection[int] = ()
    ) -> tuple[Matrix, npt.NDArray[np.int64], Floats, Floats]:
        """The pose, and of the K objects that may touch the frame: indices, (K, 4) places, (K, 2, 3) tangents."""
        if not 0 <= t_s <= self.duration_s:
            raise ValueError(f"time {t_s} s is outside 0…{self.duration_s} s")
        pose = self._camera.pose(t_s)
        places = self.cast.places(t_s)
        local = tangents(pose, places)
        near = near_frame(local, self.cast.reach_m + _LONGEST_SHADOW_M, size=self.size)
        near[[number - 1 for number in without]] = False
        chosen = np.nonzero(near)[0]
        return pose, chosen, places[chosen], local[chosen]

    def _warp_ground(self, pose: Matrix) -> Bgra:
        matrix = to_centres(pose, m_per_px=self._ground.m_per_px)
        if self._appearance.tilt_deg:
            warped = cv2.warpPerspective(self._ground.bgra, matrix, self.size, borderMode=cv2.BORDER_REFLECT)
        else:
            warped = cv2.warpAffine(self._ground.bgra, matrix[:2], self.size, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(warped, np.uint8)

    def _cast_shadows(
        self, frame: Bgra, chosen: npt.NDArray[np.int64], places: Floats, local: Floats
    ) -> None:
        foot = self.cast.outlines_m[chosen] @ turns(places).transpose(0, 2, 1)
        offset_m = np.array(self._appearance.shadow_vector) * self.cast.heights_m[chosen, None]
        shadows = project(np.concatenate([foot, foot + offset_m[:, None]], axis=1), local)
        darken(frame, shadows, strength=self._appearance.shadow_strength)

    def _draw_bodies(
        self,
        frame: Bgra,
        chosen: npt.NDArray[np.int64],
        places: Floats,
        local: Floats,
        *,
        gains: npt.NDArray[np.float32],
    ) -> None:
        linear = local[:, :, :2] @ turns(places)
        pixels = self.cast.outlines_m[chosen] @ linear.transpose(0, 2, 1) + local[:, None, :, 2]
        boxes = bounds(pixels, size=self.size, margin_px=_MARGIN_PX).tolist()
        grains = 1 / np.sqrt(np.abs(np.linalg.det(linear)))
        for row, index in enumerate(chosen.tolist()):
            picture, *grain = self.cast.sprites[index].level(float(grains[row]))
            matrix = sprite_matrix(
                linear[row], local[row, :, 2], shape=picture.shape, grain=(grain[0], grain[1])
            )
            blend(frame, boxes[row], picture, matrix=matrix, gain=float(gains[row]))

    def _draw_trees(self, frame: Bgra, pose: Matrix) -> None:
        grove = self._grove
        local = tangents(pose, grove.places_m)
        half = 1.05 * grove.radii_m
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1.0)]) * half[:, None, None]
        boxes = bounds(project(corners, local), size=self.size, margin_px=_MARGIN_PX).tolist()
        for row, box in enumerate(boxes):
            linear = local[row, :, :2]
            picture, grain = grove.level(row, m_per_px=1 / float(np.sqrt(abs(np.linalg.det(linear)))))
            matrix = sprite_matrix(linear, local[row, :, 2], shape=picture.shape, grain=(grain, grain))
            blend(frame, box, picture, matrix=matrix, gain=self._appearance.exposure)

    def _visible(
        self, half_m: Floats, places: Floats, local: Floats, *, centres_m: Floats | None = None
    ) -> npt.NDArray[np.float32]:
        """(K,) share of each rectangle in the frame and not under a crown, from a grid of points over it.

        ``half_m`` (K, 2) are half its sides and ``centres_m`` (K, 2) its middle (None: the origin), in body axes.
        """
        grid = np.stack(np.meshgrid(np.linspace(-1, 1, 13), np.linspace(-1, 1, 9)), axis=-1).reshape(1, -1, 2)
        inner = grid * (0.92 * half_m[:, None])
        if centres_m is not None:
            inner = inner + centres_m[:, None]
        points = inner @ turns(places).transpose(0, 2, 1)
        pixels = project(points, local)
        inside = ((pixels >= 0) & (pixels < np.array(self.size))).all(2)
        covered = self._grove.cover_at(points + places[:, None, :2])
        return np.asarray((inside * (1 - covered)).mean(1), np.float32)


def _half(bodies_m: Floats) -> Floats:
    """(K, 2) half the sides of the rectangles about the origin that hold (K, M, 2) points."""
    return np.asarray(np.abs(bodies_m).max(1), np.float64)


def _flight(
    layout: Layout,
    appearance: Appearance,
    *,
    size: tuple[int, int],
    rng: np.random.Generator,
    duration_s: float,
) -> Camera:
    """A pan along the main road past the crossing, eastwards or westwards."""
    reach = float(rng.uniform(46, 54))
    ends = [(layout.side_x - reach, layout.main_y - 7.0), (layout.side_x + reach * 0.9, layout.main_y + 6.0)]
    if rng.random() < 0.5:
        ends.reverse()
    first, second, third, fourth = (float(phase) for phase in rng.uniform(0, 6.28, 4))
    return Camera(size, appearance, duration_s, ends[0], ends[1], (first, second, third, fourth))
