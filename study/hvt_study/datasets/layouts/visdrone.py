"""VisDrone's video layouts (VID and MOT, https://github.com/VisDrone/VisDrone-Dataset).

::

    ROOT/sequences/uav0000086_00000_v/0000001.jpg …
    ROOT/annotations/uav0000086_00000_v.txt        frame,id,x,y,w,h,score,category,truncation,occlusion

ROOT may also hold several such folders, as the downloads unpack (VisDrone2019-VID-train, …-val).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from hvt_common.errors import UserError
from hvt_study.datasets.label_table import TableLabels, video_table
from hvt_study.datasets.layouts.image_sequence import ImageSequence, find_folders
from hvt_study.datasets.layouts.options import Options, missing_labels
from hvt_study.datasets.sequence import Sequence

_FPS = 30.0
"""The dataset does not say; its drones filmed at 24 to 30."""
_COLUMNS = "frame,id,x,y,w,h,score,category,truncation,occlusion"
_LAYOUT = "sequences/NAME/0000001.jpg and annotations/NAME.txt"


def open_visdrone(root: Path, options: Options) -> Mapping[str, Callable[[], Sequence]]:
    """Every sequence by name, opened when called.

    Raises `UserError` where ROOT is not laid out so, or annotations are missing.
    """
    splits = [folder for folder in find_folders(root, depth=1) if (folder / "sequences").is_dir()]
    if not splits:
        hint = ": these are images, use still:" if (root / "images").is_dir() else f": expected is {_LAYOUT}"
        raise UserError(f"VisDrone folder {root} has no folder sequences{hint}")
    found: dict[str, Callable[[], Sequence]] = {}
    for split in splits:
        for folder in find_folders(split / "sequences", depth=1)[1:]:
            name = folder.name if folder.name not in found else f"{split.name}/{folder.name}"
            annotations = split / "annotations" / f"{folder.name}.txt"
            found[name] = partial(_open, name, folder, annotations, options)
    if not found:
        raise UserError(f"VisDrone folder {splits[0] / 'sequences'} is empty: expected is {_LAYOUT}")
    return found


def _open(name: str, folder: Path, annotations: Path, options: Options) -> Sequence:
    images = ImageSequence(folder)
    labels = None
    if options.annotated:
        if not annotations.is_file():
            raise missing_labels(f"VisDrone sequence {folder}", annotations)
        labels = TableLabels(video_table, (annotations, images.size), images.first_number)
        _check_frames(labels, annotations)
    return images.sequence(name=name, dataset="visdrone", fps=options.fps or _FPS, labels=labels)


def _check_frames(labels: TableLabels, annotations: Path) -> None:
    last_frame = labels.table().last_frame
    if last_frame < 0:
        raise UserError(f"annotations {annotations} are empty: expected are lines of {_COLUMNS}")
    if last_frame < labels.first_frame:
        raise UserError(f"annotations {annotations} speak of no frame from {labels.first_frame} on")
