"""Pictures beside labels: a YOLO folder, COCO JSON, VisDrone's image layout, a MOTChallenge sequence, or none.

::

    ROOT/images/NAME.jpg, ROOT/labels/NAME.txt, [ROOT/classes.txt]     YOLO: class cx cy w h, 0…1 of the picture
    ROOT/images/NAME.jpg, ROOT/annotations/NAME.txt                    VisDrone-DET
    FILE.json                                                          COCO; pictures lie beside it or in images/
    ROOT/img1/000001.jpg, ROOT/gt/gt.txt, [ROOT/gt/labels.txt]         MOTChallenge
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_common.values import Image
from hvt_edge.source.folder import sequence_files
from hvt_study.datasets.clip import NOMINAL_FPS
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.layouts.mot import open_mot
from hvt_study.datasets.layouts.options import Options
from hvt_study.datasets.layouts.visdrone import table_of
from hvt_study.datasets.visdrone_rows import read_image_rows
from hvt_study.datasets.yolo_labels import labels_of, read_text, read_yolo, yolo_names

__all__ = ["LabelledPicture", "find_pictures", "read_image"]

_TRUTH = "gt/gt.txt"


@dataclass(frozen=True, slots=True)
class LabelledPicture:
    """A picture and where its labels are."""

    path: Path
    labels: Path | Sequence[Mapping[str, Any]] | FrameLabels | None
    """A YOLO or VisDrone file, COCO's annotations of the picture, the labels themselves; None: nobody labelled it."""
    class_names: Sequence[str]
    visdrone: bool = False
    one_target: bool = False
    """Of a sequence that labels one object and nothing else that is in view: it can be found or missed, no more."""

    def read(self, size: tuple[int, int]) -> FrameLabels | None:
        """The labels in the pixels of the picture, which is (width, height) large.

        Raises:
            UserError: names the file and the line that cannot be.
        """
        if self.labels is None:
            return None
        if isinstance(self.labels, FrameLabels):
            return self.labels
        if not isinstance(self.labels, Path):
            return _from_coco(self.path, self.labels, size)
        if self.visdrone:
            return _from_visdrone(self.labels, size)
        return read_yolo(self.labels, self.class_names, size)


def find_pictures(place: Path, *, classes: Sequence[str] | None) -> list[LabelledPicture]:
    """All pictures of one argument, in natural order.

    Args:
        place: a picture, a folder, or COCO's JSON.
        classes: names of a YOLO folder's classes; None: those of its ``classes.txt``.

    Raises:
        UserError: nothing is there, or YOLO labels have no names.
    """
    if place.suffix == ".json" and place.is_file():
        return _coco_pictures(place)
    if place.is_file():
        return [LabelledPicture(place, None, ())]
    if not place.is_dir():
        raise UserError(f"{place} does not exist; a picture, a folder of pictures or a COCO file is expected")
    if (place / _TRUTH).is_file():
        return _mot_pictures(place)
    images = place / "images" if (place / "images").is_dir() else place
    files = sequence_files(images)
    if not files:
        raise UserError(f"{images} holds no pictures")
    for folder in ("labels", "annotations"):
        if (place / folder).is_dir():
            visdrone = folder == "annotations"
            names = VISDRONE_NAMES if visdrone else yolo_names(place, classes)
            found = {file.stem: file for file in (place / folder).glob("*.txt")}
            return [LabelledPicture(file, found.get(file.stem), names, visdrone) for file in files]
    return [LabelledPicture(file, None, ()) for file in files]


def read_image(path: Path) -> Image | None:
    """(height, width, 3) uint8 BGR; None where it is no picture that can be read."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return None if image is None else np.asarray(image, np.uint8)


def _from_visdrone(path: Path, size: tuple[int, int]) -> FrameLabels:
    return table_of(read_image_rows(path), size=size).at(0)


def _coco_pictures(path: Path) -> list[LabelledPicture]:
    """COCO's ``images``, ``annotations`` (also ``annotation``) and ``categories``."""
    try:
        about = json.loads(read_text(path))
        names = {row["id"]: str(row["name"]) for row in about["categories"]}
        rows = about["annotations"] if "annotations" in about else about["annotation"]
        of: dict[Any, list[dict[str, Any]]] = {image["id"]: [] for image in about["images"]}
        for row in rows:
            of[row["image_id"]].append({"name": names[row["category_id"]], **row})
        files = {
            image["id"]: str(image["file_name"] if "file_name" in image else image["filename"])
            for image in about["images"]
        }
    except (ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} is not COCO's JSON: {type(error).__name__} {error}") from None
    return [
        LabelledPicture(_beside(path, name), tuple(of[key]), tuple(names.values()))
        for key, name in files.items()
    ]


def _in_picture(box: Sequence[Any], size: tuple[int, int]) -> bool:
    """Whether x, y, w, h are numbers that begin in the picture."""
    if len(box) != len((*size, *size)) or not all(isinstance(side, int | float) for side in box):
        return False
    x, y, wide, high = box
    return bool(0 <= x <= size[0] and 0 <= y <= size[1] and 0 <= wide < math.inf and 0 <= high < math.inf)


def _mot_pictures(place: Path) -> list[LabelledPicture]:
    """The frames of one sequence; the rate does not matter."""
    (opened,) = open_mot(place, Options(fps=NOMINAL_FPS)).values()
    sequence = opened()
    assert sequence.labels is not None, "annotations were asked for"
    files = sequence_files(Path(sequence.clip.spec))
    labels = [sequence.labels(index) for index in range(len(files))]
    return [
        LabelledPicture(file, frame, sequence.class_set, one_target=sequence.one_target)
        for file, frame in zip(files, labels, strict=True)
    ]


def _beside(path: Path, name: str) -> Path:
    places = [path.parent / name, path.parent / "images" / name, path.parent.parent / "images" / name]
    return next((place for place in places if place.is_file()), places[0])


def _from_coco(path: Path, rows: Sequence[Mapping[str, Any]], size: tuple[int, int]) -> FrameLabels:
    for row in rows:
        box = row.get("bbox")
        if not (isinstance(box, list) and _in_picture(box, size)):
            raise UserError(
                f"COCO annotation {row.get('id', '')} of {path.name} has the box {box}; x, y, w, h in the picture of "
                f"{size[0]}x{size[1]} is accepted"
            )
    boxes = np.array([row["bbox"] for row in rows], np.float64).reshape(-1, 4)
    kinds = ["ignore" if row.get("iscrowd") else str(row["name"]) for row in rows]
    return labels_of(np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]]), kinds)
