"""Unlabelled pictures of traffic cameras and streets: three detectors name the objects that they agree on.

A box that two are sure of, or the best of them by far, is an object; a box that one of them thinks possible counts
neither way; the rest is ground. The best on such views is Open Model Zoo's person-vehicle-bike-detection-2003
(Apache-2.0); the others are YOLOX-nano, of the picture as it is and enlarged, and the aerial detector of before.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import COCO_NAMES
from hvt_common.inference.detect import Detector
from hvt_common.values import Boxes, Image, iou
from hvt_train.pictures.kinds import BIKE, ID, LARGE_VEHICLE, VEHICLE

_GROUPS = {
    **dict.fromkeys(("vehicle", "car", "van", "truck", "bus"), "vehicle"),
    **dict.fromkeys(("person", "pedestrian"), "person"),
    **dict.fromkeys(("bike", "motor", "motorcycle", "bicycle"), "bike"),
    "boat": "boat",
}
_SURE, _ALONE, _NAMED = 0.25, 0.42, 0.45
"""Least confidence of two detectors; of the best one alone; from which YOLOX-nano's kind holds."""
_SAME, _LEAST_PX = 0.45, 4.0
_SAME_DOUBT = 0.3
_AT_ONE_PLACE, _STANDS, _MOVES = 0.65, 0.25, 0.6
"""IoU of boxes at one place; the share of a camera's pictures with one there; the least score of a real one there."""
_POSSIBLE, _GROUND = 0.15, 0.1
"""From which the best one's box counts neither way, and the share of the picture beyond which none does."""


@dataclass(frozen=True, slots=True)
class Said:
    """A box of a teacher: 0 is the best one, 1 YOLOX-nano, 2 the aerial one."""

    teacher: int
    name: str
    score: float
    box_px: npt.NDArray[np.float32]


