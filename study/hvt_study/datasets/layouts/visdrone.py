"""VisDrone's video layouts (VID and MOT, https://github.com/VisDrone/VisDrone-Dataset), and UAVDT's for tracking.

::

    ROOT/sequences/uav0000086_00000_v/0000001.jpg …
    ROOT/annotations/uav0000086_00000_v.txt        frame,id,x,y,w,h,score,category,truncation,occlusion

ROOT may also hold several such folders, as the downloads unpack (VisDrone2019-VID-train, …-val). UAVDT is of Du et
al., The Unmanned Aerial Vehicle Benchmark, ECCV 2018::

    ROOT/UAV-benchmark-M/M0203/img000001.jpg …
    ROOT/UAV-benchmark-MOTD_v1.0/GT/M0203_gt_whole.txt    frame,id,x,y,w,h,out-of-view,occlusion,category
    ROOT/UAV-benchmark-MOTD_v1.0/GT/M0203_gt_ignore.txt   frame,id,x,y,w,h,…: regions that nobody has labelled
    ROOT/UAV-benchmark-MOTD_v1.0/GT/M0203_gt.txt          frame,id,x,y,w,h,1,1,-1: without classes, for tracking
    ROOT/M_attr/test/M0203_attr.txt                       ten times 0 or 1

Only the names of folders M0203 and files matter, not where below ROOT they lie. Categories are 1 car, 2 truck, 3 bus.
Pixels count from 0. Where only ``_gt.txt`` is there, all objects are of class ``vehicle``: it is ``_gt_whole``
without objects that leave the frame.
"""

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from hvt_common.errors import UserError
from hvt_study.datasets.annotation_rows import read_rows
from hvt_study.datasets.class_map import VEHICLE
from hvt_study.datasets.label_files import in_any_case
from hvt_study.datasets.label_table import LabelTable, Regions, TableLabels, video_table
from hvt_study.datasets.labels import no_boxes, no_ids
from hvt_study.datasets.layouts.image_sequence import ImageSequence, find_folders
from hvt_study.datasets.layouts.options import Options, missing_labels
from hvt_study.datasets.sequence import Sequence

_FPS = 30.0
"""The datasets do not say; VisDrone's drones filmed at 24 to 30."""
_LAYOUT = "sequences/NAME/0000001.jpg and annotations/NAME.txt"


