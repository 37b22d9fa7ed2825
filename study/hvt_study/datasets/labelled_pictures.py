"""Pictures and their labels, in the layouts of `label_files`, COCO's JSON, a MOTChallenge sequence, or none.

The size that a file of labels says its picture has (COCO, Pascal VOC) is held against the picture as it is read: one
that was turned by its EXIF tag is read as it was labelled, of one that was resized the boxes are scaled, and anything
else is refused.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from hvt_common.errors import UserError
from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_edge.source.folder import left_out, sequence_files
from hvt_study.datasets import label_files
from hvt_study.datasets.annotation_rows import LARGEST, label_text
from hvt_study.datasets.label_table import image_labels
from hvt_study.datasets.labels import IGNORED, FrameLabels, LabelDoubts, check_pixels
from hvt_study.datasets.layouts.mot import open_mot
from hvt_study.datasets.layouts.options import Options
from hvt_study.datasets.sequence import NOMINAL_FPS

_TRUTH = "gt/gt.txt"
_SAME_SHAPE = 0.01
"""So much may the ratio of the sides differ where a picture was resized to whole pixels."""


_Annotation = tuple[str, tuple[float, ...] | None, str]
"""Class, x1 y1 x2 y2 as labelled, and the place in words."""


@dataclass(frozen=True, slots=True)
class LabelledPicture:
    """A picture and where its labels are."""

    path: Path
    labels: Path | tuple[Mapping[str, Any], ...] | label_files.VocFile | FrameLabels | None
    """A YOLO or VisDrone file, COCO's annotations of the picture, the labels themselves; None: nobody labelled it."""
    class_names: Sequence[str]
    visdrone: bool = False
    one_target: bool = False
    """The sequence labels one object and nothing else that is in view: it can be found or missed, no more."""
    labelled_size: tuple[int, int] | None = None
    """(width, height) that the labels say the picture has."""
    keypoints: int = 0
    """Columns of keypoints behind the boxes of a YOLO file."""
    doubts: LabelDoubts = field(default_factory=LabelDoubts)

    @property
    def unreadable(self) -> str:
        """Why there is no picture, in words."""
        there = label_files.Folders().find(self.path) is not None
        return f"{self.path} {'cannot be read as a picture' if there else 'does not exist'}"

    def read(self, size: tuple[int, int]) -> FrameLabels | None:
        """The labels in the pixels of the picture, which is (width, height) large.

        A `UserError` names a file that cannot be read, or a picture of another shape than its labels say.
        """
        if self.labels is None:
            return None
        if isinstance(self.labels, FrameLabels):
            return self.labels
        if isinstance(self.labels, Path):
            if self.visdrone:
                return image_labels(self.labels, size, self.doubts)
            return label_files.read_yolo(
                self.labels, self.class_names, size, self.doubts, keypoints=self.keypoints
            )
        scale = self._scale(size)
        rows: list[_Annotation]
        if isinstance(self.labels, label_files.VocFile):
            rows = [(name, box, f"{self.path}, object {name}") for name, box in self.labels.objects]
        else:
            rows = [_coco_row(row) for row in self.labels]
        good = []
        for name, box, where in rows:
            if not name:
                self.doubts.leave_out(f"{where} has no class")
            elif box is None or not all(map(math.isfinite, box)):
                self.doubts.leave_out(
                    f"{where} has no box: accepted are four numbers in the picture of {size[0]}x{size[1]}"
                )
            else:
                good.append((name, box, where))
        return self.doubts.labels(good, size, scale)

    def _scale(self, size: tuple[int, int]) -> tuple[float, float]:
        said = self.labelled_size
        if said in (None, size):
            return 1.0, 1.0
        assert said is not None
        x, y = size[0] / said[0], size[1] / said[1]
        sizes = f"{self.path} is {size[0]}x{size[1]}, and its labels say {said[0]}x{said[1]}"
        if abs(x / y - 1) > _SAME_SHAPE:
            raise UserError(
                f"{sizes}: label the picture that is there, or put the one back that was labelled"
            )
        self.doubts.resized(sizes)
        return x, y