def unlabelled(folder: Path, *, of_a_clip: int = 34) -> Iterator[tuple[str, Image]]:
    """The pictures in ``folder``, and about so many of each clip there, evenly over it, with their file's name."""
    for path in sorted(folder.glob("*")):
        if path.suffix in {".gif", ".mp4"}:
            with av.open(str(path)) as container:
                count = sum(1 for _ in container.decode(video=0))
            with av.open(str(path)) as container:
                for number, frame in enumerate(container.decode(video=0)):
                    if number % max(1, count // of_a_clip) == 0:
                        yield path.stem, np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
        elif (image := cv2.imread(str(path))) is not None:
            yield path.stem, np.asarray(image, np.uint8)


class Teachers:
    """Asks all three; each should show boxes from .08 on. ``names`` are the classes of the best one."""

    def __init__(self, best: Detector, nano: Detector, aerial: Detector, *, names: Sequence[str]) -> None:
        self._teachers = (
            (best, tuple(names), (1.0,)),
            (nano, COCO_NAMES, (1.0, 1.8)),
            (aerial, aerial.class_names, (1.0,)),
        )

    def say(self, image: Image) -> list[Said]:
        """All boxes of all teachers, in pixels of the picture."""
        said = []
        for number, (teacher, names, zooms) in enumerate(self._teachers):
            for scale in zooms:
                big = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
                said += _said(number, teacher, names, np.asarray(big, np.uint8), scale)
        best, names, _ = self._teachers[0]
        size = np.array([image.shape[1], image.shape[0]])
        for place, part in _quarters(image):
            sides = np.array([part.shape[1], part.shape[0]])
            for one in _said(0, best, names, part, 1.0):
                # A box that a quarter's inner edge cuts is whole in another one, or in the picture.
                low, high = one.box_px[:2] < 2, one.box_px[2:] > sides - 2
                if not (low & (place > 0) | high & (place + sides < size)).any():
                    shifted = one.box_px + np.tile(place, 2).astype(np.float32)
                    said.append(dataclasses.replace(one, box_px=shifted))
        return said


def without_what_stands(said: Sequence[Sequence[Said]]) -> list[list[Said]]:
    """Pictures of one camera without unsure boxes that a quarter of them has in one place: signs, lane marks."""
    known = [[one for one in picture if one.name in _GROUPS] for picture in said]
    boxes = [np.array([one.box_px for one in picture], np.float32).reshape(-1, 4) for picture in known]
    left = []
    for number, picture in enumerate(known):
        others = [rows for other, rows in enumerate(boxes) if other != number]
        seen = sum(
            (iou(boxes[number], rows).max(1, initial=0) > _AT_ONE_PLACE for rows in others),
            start=np.zeros(len(picture)),
        )
        stands = seen >= _STANDS * max(1, len(others))
        pairs = zip(picture, stands, strict=True)
        left.append([one for one, still in pairs if not still or one.score >= _MOVES])
    return left


def _said(number: int, teacher: Detector, names: Sequence[str], image: Image, scale: float) -> list[Said]:
    found = teacher.detect(image)
    return [
        Said(number, names[kind], float(score), np.asarray(box / scale, np.float32))
        for box, score, kind in zip(found.boxes_xyxy_px, found.confidences, found.class_ids, strict=True)
    ]


def _quarters(image: Image) -> Iterator[tuple[npt.NDArray[np.int64], Image]]:
    """The four corners, 60 % of each side: the best teacher sees any picture at one size, small things too small."""
    high, wide = (round(0.6 * side) for side in image.shape[:2])
    for top in (0, image.shape[0] - high):
        for left in (0, image.shape[1] - wide):
            part = np.ascontiguousarray(image[top : top + high, left : left + wide])
            yield np.array([left, top]), part


def agreed(said: Sequence[Said], *, area_px: float) -> tuple[Boxes, npt.NDArray[np.int32]]:
    """Boxes and class ids from the answers on one picture of ``area_px``; -1 counts neither way."""
    left = sorted(
        (one for one in said if one.name in _GROUPS and (one.teacher or one.score >= _POSSIBLE)),
        key=lambda one: (one.teacher, -one.score),
    )
    boxes, kinds = [], []
    while left:
        first, group = left[0], _GROUPS[left[0].name]
        table = iou(first.box_px[None], np.stack([one.box_px for one in left]))[0]
        same = [
            one
            for one, overlap in zip(left, table, strict=True)
            if one is first or (overlap >= _SAME and _GROUPS[one.name] == group)
        ]
        taken = {id(one) for one in same}
        left = [one for one in left if id(one) not in taken]
        kind = _kind(same, group)
        boxes.append(first.box_px)
        kinds.append(kind)
    found = np.array(boxes, np.float32).reshape(-1, 4)
    numbers = np.array(kinds, np.int32)
    sides = found[:, 2:] - found[:, :2]
    counted = (sides.max(1, initial=0) >= _LEAST_PX) & (
        (numbers >= 0) | (sides.prod(1) <= _GROUND * area_px) | (numbers < -1)
    )
    objects = found[counted & (numbers != -1)]
    if len(objects):  # a doubt about a sure object says nothing
        counted &= (numbers != -1) | (iou(found, objects).max(1) <= _SAME_DOUBT)
    return found[counted], numbers[counted]


def _kind(same: Sequence[Said], group: str) -> int:
    best = [max((one.score for one in same if one.teacher == teacher), default=0.0) for teacher in range(3)]
    sure = sorted(best)[-2] >= _SURE or best[0] >= _ALONE
    if not sure:
        return -1
    nano = max((one for one in same if one.teacher == 1), key=lambda one: one.score, default=None)
    name = nano.name if nano is not None and nano.score >= _NAMED else group
    return {
        "vehicle": VEHICLE,
        "truck": LARGE_VEHICLE,
        "bike": BIKE,
        "person": ID["pedestrian"],
        "motorcycle": ID["motor"],
        "boat": -1,
    }.get(name, ID.get(name, -1))
