"""Where the labels of a picture lie: the layouts of Ultralytics, Roboflow, FiftyOne, labelImg, CVAT, Label Studio.

::

    images/[train/]NAME.jpg, labels/[train/]NAME.txt          Ultralytics, FiftyOne, Label Studio; [data.yaml]
    train/images/NAME.jpg, train/labels/NAME.txt              Roboflow; data.yaml
    obj_train_data/NAME.jpg, obj_train_data/NAME.txt          CVAT's YOLO 1.1; obj.names
    NAME.jpg, NAME.txt or NAME.xml                            labelImg; classes.txt
    JPEGImages/NAME.jpg, Annotations/NAME.xml                 Pascal VOC, as CVAT and Label Studio write it
    images/NAME.jpg, annotations/NAME.txt                     VisDrone-DET
    annotations/*.json, labels.json, result.json, …           COCO, as CVAT, FiftyOne, Label Studio, Roboflow write it
"""

import math
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from glob import escape
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import cv2
import numpy as np

from hvt_common import files
from hvt_common.errors import UserError
from hvt_common.inference.labels import read_labels, table_names
from hvt_common.units import shown_text
from hvt_common.values import Image
from hvt_edge.source.folder import read_picture, sequence_files
from hvt_study.datasets.annotation_rows import label_text
from hvt_study.datasets.labels import FrameLabels, LabelDoubts

LOOKED_IN = (
    "labels/, annotations/, Annotations/, beside the pictures, and COCO's JSON in annotations/ and beside, but for "
    "captions_…, panoptic_… and stuff_…"
)
YAML = (".yaml", ".yml")
_PICTURES = ("images", "JPEGImages", "data", "obj_train_data")
_LABELS = (
    *(("labels", ".txt"), ("annotations", ".txt")),
    *(("Annotations", ".xml"), ("annotations", ".xml"), ("labels", ".xml")),
)
_OTHER = {
    "annotations.xml": "CVAT for images",
    "label_2": "KITTI",
    "labelTxt": "DOTA",
    "ann": "Supervisely",
    "groundtruth.txt": "LaSOT or GOT-10k",
    "groundtruth_rect.txt": "OTB",
    "gt.txt": "a sequence",
}
_OTHER_FILES = (".json", ".jsonl", ".ndjson", ".csv", ".odgt", ".xml")
_OTHER_WORDS = re.compile(
    rb"bbox|\"bounding_?box\w*\"\s*:|(?<![a-z])x_?min|box2d|gtboxes|shape_attributes|rectanglelabels|<box |"
    rb"\"(?:shapes|annotations)\"",
    re.IGNORECASE,
)
"""In the first bytes of files that hold labels of a kind that is not read; XML has bounding boxes of places."""
_TABLES, _PACKED = (".csv", ".tsv", ".txt"), ".tfrecord"
_NUMBER = rb"(?:[-+]?[\d.]{1,30}(?:e[-+]?\d{1,3})?|nan)"
_BOX = re.compile(rb"(?im)^(?:%b[ \t,;]+){3}%b[ \t,;\r]*$" % (_NUMBER, _NUMBER))
"""A line of four numbers and nothing else."""
_PART = re.compile(r"_\d+$")
_WORDS, _IS_NUMBER = re.compile(rb"[\s,;:\"'/\\]+"), re.compile(_NUMBER, re.IGNORECASE)
_POSES = re.compile(rb"^.*(?:gps|geo|pose)|\blat(?:itude)?(?:\b|_)|epsg", re.IGNORECASE)
"""In the name or, below it, the head of a table of places."""
_LOOKED_AT, _LIST, _LOOKED_INTO = 1 << 16, 1 << 20, 1000
_CLASSES = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml", "data.yml")
_COCO = ("labels.json", "result.json", "annotations.json", "_annotations.coco.json", "coco.json")
_COCO_BOXES = "instances_"
"""COCO's own name for the file with boxes, beside captions and keypoints of the same pictures; CVAT's too."""
_NO_OBJECTS = ("captions_", "panoptic_", "stuff_")
"""How names of COCO's files of sentences, and of skies and lawns, begin."""
_NO_LABELS = ("captions_", "person_keypoints_", "detections.csv")
"""How names of COCO's other files begin, and the name of what ``hvt-study detect`` writes."""
_DEPTH = 3