def find_pictures(place: Path, *, classes: Sequence[str] | None) -> list[LabelledPicture]:
    """All pictures of a picture, a folder, COCO's JSON, or the YAML of a YOLO set, in natural order.

    ``classes`` are names of a YOLO folder's classes; None: those of its ``classes.txt``, ``obj.names`` or
    ``data.yaml``. Raises `UserError` where nothing is there, or YOLO labels have no names.
    """
    doubts = LabelDoubts()
    if place.suffix == ".json" and place.is_file():
        return _coco_pictures(place, doubts)
    if place.suffix in label_files.YAML and place.is_file():
        return _of_yaml(place, classes)
    if place.is_file():
        return [LabelledPicture(place, None, ())]
    if not place.is_dir():
        raise UserError(f"{place} does not exist; a picture, a folder of pictures or a COCO file is expected")
    if label_files.in_any_case(place / _TRUTH).is_file():
        return _mot_pictures(place)
    files = label_files.pictures_below(place)
    if not files:
        raise UserError(f"{place} holds no pictures, nor do its folders")
    doubts.beside = left_out({file.parent for file in files}, files, pictures=True)
    folders = label_files.Folders()
    found = {
        file: labels for file in files if (labels := label_files.label_file(file, place, folders)) is not None
    }
    if not found:
        return _coco_beside(place, files, doubts)
    voc = {file: label_files.read_voc(path) for file, path in found.items() if path.suffix.lower() == ".xml"}
    texts = [path for path in found.values() if path.suffix.lower() == ".txt"]
    visdrone = bool(texts) and _has_commas(texts)
    names: Sequence[str] = VISDRONE_NAMES if visdrone else ()
    keypoints = 0
    if voc:
        check_pixels(place, [side for one in voc.values() for _, box in one.objects for side in box])
        named = {name for one in voc.values() for name, _ in one.objects}
        names = tuple(sorted(name for name in named if name and name.casefold() not in IGNORED))
    elif texts and not visdrone:
        names = label_files.yolo_names(place, classes, files)
        keypoints = label_files.keypoint_columns(label_files.class_file(place, files))
    doubts.unread = label_files.check_unread(place, files, found.values())
    return [
        LabelledPicture(
            file,
            voc.get(file, found.get(file)),
            names,
            visdrone,
            labelled_size=voc[file].size if file in voc else None,
            keypoints=keypoints,
            doubts=doubts,
        )
        for file in files
    ]


def _of_yaml(path: Path, classes: Sequence[str] | None) -> list[LabelledPicture]:
    folders = label_files.yaml_folders(path)
    if classes is None and folders != [path.parent]:
        classes = label_files.read_class_file(path)
    return [one for folder in folders for one in find_pictures(folder, classes=classes)]


def doubts_of(pictures: Sequence[LabelledPicture]) -> list[str]:
    """The faults of the labels that were read, in sentences; `UserError` where no label of a set was good."""
    sets = {id(picture.doubts): picture.doubts for picture in pictures}.values()
    for doubts in sets:
        doubts.check()
    return [sentence for doubts in sets for sentence in doubts.sentences()]


def _has_commas(texts: Sequence[Path]) -> bool:
    """Whether lines are VisDrone's; of the first file that has any. A decimal comma is none of VisDrone's."""
    first = next((line for path in texts for line in label_text(path).splitlines() if line.strip()), None)
    if first is None:
        return texts[0].parent.name.lower() == "annotations"
    words = first.split()
    return "," in first and not (
        len(words) >= label_files.YOLO_COLUMNS and not any("," in one[-1] for one in words)
    )


def _coco_beside(place: Path, files: Sequence[Path], doubts: LabelDoubts) -> list[LabelledPicture]:
    read = label_files.coco_files(place)
    found = [one for path in read for one in _coco_pictures(path, doubts)]
    if found:
        doubts.unread, doubts.beside = label_files.check_unread(place, files, read), ""  # each is named
        return found
    if any((place / folder).is_dir() for folder in ("labels", "annotations", "Annotations")):
        some = f"any of its {len(files)} pictures, such as {files[0].name}"
        raise UserError(f"{place} has no label of {some}: looked in {label_files.LOOKED_IN}")
    doubts.unread = label_files.check_unread(place, files, ())
    return [LabelledPicture(file, None, (), doubts=doubts) for file in files]


