"""Crops for the classifier: cut from untouched source frames as `hvt_edge.stills.maker.StillMaker` cuts them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.inference.detect import Detector
from hvt_common.values import Boxes, Image
from hvt_common.video.still_codecs import JpegCodec
from hvt_edge.perception.candidates import PADDING, crop_box
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.pictures.places import Picture
from hvt_train.pictures.pool import HELD_OUT_SEED, SOURCE_SIZE, TRAIN_SEED, Shot, shoot
from hvt_train.pictures.real import SETS, held_out_labelled
from hvt_train.pictures.views import degrade, read_picture

CROP_SIDE = 96
"""Pixels of the classifier's square input."""
_MARGIN = 0.45
"""Stored around each box, as a share of its sides: more than `PADDING`, so that training can shift the box."""
_STORED_SIDE = 160
_LEAST_VISIBLE = 0.4
_LEAST_SIDE_PX = 8.0

_Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Crops:
    """Crops with room around them, in whole pixels of the source."""

    images_bgr: list[Image]
    boxes_px: npt.NDArray[np.float32]
    """(N, 4) the object's box in each crop."""
    class_ids: npt.NDArray[np.int32]


def collect_crops(picture: Picture, *, most: int, rng: _Rng) -> Crops:
    """Up to ``most`` crops of well visible objects, rare classes first, and one of the ground as "other"."""
    sides = (picture.boxes_px[:, 2:] - picture.boxes_px[:, :2]).max(1)
    known = picture.class_ids >= 0
    rows = np.nonzero(known & (picture.visible >= _LEAST_VISIBLE) & (sides >= _LEAST_SIDE_PX))[0]
    counts = np.bincount(picture.class_ids[rows], minlength=len(CLASS_NAMES))
    order = rng.permutation(rows)
    rows = order[np.argsort(counts[picture.class_ids[order]], kind="stable")][:most]
    boxes = [picture.boxes_px[row] for row in rows]
    kinds = [int(picture.class_ids[row]) for row in rows]
    for _ in range(2):
        empty = _empty_box(picture, rng)
        if empty is not None:
            boxes.append(empty)
            kinds.append(CLASS_NAMES.index("other"))
    crops = [_stored(picture.image_bgr, box) for box in boxes]
    inner = np.array([box for _, box in crops], np.float32).reshape(-1, 4)
    return Crops([image for image, _ in crops], inner, np.array(kinds, np.int32))


def real_crops(pool: list[Path], detector: Detector, *, most: int) -> Iterator[Crops]:
    """Crops of real pictures, and as "other" the false alarms of ``detector`` where no label is."""
    real = [path for path in pool if path.name.startswith(tuple(SETS))]
    for number, path in enumerate(real):
        rng = np.random.default_rng([TRAIN_SEED, 4, number])
        picture = read_picture(path)
        yield collect_crops(picture, most=most, rng=rng)
        alarms = _alarms(detector, picture)[: 2 * most]
        crops = [_stored(picture.image_bgr, box) for box in alarms]
        inner = np.array([box for _, box in crops], np.float32).reshape(-1, 4)
        other = np.full(len(crops), CLASS_NAMES.index("other"), np.int32)
        yield Crops([image for image, _ in crops], inner, other)


def _empty_box(picture: Picture, rng: _Rng) -> npt.NDArray[np.float32] | None:
    """A box of a vehicle's size where nothing is, like a false detection."""
    high, wide = picture.image_bgr.shape[:2]
    size = np.exp(rng.uniform(np.log(16), np.log(120), 2))
    low = rng.uniform(0, np.maximum(np.array([wide, high]) - size, 1))
    box = np.array([*low, *(low + size)], np.float32)
    boxes = picture.boxes_px
    touches = ((boxes[:, :2] < box[2:]) & (boxes[:, 2:] > box[:2])).all(1).any()
    return None if touches else box


def _stored(image: Image, box: npt.NDArray[np.float32]) -> tuple[Image, npt.NDArray[np.float32]]:
    margin = np.maximum((box[2:] - box[:2]) * _MARGIN, 4)
    high, wide = image.shape[:2]
    x0, y0 = np.maximum(np.floor(box[:2] - margin), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(box[2:] + margin), (wide, high)).astype(int)
    crop, inner = image[y0:y1, x0:x1], box - np.array([x0, y0, x0, y0], np.float32)
    shrink = _STORED_SIDE / max(crop.shape[:2])
    if shrink < 1:
        size = (max(1, round(crop.shape[1] * shrink)), max(1, round(crop.shape[0] * shrink)))
        inner = inner * np.tile(np.array(size) / crop.shape[1::-1], 2).astype(np.float32)
        crop = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(crop), inner.astype(np.float32)


def scene_crops(numbers: range, *, moments: int, most: int) -> Iterator[Crops]:
    """Crops of training scenes at the source's full size."""
    for number in numbers:
        rng = np.random.default_rng([TRAIN_SEED, 2, number])
        scene = shoot(TRAIN_SEED + 50_000 + number, demo_appearance=number % 3 == 0)
        for t_s in rng.uniform(0, scene.duration_s, moments):
            yield collect_crops(Shot(scene, float(t_s)).picture(SOURCE_SIZE), most=most, rng=rng)


def pool_crops(pool: list[Path], *, most: int) -> Iterator[Crops]:
    """Crops of the detector's clean pictures: places, and demo scenes from further away than `scene_crops`."""
    clean = [path for path in pool if path.name.startswith(("place", "demo"))]
    for number, path in enumerate(clean):
        yield collect_crops(read_picture(path), most=most, rng=np.random.default_rng([TRAIN_SEED, 3, number]))