class Folders:
    """Files in folders, whatever the case and the accents' form of their names: ``A.JPG`` has ``A.TXT`` too."""

    def __init__(self) -> None:
        self._names: dict[Path, dict[str, str]] = {}

    def find(self, path: Path) -> Path | None:
        """The file or folder of this path, each of its names in any case; None where there is none."""
        try:
            if path.exists():
                return path
            above = None if path.parent == path else path.parent
            folder = above if above is None or above.is_dir() else self.find(above)
            if folder is None or not folder.is_dir():
                return None
            if folder not in self._names:
                self._names[folder] = {_plain(one.name): one.name for one in folder.iterdir()}
        except OSError:  # the name is too long for any file, or the folder may not be read
            return None
        name = self._names[folder].get(_plain(path.name))
        return None if name is None else folder / name


def in_any_case(path: Path) -> Path:
    """The file or folder of this path with its names in whatever case they are there; the path where none is."""
    return Folders().find(path) or path


def _plain(name: str) -> str:
    # An accent may be a letter's own, or one behind it, as macOS writes it.
    return unicodedata.normalize("NFC", name).lower()


def pictures_below(place: Path) -> list[Path]:
    """All pictures of a set, folder by folder, in natural order; those of ``images/`` alone where there is one."""
    known = (Folders().find(place / name) for name in _PICTURES)
    first = next((one for one in known if one is not None and one.is_dir()), place)
    found = sequence_files(place) if first == place else []
    if found:
        return found
    labels = {name for name, _ in _LABELS}
    return [
        file
        for folder in _folders(first, _DEPTH)
        if labels.isdisjoint(folder.relative_to(first).parts)
        for file in sequence_files(folder)
    ]