def _coco_pictures(path: Path, doubts: LabelDoubts) -> list[LabelledPicture]:
    """COCO's ``images``, ``annotations`` (also ``annotation``) and ``categories``."""
    try:
        about = json.loads(label_text(path))
        categories = [(_id(row["id"]), label_files.class_word(row["name"])) for row in about["categories"]]
        names = {key: name for key, name in categories if key is not None}
        unclear_names = {key for key, name in categories if names.get(key) != name}
        rows = about["annotations"] if "annotations" in about else about["annotation"]
        images = [
            (
                key,
                str(image["file_name"] if "file_name" in image else image["filename"]),
                _said_size(image),
            )
            for image in about["images"]
            if (key := _id(image["id"])) is not None
        ]
        of: dict[Any, list[dict[str, Any]]] = {key: [] for key, _, _ in images}
        for number, row in enumerate(rows, start=1):
            where = f"COCO annotation {row.get('id', number)} of {path.name}"
            image, category = _id(row.get("image_id")), _id(row.get("category_id"))
            if image not in of or category not in names or category in unclear_names:
                doubts.leave_out(
                    f"{where} has an image_id or a category_id that the file does not have, or has with two names"
                )
                continue
            of[image].append({**row, "name": names[category], "where": where})
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        why = (
            f"{error}"
            if isinstance(error, ValueError | RecursionError)
            else "it lacks images, annotations or categories"
        )
        raise UserError(f"{path} is not COCO's JSON: {why}") from None
    check_pixels(path, [side for row in rows for side in row.get("bbox") or () if _is_number(side)])
    folders = label_files.Folders()
    pictures: dict[Path, tuple[str, Any, tuple[int, int] | None]] = {}
    unclear = {key for key, count in Counter(key for key, _, _ in images).items() if count > 1}
    for key, name, size in images:
        picture = _beside(path, name, folders)
        other = pictures.get(picture)
        if other is None:
            pictures[picture] = (name, key, size)
        elif other[0] == name and key != other[1]:
            of[other[1]] += of[key]  # the same picture twice, as tools that join sets write it
        elif other[0] != name:
            unclear |= {key, other[1]}
    for key in unclear:
        for row in of[key]:
            doubts.leave_out(f"{row['where']} is of image {key}, which may be one of several pictures")
    return [
        LabelledPicture(
            picture,
            None if key in unclear else tuple(of[key]),
            tuple(names.values()),
            labelled_size=size,
            doubts=doubts,
        )
        for picture, (_, key, size) in pictures.items()
    ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and abs(value) < LARGEST


def _id(value: Any) -> Any:
    """A number is one also where a tool writes it as text; a list or a table is none."""
    if isinstance(value, list | dict):
        return None
    return int(value) if isinstance(value, str) and value.isdecimal() else value


def _said_size(image: Mapping[str, Any]) -> tuple[int, int] | None:
    wide, high = (int(label_files.number_of(str(image.get(side)))) for side in ("width", "height"))
    return (wide, high) if min(wide, high) > 0 else None


def _coco_row(row: Mapping[str, Any]) -> _Annotation:
    box = row.get("bbox")
    name = "ignore" if _id(row.get("iscrowd")) or _id(row.get("ignore")) else str(row["name"])
    if not (isinstance(box, list) and len(box) == 4 and all(map(_is_number, box))):
        return name, None, f"{row['where']}, bbox {box},"
    x, y, wide, high = box
    return name, (x, y, x + wide, y + high), str(row["where"])


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


def _beside(path: Path, name: str, folders: label_files.Folders) -> Path:
    """Where a picture of COCO's file lies: beside it, in images/ or data/, or in a folder of the split.

    ::

        annotations/instances_val2017.json    [images/]val2017/NAME.jpg
    """
    name = name.replace("\\", "/")
    split = path.stem.partition("_")[2] or "."
    inner = (".", "images", "data", split, f"images/{split}")
    places = [
        root / folder / one
        for one in dict.fromkeys((name, unquote(name), Path(name).name, Path(unquote(name)).name))
        for root in (path.parent, path.parent.parent)
        for folder in inner
    ]
    found = (folders.find(place) for place in places)
    return next((place for place in found if place is not None and place.is_file()), places[0])
