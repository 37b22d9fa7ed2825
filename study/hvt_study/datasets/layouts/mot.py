"""MOTChallenge's layout (https://motchallenge.net), which CVAT and others write, too.

::

    ROOT/MOT17-02-FRCNN/seqinfo.ini       name, imDir, frameRate, seqLength, imWidth, imHeight, imExt
    ROOT/MOT17-02-FRCNN/img1/000001.jpg …
    ROOT/MOT17-02-FRCNN/gt/gt.txt         frame,id,x,y,w,h,counts,class,visibility
    ROOT/MOT17-02-FRCNN/gt/labels.txt     names of the classes from 1 on; MOT17's where the file is missing

ROOT may be one sequence, or hold them below train/ and test/. CVAT's "MOT 1.1" has no seqinfo.ini; the frame rate is
then given with ``?fps=``. Pixels count from 1.

Which boxes count goes by TrackEval (https://github.com/JonathonLuiten/TrackEval, ``mot_challenge_2d_box.py``): in the
published sequences boxes that match distractors, static persons, reflections and persons on vehicles (on MOT20 other
vehicles, too) count neither for nor against, and anything else that is marked as not counting is nothing at all.
Where a file names its own classes, rows marked so are passed over. MOT15 has no classes: all are pedestrians,
and in place of class and visibility there is a place in the world, or -1,-1,-1.
"""

import configparser
import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Names
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.errors import UserError
from hvt_common.files import read_text
from hvt_common.inference.labels import read_labels
from hvt_common.values import Boxes
from hvt_study.datasets.annotation_rows import Rows, read_rows, usual_cells
from hvt_study.datasets.label_files import in_any_case
from hvt_study.datasets.label_table import LabelTable, Regions, TableLabels
from hvt_study.datasets.layouts.image_sequence import ImageSequence, find_folders
from hvt_study.datasets.layouts.options import Options, missing_labels
from hvt_study.datasets.sequence import Sequence

_INFO = "seqinfo.ini"
_TRUTH = "gt/gt.txt"
_PICTURES = "img1"
_COLUMNS = "frame,id,x,y,w,h,counts,class,visibility"
_LEAST_VISIBLE = 0.5
_LAYOUT = "NAME/seqinfo.ini, NAME/img1/000001.jpg and NAME/gt/gt.txt"
_NAMES = ("pedestrian", "person on vehicle", "car", "bicycle", "motor", "non-motorised vehicle")
"""MOT17's classes from 1 on that may be objects."""
_BESIDE = (2, 7, 8, 12)
"""Person on vehicle, static person, distractor, reflection."""
_BESIDE_ON_MOT20 = (*_BESIDE, 6)
"""Its cyclists and the like are labelled as non-motorised vehicles."""
_HIGHEST = 13
_PEDESTRIAN = 1
_MOT15_COLUMNS = 10