def read_image(path: Path, labelled_size: tuple[int, int] | None = None) -> Image | None:
    """(height, width, 3) uint8 BGR; None where it is no picture that can be read.

    It is turned as its EXIF tag says, but where it was labelled as it lies (``labelled_size``).
    """
    image = read_picture(path)
    if image is not None and labelled_size and labelled_size == image.shape[:2] != image.shape[1::-1]:
        name: Any = os.fsencode(path)  # OpenCV dies of a text that is no UTF-8
        lying = cv2.imread(name, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if lying is not None and lying.shape[:2] == labelled_size[::-1]:
            return np.asarray(lying, np.uint8)
    return image


def label_file(picture: Path, place: Path, folders: Folders) -> Path | None:
    """The file of labels of one picture of a set; None where there is none."""
    found = (folders.find(path) for path in _candidates(picture, place))
    return next((file for file in found if file is not None and file.is_file()), None)


def check_unread(place: Path, pictures: Sequence[Path], used: Iterable[Path]) -> str:
    """A sentence on the files of a set that look like labels of its pictures and are not among those ``used``.

    It is empty where there are none. Raises `UserError` where none was used and the place, or a folder of its
    pictures, holds labels of a kind that is not read.
    """
    place, known = place.absolute(), {path.absolute() for path in used}
    pictures = [one.absolute() for one in pictures]
    homes = Counter(one.parent for one in pictures)
    near = dict.fromkeys((place, *homes))
    named = [
        (folder / name, f"labels of {kind}")
        for folder in dict.fromkeys((*near, *(home.parent for home in homes)))
        for name, kind in _OTHER.items()
        if "." in name
        or folder.is_relative_to(place)  # a folder beside the one that is given may have any name
    ]
    named += [(file.with_suffix(".json"), "labels of LabelMe") for file in pictures[:_DEPTH]]
    sure = {path: what for path, what in named if path.exists() and not _holds_camera_poses(path)}
    folders = dict.fromkeys((*homes, *_open_folders(place, _DEPTH)))
    beside = [one for home in homes for one in home.parent.glob(f"{escape(home.name)}[._]*")]
    files = (one for folder in folders for one in sorted(folder.iterdir()))
    names, sizes = {os.fsencode(one.name) for one in pictures}, {len(pictures), *homes.values()}
    stems = set() if known else {one.stem for one in pictures}
    parts = {home.name: count for home, count in homes.items()}
    kinds = {(path.parent, path.suffix) for path in known}
    unread = []
    for path in islice((one for one in (*files, *beside) if _may_hold_labels(one, known)), _LOOKED_INTO):
        alike = path.stem in stems or (path.parent, path.suffix) in kinds
        with suppress(OSError), path.open("rb") as opened:
            listed, suffix = opened.read(_LIST).replace(b"\0", b""), path.suffix.lower()
            start = listed[:_LOOKED_AT]
            if suffix in _OTHER_FILES and _OTHER_WORDS.search(start):
                if path.parent in (homes if known else near):
                    sure.setdefault(path, "labels, it seems")
                elif alike or not names.isdisjoint(_WORDS.split(start)):
                    unread.append(path)
            elif suffix == _PACKED:
                unread.append(path)
            elif suffix in _TABLES and not _POSES.search(
                os.fsencode(f"{path.name}\n") + start.partition(b"\n")[0]
            ):
                rows = len(_BOX.findall(listed))
                # UAV123 has a list, and one for each part, of a folder of that name.
                is_part = rows < parts.get(_PART.sub("", path.stem), 0)
                if (rows > 1 and (rows in sizes or is_part)) or _has_boxes(start, names, alike=alike):
                    unread.append(path)
    if sure and not known:
        path, what = next(iter(sure.items()))
        raise UserError(f"{path} holds {what}, which are not read: export them as COCO, YOLO or Pascal VOC")
    unread = [*dict.fromkeys((*sure, *unread))]
    if not unread:
        return ""
    return (
        f"{len(unread)} files were not read as labels, the first: {unread[0]}; accepted are YOLO's, Pascal VOC's or "
        "VisDrone's of a picture by its name, and COCO's JSON"
    )


def _may_hold_labels(path: Path, known: Container[Path]) -> bool:
    named = path.suffix.lower() in (*_OTHER_FILES, *_TABLES, _PACKED) and not path.name.startswith(_NO_LABELS)
    return named and path not in known and path.is_file()


def _has_boxes(text: bytes, names: Container[bytes], *, alike: bool) -> bool:
    # Four numbers behind the name of a picture; of a file called like one of labels a name is not asked for.
    for words in map(_WORDS.split, text.splitlines()):
        first = 0 if alike else next((at for at, word in enumerate(words, 1) if word in names), len(words))
        if sum(bool(_IS_NUMBER.fullmatch(word)) for word in words[first:]) >= 4:
            return True
    return False


def _holds_camera_poses(path: Path) -> bool:
    # Of TUM RGB-D, beside its folders of pictures: 1305031098.66 1.35 0.63 1.63 0.65 0.61 -0.29 -0.32
    if path.name == "groundtruth.txt":
        with suppress(OSError), path.open("rb") as file:
            return b"," not in file.read(_LOOKED_AT)
    return False


def class_file(place: Path, pictures: list[Path]) -> Path | None:
    """The file that names the classes of YOLO's labels."""
    above = (place.parent, place.parent / "labels", place.parent.parent)
    folders = dict.fromkeys((place, place / "labels", *(file.parent for file in pictures[:1]), *above))
    for folder in folders:
        for name in _CLASSES:
            if (folder / name).is_file():
                return folder / name
    return next(iter(sorted(place.glob("[!.]*.yaml"))), None)


def read_class_file(path: Path) -> tuple[str, ...]:
    """Names one a line, or ``names`` of YOLO's YAML, a list or a table by number; `UserError` where none is."""
    if path.suffix not in YAML:
        return read_labels(path)
    names = table_names(_read_yaml(path).get("names"))
    if not names:
        raise UserError(f"{path} has no class names; accepted is names: with a list, or a table by number")
    return names


def coco_files(place: Path) -> list[Path]:
    """COCO's files of a set: those of usual names, and of ``annotations/``."""
    folders = _open_folders(place, 1)
    found = [folder / name for folder in folders for name in _COCO if (folder / name).is_file()]
    files, beside = (
        [one for one in sorted(folder.glob("[!.]*.json")) if not one.name.startswith(_NO_OBJECTS)]
        for folder in (place / "annotations", place)
    )
    found += [one for one in files if one.name.startswith(_COCO_BOXES)] or files
    return found or [one for one in beside if _is_coco(one)]


def _is_coco(path: Path) -> bool:
    text = path.read_bytes()
    return all(f'"{word}"'.encode() in text for word in ("images", "annotations", "categories"))


def yaml_folders(path: Path) -> list[Path]:
    """Where the pictures of a YOLO set are: its ``path``, else beside it, else in ``train``, ``val`` and ``test``."""
    said = _read_yaml(path)
    root = path.parent.joinpath(*_words(said.get("path", ()))[:1])
    if root != path.parent and root.is_dir():
        return [root]
    named = [word for part in ("train", "val", "test") for word in _words(said.get(part, ()))]
    places = dict.fromkeys(place for one in named if (place := (root / one).resolve()).is_dir())
    outer = [one for one in places if places.keys().isdisjoint(one.parents)]
    here = path.parent.resolve()
    elsewhere = any(here not in (one, *one.parents) for one in outer)
    return outer if elsewhere else [path.parent] if pictures_below(path.parent) else outer or [root]


def keypoint_columns(path: Path | None) -> int:
    """Columns of keypoints behind the box in YOLO's labels, as ``kpt_shape`` of its YAML says; 0 for none."""
    if path is None or path.suffix not in YAML:
        return 0
    shape = _words(_read_yaml(path).get("kpt_shape", ()))
    known = len(shape) == 2 and all(one.isdecimal() for one in shape)
    return int(shape[0]) * int(shape[1]) if known else 0


def _read_yaml(path: Path) -> dict[str, Any]:
    """A table whose words are all text; `UserError` where the file is no YAML. Anything but a table is empty."""
    import yaml  # noqa: PLC0415 - of the study alone; hvt-study sweep runs where only the edge is installed

    try:
        found = yaml.load(label_text(path), yaml.BaseLoader)  # noqa: S506 - makes text, lists and tables alone
    except (yaml.YAMLError, RecursionError) as error:
        said = " ".join(str(error).split())
        raise UserError(f"{path} is no YAML ({said}): mend it, or name the classes in classes.txt") from None
    return found if isinstance(found, dict) else {}


def _words(value: object) -> list[str]:
    """Words in a word or a list; none in anything else."""
    every = [value] if isinstance(value, str) else list(value) if isinstance(value, list | tuple) else []
    return [one for one in every if isinstance(one, str)]


def _folders(root: Path, depth: int) -> list[Path]:
    """A folder and those below it, so many levels; hidden ones, and those that may not be seen, are left out."""
    try:
        inside = root.iterdir() if depth else ()
        inner = sorted(one for one in inside if one.is_dir() and not one.name.startswith("."))
    except OSError:
        inner = []
    return [root, *(found for one in inner for found in _folders(one, depth - 1))]


def _open_folders(root: Path, depth: int) -> list[Path]:
    return [one for one in _folders(root, depth) if os.access(one, os.R_OK | os.X_OK)]


def _candidates(picture: Path, place: Path) -> Iterator[Path]:
    """In the folder that stands in place of that of the pictures, wherever it is in the path; then beside."""
    parts = picture.relative_to(place).parts if picture.is_relative_to(place) else picture.parts[-1:]
    whole = place.absolute()  # the folder of the pictures itself may be given
    above = [(up, (*whole.relative_to(up).parts, *parts)) for up in whole.parents[:2]]
    for folder, suffix in _LABELS:
        for root, inner in [(place, parts), *above]:
            yield from _instead(root, inner, folder, suffix)
    for suffix in (".txt", ".xml"):
        yield picture.with_suffix(suffix)
    yield picture.with_name(f"{picture.name}.txt")


def _instead(root: Path, parts: tuple[str, ...], folder: str, suffix: str) -> Iterator[Path]:
    """``folder`` in place of one of pictures that is among the parts of a picture's path below ``root``."""
    known = [name.lower() for name in _PICTURES]
    for index, part in enumerate(parts[:-1]):
        if part.lower() in known:
            yield root.joinpath(*parts[:index], folder, *parts[index + 1 :]).with_suffix(suffix)
    yield root.joinpath(folder, *parts).with_suffix(suffix)


@dataclass(frozen=True, slots=True)
class VocFile:
    """One file."""

    size: tuple[int, int] | None
    """(width, height) of the picture as labelled; None where it does not say."""
    objects: tuple[tuple[str, tuple[float, ...]], ...]
    """Class and x1 y1 x2 y2 in pixels; NaN where the file has no number. VOC's difficult ones are of class so."""


def read_voc(path: Path) -> VocFile:
    """Read a file; `UserError` where it is no such XML."""
    try:
        content = files.read_bytes(path)
        if b"<!ENTITY" in content.replace(b"\0", b""):  # in UTF-16 too
            raise UserError(f"{path} is not an XML of Pascal VOC (it has entities)")
        root = ET.fromstring(content)  # noqa: S314 - no entities; in the encoding that it says
        for one in root.iter():  # Esri's tools write XMin
            one.tag = one.tag.rpartition("}")[2].lower()
        if root.tag != "annotation" and root.find(".//object") is None:
            raise UserError(
                f"{path} is not an XML of Pascal VOC (its root is {root.tag:.60}, not annotation)"
            )
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from None
    except (ET.ParseError, ValueError, LookupError) as error:
        raise UserError(f"{path} is not an XML of Pascal VOC ({error})") from None
    sides = tuple(int(number_of(root.findtext(f"size/{side}"))) for side in ("width", "height"))
    size = (sides[0], sides[1]) if min(sides) > 0 else None
    corners = ("xmin", "ymin", "xmax", "ymax")
    return VocFile(
        size,
        tuple(
            (
                "difficult" if number_of(one.findtext("difficult")) else (one.findtext("name") or "").strip(),
                tuple(
                    number_of(one.findtext(f"bndbox/{corner}"), missing=float("nan")) for corner in corners
                ),
            )
            for one in root.iter("object")
        ),
    )


def class_word(name: object) -> str:
    """The name of a class on one line that a terminal can hold; empty where there is none."""
    return shown_text(" ".join(str(name or "").split()))


def number_of(text: str | None, *, missing: float = 0.0) -> float:
    try:
        value = float((text or "").replace(",", "."))
    except ValueError:
        return missing
    return value if math.isfinite(value) else missing


YOLO_COLUMNS = 5
_MOST_COLUMNS = 6
"""With a confidence, as trackers and annotators add it; more is a polygon."""
_LEAST_POLYGON = 7
_VISIBLE = 2
"""Greatest third number of a keypoint; coordinates of polygons are larger."""
_MOST_SHARE = 2.0
"""A number beyond is no share of a picture: the file counts in pixels."""


def yolo_names(root: Path, classes: Sequence[str] | None, pictures: Sequence[Path] = ()) -> Sequence[str]:
    """The given names, else those of ``classes.txt``, ``obj.names`` or ``data.yaml``; `UserError` where none is."""
    if classes is not None:
        return classes
    path = class_file(root, list(pictures))
    if path is None:
        raise UserError(
            f"{root} has labels, but no classes.txt, obj.names or data.yaml, there or in labels/: add one, one name a"
            " line, or give --classes"
        )
    return read_class_file(path)


def read_yolo(
    path: Path, names: Sequence[str], size: tuple[int, int], doubts: LabelDoubts, *, keypoints: int = 0
) -> FrameLabels:
    """The labels of a picture of this (width, height), in its pixels: rows of boxes, or of polygons.

    Behind the boxes there may be so many columns of ``keypoints``, which are no polygon. Boxes that end outside the
    picture are cut, and impossible rows are left out; ``doubts`` counts both.
    """
    rows = []
    doubts.classes = len(names)
    for number, line in enumerate(label_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            kind, *corners = _yolo_row(path, number, line, keypoints)
            doubts.kinds.add(kind)
            if kind not in range(len(names)):
                raise UserError(f"{path}, line {number} has class {kind:g}; there are {len(names)}, from 0")  # noqa: TRY301
        except UserError as error:
            doubts.leave_out(str(error))
            continue
        rows.append((names[int(kind)], corners, f"{path}, line {number}"))
    return doubts.labels(rows, size, size)


def _yolo_row(path: Path, number: int, line: str, keypoints: int) -> list[float]:
    """Class and x1 y1 x2 y2 as shares of the picture."""
    try:
        row = [float(word.replace(",", ".")) for word in line.split()]
    except ValueError:
        row = []
    if _has_keypoints(row, keypoints):
        row = row[:YOLO_COLUMNS]
    polygon = len(row) >= _LEAST_POLYGON and len(row) % 2 == 1
    if not (YOLO_COLUMNS <= len(row) <= _MOST_COLUMNS or polygon) or not all(map(math.isfinite, row)):
        raise UserError(f"{path}, line {number} is {line[:60]!r}; accepted is class cx cy w h, all numbers")
    if polygon:
        box = [min(row[1::2]), min(row[2::2]), max(row[1::2]), max(row[2::2])]
    else:
        cx, cy, wide, high = row[1:YOLO_COLUMNS]
        box = [cx - wide / 2, cy - high / 2, cx + wide / 2, cy + high / 2]
    if not all(abs(value) <= _MOST_SHARE for value in row[1 : None if polygon else YOLO_COLUMNS]):
        raise UserError(
            f"{path}, line {number} has a box outside the picture: {line[:60]!r}; 0 to 1 is accepted"
        )
    return [row[0], *box]


def _has_keypoints(row: Sequence[float], columns: int) -> bool:
    """Whether keypoints follow the box: so many columns, or triples of which each ends in 0, 1 or 2."""
    points = row[YOLO_COLUMNS:]
    third = points[2::3]
    triples = len(points) % 3 == 0 and _VISIBLE in third and set(third) <= {0, 1, _VISIBLE}
    return triples or (columns > 0 and len(points) == columns)