def held_out_crops(seeds: range, *, moments: int, quality_pct: int = 65) -> Iterator[tuple[Image, str]]:
    """Stills of held-out scenes as the ground decodes them, each with its true class."""
    for seed in seeds:
        scene = shoot(HELD_OUT_SEED + seed, demo_appearance=seed % 2 == 0)
        for t_s in np.linspace(1.0, scene.duration_s - 1, moments):
            yield from _stills(Shot(scene, float(t_s)).picture(SOURCE_SIZE), quality_pct)


def held_out_real_crops(
    data: Path, detector: Detector, *, quality_pct: int = 65
) -> Iterator[tuple[Image, str]]:
    """Stills of held-out real pictures, and as "other" the finds of ``detector`` where no label is."""
    other = CLASS_NAMES.index("other")
    for picture in held_out_labelled(data):
        yield from _stills(picture, quality_pct)
        alarms = _alarms(detector, picture)
        kinds, seen = np.full(len(alarms), other, np.int32), np.ones(len(alarms), np.float32)
        yield from _stills(Picture(picture.image_bgr, alarms, kinds, seen), quality_pct)


def _stills(picture: Picture, quality_pct: int) -> Iterator[tuple[Image, str]]:
    codec, size = JpegCodec(), (picture.image_bgr.shape[1], picture.image_bgr.shape[0])
    for box, kind, share in zip(picture.boxes_px, picture.class_ids, picture.visible, strict=True):
        if kind < 0 or share < _LEAST_VISIBLE or (box[2:] - box[:2]).max() < _LEAST_SIDE_PX:
            continue
        corners = (float(box[0]), float(box[1]), float(box[2]), float(box[3]))
        x0, y0, x1, y1 = crop_box(corners, padding=PADDING, source_size=size)
        crop = np.ascontiguousarray(picture.image_bgr[y0:y1, x0:x1])
        coded = codec.encode(crop, quality_pct=quality_pct)
        yield codec.decode(coded.data, size=(x1 - x0, y1 - y0)), CLASS_NAMES[kind]


def _alarms(detector: Detector, picture: Picture) -> Boxes:
    """(N, 4) boxes that touch no label, surest first."""
    found, boxes = detector.detect(picture.image_bgr).boxes_xyxy_px, picture.boxes_px
    touches = (found[:, None, :2] < boxes[:, 2:]) & (found[:, None, 2:] > boxes[:, :2])
    beside = ~np.any(np.logical_and.reduce(touches, axis=2), axis=1)
    return np.asarray(found[beside], np.float32)


class CropSource:
    """Draws training crops, every class about as often, without end."""

    def __init__(self, groups: list[Crops], *, seed: int) -> None:
        self._images = [image for group in groups for image in group.images_bgr]
        self._boxes = np.concatenate([group.boxes_px for group in groups])
        self._kinds = np.concatenate([group.class_ids for group in groups])
        self._rng = np.random.default_rng(seed)
        counts = np.bincount(self._kinds, minlength=len(CLASS_NAMES))
        self._rows = [np.nonzero(self._kinds == kind)[0] for kind in range(len(CLASS_NAMES))]
        shares = np.sqrt(counts.astype(float))
        self._shares = shares / shares.sum()

    def __len__(self) -> int:
        return len(self._images)

    def next(self) -> tuple[Image, int]:
        """A (`CROP_SIDE`, `CROP_SIDE`, 3) crop and its class."""
        rng = self._rng
        kind = int(rng.choice(len(CLASS_NAMES), p=self._shares))
        row = int(rng.choice(self._rows[kind]))
        crop = _shifted(self._images[row], self._boxes[row], rng)
        if rng.random() < 0.3:  # seen from further away
            shrink = float(rng.uniform(0.4, 1.0))
            size = tuple(max(6, round(side * shrink)) for side in crop.shape[1::-1])
            crop = np.asarray(cv2.resize(crop, size, interpolation=cv2.INTER_AREA), np.uint8)
        if rng.random() < 0.85:
            quality = 65 if rng.random() < 0.5 else int(rng.integers(25, 95))
            _, data = cv2.imencode(".jpg", crop, [cv2.IMWRITE_JPEG_QUALITY, quality])
            crop = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        shrinks = min(crop.shape[:2]) >= CROP_SIDE
        how = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        square = np.asarray(cv2.resize(crop, (CROP_SIDE, CROP_SIDE), interpolation=how), np.uint8)
        square = degrade(square, rng, strength=0.4, compress=0.0)
        if rng.random() < 0.5:
            square = square[:, ::-1]
        if rng.random() < 0.5:
            square = square[::-1]
        if rng.random() < 0.5:
            square = square.transpose(1, 0, 2)
        return np.ascontiguousarray(square), kind


def _shifted(image: Image, box: npt.NDArray[np.float32], rng: _Rng) -> Image:
    """The padded box, as a tracker would have it: a little off on every side."""
    sides = box[2:] - box[:2]
    low = box[:2] - sides * (PADDING + rng.normal(0, 0.06, 2))
    high = box[2:] + sides * (PADDING + rng.normal(0, 0.06, 2))
    x0, y0 = np.maximum(np.floor(low), 0).astype(int)
    x1, y1 = np.minimum(np.ceil(high), image.shape[1::-1]).astype(int)
    return np.ascontiguousarray(image[y0 : max(y1, y0 + 2), x0 : max(x1, x0 + 2)])