def open_visdrone(root: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every sequence by name, opened when called.

    Raises `UserError` where ROOT is not laid out so, or annotations are missing.
    """
    every = (in_any_case(folder / "sequences") for folder in find_folders(root, depth=1))
    splits = [folder for folder in every if folder.is_dir()]
    if not splits:
        images = in_any_case(root / "images").is_dir()
        hint = ": these are images, use still:" if images else f": expected is {_LAYOUT}"
        raise UserError(f"VisDrone folder {root} has no folder sequences{hint}")
    found: dict[str, Callable[[], Sequence]] = {}
    for sequences in splits:
        split = sequences.parent
        for folder in find_folders(sequences, depth=1)[1:]:
            name = folder.name if folder.name not in found else f"{split.name}/{folder.name}"
            annotations = in_any_case(split / "annotations" / f"{folder.name}.txt")
            found[name] = partial(_open, name, folder, annotations, options)
    if not found:
        raise UserError(f"VisDrone folder {splits[0]} is empty: expected is {_LAYOUT}")
    return found


def _open(name: str, folder: Path, annotations: Path, options: Options) -> Sequence:
    images = ImageSequence(folder)
    labels = None
    if options.annotated:
        if not annotations.is_file():
            raise missing_labels(f"VisDrone sequence {folder}", annotations)
        labels = TableLabels(video_table, (annotations, images.size), images.first_number)
    return images.sequence(name=name, dataset="visdrone", fps=options.fps or _FPS, labels=labels)


_NAMES = ("car", "truck", "bus")
_SEQUENCE = re.compile(r"M[0-9]{4}", re.IGNORECASE)
_DEPTH = 3
_ATTRIBUTES = (
    *(("weather", word) for word in ("daylight", "night", "fog")),
    *(("altitude", word) for word in ("low", "medium", "high")),
    *(("view", word) for word in ("front", "side", "bird")),
    ("duration", "long-term"),
)
"""The columns of an attribute file, in their order."""


def open_uavdt(root: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every sequence by name, opened when called.

    Raises `UserError` where ROOT is not laid out so, or annotations are missing.
    """
    folders = [root] if _SEQUENCE.fullmatch(root.name) else _folders(root)
    sequences = {folder.name: folder for folder in reversed(folders) if _SEQUENCE.fullmatch(folder.name)}
    if not sequences:
        raise UserError(
            f"UAVDT folder {root} has no sequences: expected are folders M0203 with img000001.jpg …"
        )
    places = [*folders, root.parent]
    texts = {file.name.lower(): file for one in places for file in sorted(one.glob("*_*.[tT][xX][tT]"))}
    ordered = sorted(sequences.items())
    return {name: partial(_open_uavdt, name, folder, texts, options) for name, folder in ordered}


def uavdt_table(whole: Path, ignore: Path, size: tuple[int, int]) -> LabelTable:
    """All labels of a sequence; ``whole`` may be a ``_gt.txt``, and ``ignore`` may be missing."""
    rows = read_rows(
        whole, columns="frame,id,x,y,w,h,out-of-view,occlusion,category", least=9, of_dataset=True
    )
    plain = not whole.name.lower().endswith("_gt_whole.txt")
    if not plain:
        rows = rows.only(
            np.isin(rows["category"], (1, 2, 3)), accepted="a category of 1 car, 2 truck or 3 bus in column 9"
        )
    kinds = np.zeros(len(rows), np.int64) if plain else rows["category"].astype(np.int64) - 1
    names, every = (VEHICLE,) if plain else _NAMES, np.ones(len(rows), np.bool_)
    return LabelTable.of(rows, every, kinds, names, ignored=_regions(ignore), size=size)


def _folders(root: Path) -> list[Path]:
    """Those in which something may lie; sequences are not looked into."""
    found, level = [root], [root]
    for _ in range(_DEPTH):
        inner = [folder for parent in level for folder in find_folders(parent, depth=1)[1:]]
        found += inner
        level = [folder for folder in inner if not _SEQUENCE.fullmatch(folder.name)]
    return found


def _open_uavdt(name: str, folder: Path, texts: Mapping[str, Path], options: Options) -> Sequence:
    inner = (in_any_case(folder / one) for one in ("img1", "images"))
    inside = next((one for one in inner if one.is_dir()), folder)
    images = ImageSequence(inside)
    labels = None
    if options.annotated:
        begin = name.lower()
        whole = texts.get(f"{begin}_gt_whole.txt") or texts.get(f"{begin}_gt.txt")
        if whole is None:
            raise missing_labels(f"UAVDT sequence {folder}", f"{name}_gt_whole.txt")
        ignore = texts.get(f"{begin}_gt_ignore.txt", whole.with_name(f"{name}_gt_ignore.txt"))
        labels = TableLabels(uavdt_table, (whole, ignore, images.size), images.first_number)
    attributes = _attributes(texts.get(f"{name.lower()}_attr.txt"))
    fps = options.fps or _FPS
    return images.sequence(name=name, dataset="uavdt", fps=fps, labels=labels, attributes=attributes)


def _regions(path: Path) -> Regions:
    if not path.is_file():  # some copies of the dataset come without
        return Regions(no_ids(), no_boxes(), np.empty(0, np.bool_))
    rows = read_rows(path, columns="frame,region,x,y,w,h", least=6, of_dataset=True)
    every = np.ones(len(rows), np.bool_)
    return Regions.of(rows, every, every)


def _attributes(path: Path | None) -> dict[str, str]:
    """``{"weather": "daylight", "altitude": "low", …}``; empty without a file."""
    if path is None:
        return {}
    rows = read_rows(
        path, columns=",".join(word for _, word in _ATTRIBUTES), least=len(_ATTRIBUTES), frames=False
    )
    found: dict[str, str] = {}
    for (kind, word), value in zip(_ATTRIBUTES, rows.table[:1].ravel().tolist(), strict=False):
        if value:
            found[kind] = f"{found[kind]}, {word}" if kind in found else word
    return found
