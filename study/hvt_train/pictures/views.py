"""Training views: a random window of a pool picture at a random scale, damaged as cameras and codecs do it."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes, Image
from hvt_train.pictures.kinds import BIKE, ID
from hvt_train.pictures.places import Picture

_Rng = np.random.Generator
_FILL = 114
_KINDS = {
    "demo": (0.6, 0.3, 0.2, 2.6),
    "base": (0.4, 0.1, 0.25, 1.3),
    "thin": (0.2, 0.0, 0.8, 1.3),
    "codes": (0.2, 0.0, 0.6, 1.4),
    "place": (1.0, 0.6, 0.16, 2.2),
    "kit": (0.6, 0.15, 0.25, 2.6),
    "road": (0.7, 0.2, 0.11, 3.8),
    "thermal": (0.5, 0.15, 0.5, 1.9),
    "street": (0.5, 0.2, 0.3, 3.5),
    "camera": (0.5, 0.15, 0.5, 4.0),
    "water": (0.8, 0.2, 0.3, 2.2),
    "aslant": (1.0, 0.4, 0.25, 1.6),
    "field": (0.8, 0.2, 0.2, 1.6),
}
"""Strength of the damage and how often the codec is bad (base, thin and most codes pictures have been through
x265); least and greatest scale."""
_STRAIGHT_DOWN = frozenset({"kit", "road", "field", "water"})
"""Have no up; the others are aslant, at least in part, and mostly left upright."""
_UPRIGHT = frozenset({"street", "camera", "aslant"})
_RIDERS = (ID["pedestrian"], ID["bicycle"], ID["motor"], BIKE)
_SPECKLED = 0.4
"""How often small blobs lie about: stones, litter, chipped paint, which are no people."""
_FLATTENED = frozenset({"kit", "road", "thermal", "place", "base", "demo", "codes"})
"""May be shown as flatter than they are, as ground is that a camera sees aslant."""
_PITTED = {"kit": 0.9, "road": 0.9, "place": 0.9, "demo": 0.5, "base": 0.5, "thin": 0.5, "codes": 0.4}
"""How often there are bollards, plants and the pits of young trees, which from above are as large as people."""


@dataclass(frozen=True, slots=True)
class View:
    """One training example."""

    image_bgr: Image
    boxes_px: Boxes
    class_ids: npt.NDArray[np.int32]
    """-1 where something is there that is too hidden or too small to be asked for: neither object nor background."""


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """How views are cut."""

    side: int = 416
    shares: tuple[tuple[str, float], ...] = (
        *(("demo", 0.03), ("base", 0.07), ("thin", 0.06), ("codes", 0.14), ("place", 0.05), ("aslant", 0.09)),
        *(("kit", 0.08), ("road", 0.06), ("field", 0.03), ("thermal", 0.16)),
        *(("street", 0.06), ("camera", 0.08), ("water", 0.04)),
    )
    """How often each kind of picture is taken."""
    tiled: float = 0.3
    """How often a view is put together of four or nine smaller ones: small objects stand among others."""
    least_visible: float = 0.3
    least_side_px: float = 4.0
    """Least longer side of a box, in pixels of the view."""


class ViewSource:
    """Draws views from a pool (`hvt_train.pictures.pool.fill_pool`), without end."""

    def __init__(self, pool: list[Path], *, seed: int, settings: ViewSettings) -> None:
        self._kinds = [name for name, _ in settings.shares]
        self._files = {kind: [p for p in pool if p.name.startswith(kind)] for kind in self._kinds}
        shares = np.array([share if self._files[kind] else 0.0 for kind, share in settings.shares])
        self._shares = shares / shares.sum()
        self._rng = np.random.default_rng(seed)
        self._settings = settings

    def next(self) -> View:
        side = self._settings.side
        if self._rng.random() >= self._settings.tiled:
            return self._view(side, 1.0)
        count = 2 if self._rng.random() < 0.7 else 3
        part = side // count
        image = np.full((side, side, 3), _FILL, np.uint8)
        boxes, kinds = [], []
        for number in range(count * count):
            view = self._view(part, float(self._rng.uniform(0.4, 1.0)))
            y, x = (part * place for place in divmod(number, count))
            image[y : y + part, x : x + part] = view.image_bgr
            boxes.append(view.boxes_px + np.array([x, y, x, y], np.float32))
            kinds.append(view.class_ids)
        return View(image, np.concatenate(boxes).astype(np.float32), np.concatenate(kinds))

    def _view(self, side: int, smaller: float) -> View:
        """One window of ``side`` pixels; its objects are shown ``smaller`` than alone."""
        rng = self._rng
        kind = str(rng.choice(self._kinds, p=self._shares))
        files = self._files[kind]
        picture = read_picture(files[int(rng.integers(len(files)))])
        flat = float(rng.uniform(0.4, 1.0)) if kind in _FLATTENED and rng.random() < 0.3 else 1.0
        view = self._cropped(picture, _scale(kind, rng) * smaller, flat, side)
        view = _turned(
            view, rng, upright=kind in _UPRIGHT or (kind not in _STRAIGHT_DOWN and rng.random() < 0.6)
        )
        tinted = kind == "thermal" and rng.random() < 0.3
        if kind == "thermal" and rng.random() < 0.4:  # cameras show heat black or white
            view = View(255 - view.image_bgr, view.boxes_px, view.class_ids)
        if tinted:  # as a picture in colour: vehicles keep their shape, a person is a spot like others
            people = np.isin(view.class_ids, _RIDERS)
            view = View(
                _tinted(view.image_bgr, rng),
                view.boxes_px,
                np.where(people, -1, view.class_ids).astype(np.int32),
            )
        if kind not in {"thermal", "street", "camera"} and rng.random() < _SPECKLED:
            view = View(_speckled(view.image_bgr, rng), view.boxes_px, view.class_ids)
        if rng.random() < _PITTED.get(kind, 0.0):
            view = View(_pitted(view.image_bgr, rng), view.boxes_px, view.class_ids)
        strength, compress, *_ = _KINDS[kind]
        image = degrade(view.image_bgr, rng, strength=strength, compress=compress)
        if (
            kind == "thermal" and not tinted
        ):  # alone without colour: a white blob is a person there, a stone elsewhere
            image = np.repeat(image[..., 1:2], 3, axis=2)
        return View(image, view.boxes_px, view.class_ids)

    def _cropped(self, picture: Picture, scale: float, flat: float, side: int) -> View:
        """A square view, usually around an object, every class as often; ``flat`` squeezes its height."""
        rng = self._rng
        high, wide = picture.image_bgr.shape[:2]
        window = side / np.array([scale, scale * flat])
        if len(picture.boxes_px) and rng.random() < 0.7:
            _, which, counts = np.unique(picture.class_ids, return_inverse=True, return_counts=True)
            weights = 1.0 / counts[which] * np.where(picture.class_ids == -1, 0.2, 1.0)
            box = picture.boxes_px[rng.choice(len(weights), p=weights / weights.sum())]
            middle = (box[:2] + box[2:]) / 2 + rng.uniform(-0.4, 0.4, 2) * window
        else:
            middle = rng.uniform(0, (wide, high))
        slack = np.array([wide, high]) - window  # negative where the picture is smaller than the window
        margin = rng.uniform(0, 0.06, 2) * window
        low = np.clip(middle - window / 2, np.minimum(slack, 0) - margin, np.maximum(slack, 0) + margin)
        return self._window(picture, low, window, side)

    def _window(
        self, picture: Picture, low: npt.NDArray[np.float64], window: npt.NDArray[np.float64], side: int
    ) -> View:
        settings = self._settings
        x0, y0 = (round(float(v)) for v in low)
        reach_x, reach_y = (max(1, round(float(v))) for v in window)
        image = np.full((reach_y, reach_x, 3), _FILL, np.uint8)
        high, wide = picture.image_bgr.shape[:2]
        left, top, right, bottom = max(x0, 0), max(y0, 0), min(x0 + reach_x, wide), min(y0 + reach_y, high)
        if right > left and bottom > top:
            image[top - y0 : bottom - y0, left - x0 : right - x0] = picture.image_bgr[top:bottom, left:right]
        exact = side / np.array([reach_x, reach_y, reach_x, reach_y])
        how = cv2.INTER_AREA if exact.min() < 0.6 else cv2.INTER_LINEAR
        small = cv2.resize(image, (side, side), interpolation=how)
        whole = (picture.boxes_px - np.array([x0, y0, x0, y0])) * exact
        boxes = whole.clip(0, side).astype(np.float32)
        sides = boxes[:, 2:] - boxes[:, :2]
        area = np.maximum((whole[:, 2:] - whole[:, :2]).prod(1), 1e-6)
        seen = picture.visible * sides.prod(1) / area
        valid = (sides > 1).all(1)
        ignored = (seen < settings.least_visible) | (sides.max(1) < settings.least_side_px)
        kinds = np.where(ignored, -1, picture.class_ids).astype(np.int32)
        return View(np.asarray(small, np.uint8), boxes[valid], kinds[valid])


def read_picture(path: Path) -> Picture:
    with np.load(path) as file:
        return Picture(file["image"], file["boxes"], file["classes"], file["visible"])


def _scale(kind: str, rng: _Rng) -> float:
    """Pixels of the view per pixel of the picture; a car is 35…85 px long in a demo picture, 36…135 in a place."""
    draw = rng.random()
    if kind == "base" and draw < 0.65:  # as the pipeline shows it: whole, or halved to 640 pixels
        return 1.0 if draw < 0.4 else 0.5
    if kind == "demo" and draw < 0.45:
        return float(rng.uniform(0.8, 1.25))
    *_, low, high = _KINDS[kind]
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _turned(view: View, rng: _Rng, *, upright: bool) -> View:
    """One of the eight ways to lay a square, or of the two that are ``upright``."""
    image, boxes, side = view.image_bgr, view.boxes_px, len(view.image_bgr)
    if rng.random() < 0.5:
        image, boxes = image[:, ::-1], boxes[:, [2, 1, 0, 3]] * (-1, 1, -1, 1) + (side, 0, side, 0)
    if not upright and rng.random() < 0.5:
        image, boxes = image[::-1], boxes[:, [0, 3, 2, 1]] * (1, -1, 1, -1) + (0, side, 0, side)
    if not upright and rng.random() < 0.5:
        image, boxes = image.transpose(1, 0, 2), boxes[:, [1, 0, 3, 2]]
    return View(np.ascontiguousarray(image), boxes.astype(np.float32), view.class_ids)


def degrade(image_bgr: Image, rng: _Rng, *, strength: float, compress: float) -> Image:
    """Light, lens, sensor and codec; ``compress`` is how often the codec is bad."""
    image = image_bgr
    if rng.random() < 0.5 * strength:
        image = _blurred(image, rng)
    image = _lit(image, rng, strength)
    if rng.random() < 0.2 * strength:
        soft = cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.8, 2)))
        gain = float(rng.uniform(0.3, 1.5))
        image = np.asarray(cv2.addWeighted(image, 1 + gain, soft, -gain, 0), np.uint8)
    if rng.random() < 0.4 * strength:
        image = _noisy(image, rng)
    if rng.random() < 0.06 * strength:
        image = _lettered(image, rng)
    if rng.random() < compress:
        quality = int(np.exp(rng.uniform(np.log(12), np.log(90))))
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        image = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(image)


def _tinted(image: Image, rng: _Rng) -> Image:
    """A grey picture with a colour for its dark, one for its middle and one for its bright."""
    stops = rng.uniform(0, 255, (3, 3)) * 0.5 + np.array([30.0, 85.0, 150.0])[:, None] * 0.8
    table = np.stack([np.interp(np.arange(256), (0, 128, 255), stops[:, one]) for one in range(3)], axis=1)
    return np.asarray(cv2.LUT(image, table.clip(0, 255).astype(np.uint8)[None]), np.uint8)


def _blurred(image: Image, rng: _Rng) -> Image:
    kind = rng.integers(3)
    if kind == 0:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), float(rng.uniform(0.3, 1.5))), np.uint8)
    if kind == 1:  # motion
        length, angle = int(rng.integers(2, 8)), rng.uniform(0, math.pi)
        kernel = np.zeros((9, 9), np.float32)
        reach = np.array([math.cos(angle), math.sin(angle)]) * length / 2
        ends = [tuple(round(float(v)) for v in 4 + sign * reach) for sign in (-1, 1)]
        cv2.line(kernel, ends[0], ends[1], 1.0)
        return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)
    shrink, side = float(rng.uniform(0.4, 0.9)), len(image)  # a camera of fewer pixels
    small = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    how = cv2.INTER_LINEAR if rng.random() < 0.5 else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(small, (side, side), interpolation=how), np.uint8)


def _lit(image: Image, rng: _Rng, strength: float) -> Image:
    """One table a channel: gain, contrast, gamma, white balance; then saturation; sometimes grey or negative haze."""
    levels = np.arange(256, dtype=np.float64) / 255
    gamma, gain = math.exp(rng.normal(0, 0.28 * strength)), math.exp(rng.normal(0, 0.15 * strength))
    pivot = rng.uniform(0.3, 0.7)
    contrast = math.exp(rng.normal(0, 0.22 * strength))
    haze, air = (
        (rng.uniform(0, 0.45), rng.uniform(0.5, 0.95)) if rng.random() < 0.2 * strength else (0.0, 1.0)
    )
    tables = []
    for _ in range(3):
        curve = (levels**gamma * gain * math.exp(rng.normal(0, 0.05 * strength)) - pivot) * contrast + pivot
        tables.append((curve * (1 - haze) + haze * air).clip(0, 1) * 255)
    table = np.stack(tables, axis=1).astype(np.uint8)[None]
    image = np.asarray(cv2.LUT(image, table), np.uint8)
    if rng.random() < 0.5:
        grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
        colour = float(rng.uniform(0.3, 1.5))
        image = np.asarray(cv2.addWeighted(image, colour, grey, 1 - colour, 0), np.uint8)
    if rng.random() < 0.2 * strength:  # light that falls off across the picture
        side = len(image)
        slope = np.linspace(rng.uniform(0.6, 1.3), rng.uniform(0.6, 1.3), side, dtype=np.float32)
        ramp = slope[:, None] if rng.random() < 0.5 else slope[None]
        image = np.asarray((image * ramp[..., None]).clip(0, 255), np.uint8)
    return image


def _noisy(image: Image, rng: _Rng) -> Image:
    sigma = float(rng.uniform(1, 12))
    side = len(image)
    grain = rng.standard_normal((side, side, 1 if rng.random() < 0.5 else 3), np.float32) * sigma
    if rng.random() < 0.3:
        grain = np.asarray(cv2.GaussianBlur(grain, (0, 0), 0.8), np.float32).reshape(side, side, -1) * 2
    return np.asarray((image + grain).clip(0, 255), np.uint8)


def _speckled(image: Image, rng: _Rng) -> Image:
    """Blobs of 1 to 6 pixels, lighter or darker than the ground, without a shadow."""
    side, layer = len(image), np.zeros(image.shape[:2], np.float32)
    bright = rng.random() < 0.75
    for _ in range(int(rng.integers(4, 60))):
        middle = (int(rng.integers(0, side)), int(rng.integers(0, side)))
        axes = (int(rng.integers(0, 4)), int(rng.integers(0, 4)))
        depth = float(rng.uniform(15, 120)) * (1 if bright or rng.random() < 0.2 else -1)
        cv2.ellipse(layer, middle, axes, float(rng.uniform(0, 180)), 0, 360, depth, -1)
    soft = np.asarray(cv2.GaussianBlur(layer, (0, 0), float(rng.uniform(0.4, 1.0))), np.float32)
    return np.asarray((image + soft[..., None]).clip(0, 255), np.uint8)


def _pitted(image: Image, rng: _Rng) -> Image:
    """Ragged spots of up to 16 pixels, mostly darker and browner than the ground, some with a tree's thin shadow."""
    side, spots, lines = (
        len(image),
        np.zeros(image.shape[:2], np.float32),
        np.zeros(image.shape[:2], np.float32),
    )
    size, light = float(np.exp(rng.uniform(0.4, 1.9))), rng.uniform(0, 2 * np.pi)
    ways = np.linspace(0, 2 * np.pi, 9)[:-1]
    for _ in range(int(rng.integers(2, 24))):
        middle, radii = rng.uniform(0, side, 2), size * rng.uniform(0.5, 1.2) * rng.uniform(0.5, 1.2, 8)
        ring = middle + radii[:, None] * np.stack([np.cos(ways), np.sin(ways)], 1)
        cv2.fillPoly(spots, [ring.round().astype(np.int32)], float(rng.uniform(0.4, 1.0)))
        if rng.random() < 0.3:
            way = light + rng.normal(0, 0.1)
            end = middle + size * rng.uniform(3, 14) * np.array([np.cos(way), np.sin(way)])
            first, last = ((int(x), int(y)) for x, y in (middle, end))
            cv2.line(lines, first, last, float(rng.uniform(0.2, 0.7)), 1, cv2.LINE_AA)
    spots *= 1 + rng.normal(0, 0.3, spots.shape).astype(np.float32)
    soft = [cv2.GaussianBlur(one, (0, 0), float(rng.uniform(0.5, 1.2))) for one in (spots, lines)]
    tint = (
        rng.uniform(30, 130)
        * np.array([1.0, 0.95, rng.uniform(0.6, 1.0)])
        * rng.choice([1, -0.7], p=[0.8, 0.2])
    )
    shaded = image - soft[0][..., None] * tint - soft[1][..., None] * 60
    return np.asarray(shaded.clip(0, 255), np.uint8)


def _lettered(image: Image, rng: _Rng) -> Image:
    """Text laid over the picture, as telemetry and watermarks are."""
    image = image.copy()
    word = "".join(rng.choice(list("abcdefghiklmnoprstuvwxyz0123456789.:"), int(rng.integers(4, 14))))
    place = (int(rng.integers(-50, len(image))), int(rng.integers(0, len(image))))
    tone = float(rng.choice([255, 250, 20]))
    size, thick = float(rng.uniform(0.4, 2.0)), int(rng.integers(1, 4))
    cv2.putText(image, word, place, int(rng.integers(0, 5)), size, (tone, tone, tone), thick, cv2.LINE_AA)
    return image