def open_mot(root: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every sequence by name, opened when called.

    Raises `UserError` where ROOT is not laid out so, or annotations are missing.
    """
    folders = [folder for folder in find_folders(root, depth=2) if _is_sequence(folder)]
    if not folders:
        raise UserError(
            f"MOTChallenge folder {root} has no sequence with a {_INFO} or gt/gt.txt: expected is {_LAYOUT}"
        )
    found: dict[str, Callable[[], Sequence]] = {}
    for folder in folders:
        short = folder.name or folder.resolve().name
        name = short if short not in found else f"{folder.parent.name}/{short}"
        found[name] = partial(_open, name, folder, options)
    return found


def mot_table(
    truth: Path, names: Path, size: tuple[int, int], beside: tuple[int, ...] = _BESIDE
) -> LabelTable:
    """All labels of a sequence; ``names`` may be missing, and ``beside`` are then classes that are not asked for."""
    rows = read_rows(truth, columns=_COLUMNS, least=7, of_dataset=True)
    own = names.is_file()
    class_names = read_labels(names) if own else _NAMES
    rows, kinds = _kinds(rows, len(class_names) if own else _HIGHEST, own=own)
    judged = rows["counts"] != 0
    passed = ~judged
    if not own:
        passed = np.isin(kinds, beside)
        judged &= ~passed & (kinds <= len(class_names))
        used = np.unique(kinds[judged])  # only pedestrians count in the published sequences
        class_names = tuple(class_names[kind - 1] for kind in used.tolist())
        kinds = np.searchsorted(used, kinds) + 1
    ignored = Regions.of(rows, passed, np.zeros(len(rows), np.bool_), origin=1.0)
    table = LabelTable.of(rows, judged, kinds - 1, class_names, ignored=ignored, size=size, origin=1.0)
    return replace(table, paired=not own, one_target=_one_target(rows))


@dataclass(frozen=True, slots=True)
class TruthRows:
    """Rows of a gt.txt whose classes are given apart, in its order."""

    frames: npt.NDArray[np.int64]
    boxes: Boxes
    """(N, 4) x1 y1 x2 y2 pixels that count from 0."""
    class_names: tuple[str, ...]
    judged: npt.NDArray[np.bool_]
    """(N,) False for boxes that do not count, and for half-hidden ones."""
    classless: bool
    """MOT15's ten columns, which name no class: all are of the only name that was given, else pedestrians."""
    one_target: bool
    """Of `LabelTable`."""


def read_truth_rows(truth: Path, names: Names[str]) -> TruthRows:
    """Rows of a file whose classes from 1 on have these names; `UserError` names the line that is wrong."""
    rows = read_rows(truth, columns=_COLUMNS, least=7)
    rows = rows.only(rows["frame"] >= 1, accepted="a frame number from 1 on")
    classless = _in_the_world(rows)
    if classless:
        known = names[0] if len(names) == 1 else _NAMES[0]
        words = (known,) * len(rows)
    else:
        rows = rows.only(
            np.isin(rows["class"], np.arange(1, len(names) + 1)), accepted=_class_text(len(names))
        )
        words = tuple(names[int(kind) - 1] for kind in rows["class"].tolist())
    judged = rows["counts"] != 0
    if not classless:
        share = rows["visibility"]
        judged &= (share >= _LEAST_VISIBLE) | (share < 0)  # -1 where the file does not say
    frames, alone = rows["frame"].astype(np.int64), _one_target(rows)
    return TruthRows(frames, rows.boxes(origin=1.0), words, judged, classless, alone)


def _class_text(highest: int) -> str:
    return f"a class from 1 to {highest} in column 8"


def _kinds(rows: Rows, highest: int, *, own: bool) -> tuple[Rows, npt.NDArray[np.int64]]:
    """The rows whose class is known, and their classes from 1 on."""
    if not own and _in_the_world(rows):
        if np.isin(rows["class"], np.arange(12)).all() and np.isin(rows["visibility"], (0, 1, 2)).all():
            raise UserError(
                f"{rows.path} has VisDrone's ten columns: lay the sequence out as visdrone: takes it"
            )
        return rows, np.full(len(rows), _PEDESTRIAN, np.int64)
    known = np.isin(rows["class"], [-1, *range(1, highest + 1)])
    rows = rows.only(known, accepted=_class_text(highest))
    return rows, np.where(rows["class"] == -1, _PEDESTRIAN, rows["class"]).astype(np.int64)


def _in_the_world(rows: Rows) -> bool:
    """Whether columns 8 to 10 are MOT15's ``x,y,z``; MOT16 and all after it have nine columns."""
    return usual_cells(rows.text) == _MOT15_COLUMNS


def _is_sequence(folder: Path) -> bool:
    return any(in_any_case(folder / one).exists() for one in (_INFO, _TRUTH, _PICTURES))


def _open(name: str, folder: Path, options: Options) -> Sequence:
    about = in_any_case(folder / _INFO)
    info = _info(about) if about.is_file() else None
    if info is None and options.fps is None:
        raise UserError(
            f"MOTChallenge sequence {folder} has no {_INFO}, which says the frame rate: "
            "add the file, or say the rate, such as ?fps=25"
        )
    said = info or {}
    images = _images(folder, said)
    fps = options.fps or _rate(about, said)
    labels = _labels(folder, said, images) if options.annotated else None
    sequence = images.sequence(name=name, dataset="mot", fps=fps, labels=labels)
    return sequence if labels is None else replace(sequence, one_target=labels.table().one_target)


def _one_target(rows: Rows) -> bool:
    """Whether it is a single-object set: all rows are of one id, once a frame, also those that do not count."""
    once = len(np.unique(rows["frame"])) == len(rows)
    return once and len(np.unique(rows["id"])) == 1 and bool(rows["id"][0] >= 0)


def _images(folder: Path, info: Mapping[str, str]) -> ImageSequence:
    pictures = in_any_case(folder / info.get("imDir", _PICTURES))
    if not pictures.is_dir():
        raise UserError(f"MOTChallenge sequence {folder} has no folder {pictures.name} of images")
    images = ImageSequence(pictures)
    said = info.get("seqLength", "")
    if said.isdecimal() and images.frame_count < int(said):
        raise UserError(
            f"MOTChallenge sequence {folder} says seqLength={said} and has {images.frame_count} images"
        )
    for side, word, found in zip(("Width", "Height"), ("wide", "high"), images.size, strict=True):
        said = info.get(f"im{side}", "")
        if said.isdecimal() and int(said) not in (0, found):
            raise UserError(
                f"MOTChallenge sequence {folder} says im{side}={said}, and its images are {found} pixels {word}: "
                "boxes would lie elsewhere; put the images back that were labelled, or correct it"
            )
    return images


def _labels(folder: Path, info: Mapping[str, str], images: ImageSequence) -> TableLabels:
    truth = in_any_case(folder / _TRUTH)
    if not truth.is_file():
        raise missing_labels(f"MOTChallenge sequence {folder}", _TRUTH)
    beside = _BESIDE_ON_MOT20 if info.get("name", folder.name).startswith("MOT20") else _BESIDE
    return TableLabels(
        mot_table,
        (truth, in_any_case(truth.with_name("labels.txt")), images.size, beside),
        images.first_number,
    )


def _info(path: Path) -> Mapping[str, str]:
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[assignment, method-assign] # the documented way to keep case
    try:
        parser.read_string(read_text(path))
        return dict(parser["Sequence"])
    except (configparser.Error, KeyError, OSError):
        raise UserError(f"{path} is not a sequence's description: expected is a section [Sequence]") from None


def _rate(path: Path, info: Mapping[str, str]) -> float:
    try:
        fps = float(info["frameRate"])
    except (KeyError, ValueError):
        fps = math.nan
    if not 0.1 <= fps <= 1000:
        raise UserError(
            f"{path} says frameRate={info.get('frameRate')}: accepted is a number from 0.1 to 1000"
        )
    return fps
