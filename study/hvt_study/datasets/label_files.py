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

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree as ET

from hvt_common.errors import UserError
from hvt_common.inference.labels import decoded, read_labels
from hvt_edge.source.folder import sequence_files

__all__ = [
    "LOOKED_IN",
    "VocFile",
    "class_file",
    "coco_files",
    "label_file",
    "pictures_below",
    "read_class_file",
    "read_text",
    "read_voc",
]

LOOKED_IN = (
    "labels/, annotations/, Annotations/, beside the pictures, and COCO's JSON in annotations/ and beside"
)
"""For sentences."""
_PICTURES = ("images", "JPEGImages", "data", "obj_train_data")
_LABELS = (("labels", ".txt"), ("annotations", ".txt"), ("Annotations", ".xml"), ("annotations", ".xml"))
_CLASSES = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml", "data.yml")
_COCO = ("labels.json", "result.json", "annotations.json", "_annotations.coco.json", "coco.json")
_DEPTH = 3


def pictures_below(place: Path) -> list[Path]:
    """All pictures of a set, folder by folder, in natural order; those of ``images/`` alone where there is one."""
    first = next((place / name for name in _PICTURES if (place / name).is_dir()), place)
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


def label_file(picture: Path, place: Path) -> Path | None:
    """The file of labels of one picture of a set; None where there is none."""
    return next((file for file in _candidates(picture, place) if file.is_file()), None)


def class_file(place: Path, pictures: list[Path]) -> Path | None:
    """The file that names the classes of YOLO's labels."""
    folders = dict.fromkeys((place, place / "labels", *(file.parent for file in pictures[:1]), place.parent))
    for folder in folders:
        for name in _CLASSES:
            if (folder / name).is_file():
                return folder / name
    return next(iter(sorted(place.glob("*.yaml"))), None)


def read_class_file(path: Path) -> tuple[str, ...]:
    """Names one a line, or ``names`` of YOLO's YAML, a list or a table by number; `UserError` where none is."""
    if path.suffix not in (".yaml", ".yml"):
        return read_labels(path)
    names = _yaml_names(read_text(path))
    if not names:
        raise UserError(f"{path} has no class names; accepted is names: with a list, or a table by number")
    return names


def coco_files(place: Path) -> list[Path]:
    """COCO's files of a set: those of usual names, and of ``annotations/``."""
    folders = _folders(place, 1)
    found = [folder / name for folder in folders for name in _COCO if (folder / name).is_file()]
    return found + sorted((place / "annotations").glob("*.json"))


def read_text(path: Path) -> str:
    """A text file; `UserError` where it cannot be read."""
    try:
        return decoded(path.read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read as text: {error}") from None


def _folders(root: Path, depth: int) -> list[Path]:
    """A folder and those below it, so many levels; hidden ones are left out."""
    inner = (
        sorted(one for one in root.iterdir() if one.is_dir() and not one.name.startswith("."))
        if depth
        else []
    )
    return [root, *(found for one in inner for found in _folders(one, depth - 1))]


def _candidates(picture: Path, place: Path) -> Iterator[Path]:
    """In the folder that stands in place of that of the pictures, wherever it is in the path; then beside."""
    parts = picture.relative_to(place).parts if picture.is_relative_to(place) else picture.parts[-1:]
    for folder, suffix in _LABELS:
        for index, part in enumerate(parts[:-1]):
            if part in _PICTURES:
                yield place.joinpath(*parts[:index], folder, *parts[index + 1 :]).with_suffix(suffix)
        yield place.joinpath(folder, *parts).with_suffix(suffix)
    yield picture.with_suffix(".txt")
    yield picture.with_suffix(".xml")


def _yaml_names(text: str) -> tuple[str, ...]:
    begin = re.search(r"(?m)^names\s*:[ \t]*(.*)$", text)
    if begin is None:
        return ()
    rest = text[begin.end() :]
    inline = re.match(r"[\[{]([^\]}]*)[\]}]", begin[1] + rest)
    if inline is not None:
        words = (word.strip() for word in inline[1].replace("\n", " ").split(","))
        numbered = inline[0].startswith("{")
        return tuple(_plain(word.partition(":")[2] if numbered else word) for word in words if word)
    names = []
    for line in rest.splitlines():
        entry = re.match(r"\s*-\s+(.+)|\s+['\"]?\d+['\"]?\s*:\s*(.+)", line)
        if entry is not None:
            names.append(_plain(entry[1] or entry[2]))
        elif line.strip() and not line.lstrip().startswith("#"):
            break
    return tuple(names)


def _plain(word: str) -> str:
    """Without quotes and a comment."""
    word = word.strip()
    if word[:1] in ("'", '"'):
        try:
            return str(ast.literal_eval(word.partition(" #")[0].strip()))
        except (ValueError, SyntaxError):
            return word.strip("'\"")
    return word.partition(" #")[0].strip()


@dataclass(frozen=True, slots=True)
class VocFile:
    """One file."""

    size: tuple[int, int] | None
    """(width, height) of the picture as labelled; None where it does not say."""
    objects: tuple[tuple[str, tuple[float, ...]], ...]
    """Class and x1 y1 x2 y2 in pixels; NaN where the file has no number."""


def read_voc(path: Path) -> VocFile:
    """Read a file; `UserError` where it is no such XML."""
    text = read_text(path)
    if "<!ENTITY" in text:
        raise UserError(f"{path} is not an XML of Pascal VOC (it has entities)")
    try:
        root = ET.fromstring(text.encode() if text.startswith("<?xml") else text)  # noqa: S314 - no entities
    except (ET.ParseError, ValueError) as error:
        raise UserError(f"{path} is not an XML of Pascal VOC ({error})") from None
    sides = tuple(int(_number(root.findtext(f"size/{side}"))) for side in ("width", "height"))
    size = (sides[0], sides[1]) if min(sides) > 0 else None
    corners = ("xmin", "ymin", "xmax", "ymax")
    return VocFile(
        size,
        tuple(
            (
                (one.findtext("name") or "").strip(),
                tuple(_number(one.findtext(f"bndbox/{corner}"), missing=float("nan")) for corner in corners),
            )
            for one in root.iter("object")
        ),
    )


def _number(text: str | None, *, missing: float = 0.0) -> float:
    try:
        return float(text or "")
    except ValueError:
        return missing
