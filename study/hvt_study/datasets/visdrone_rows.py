"""What a VisDrone annotation means, in its image layout (DET) and its video layouts (VID, MOT).

DET is ``x,y,w,h,score,category,truncation,occlusion``; VID and MOT put ``frame,id`` in front. Category 0 is a region
whose objects nobody has labelled, 1 to 10 are `VISDRONE_NAMES`, 11 is "others". A score of 0 means that the object
does not count (https://github.com/VisDrone/VisDrone2018-DET-toolkit).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_common.values import Boxes
from hvt_study.datasets.annotation_rows import Rows, read_rows

_OBJECT = "x,y,w,h,score,category,truncation,occlusion"
_REGION, _OTHERS = 0, 11


@dataclass(frozen=True, slots=True)
class VisDroneRows:
    """The rows of a file, in its order."""

    frames: npt.NDArray[np.int64]
    """(N,) numbers as in the file; 0 in DET."""
    ids: npt.NDArray[np.int64]
    """(N,); -1 in DET."""
    boxes: Boxes
    """(N, 4) x1 y1 x2 y2 pixels."""
    categories: npt.NDArray[np.int64]
    """(N,) 0…11."""
    counts: npt.NDArray[np.bool_]
    """(N,) True for an object that is asked for; the others are regions and objects to be passed over."""
    land: npt.NDArray[np.bool_]
    """(N,) True for a region whose objects nobody has labelled."""


def read_image_rows(path: Path) -> VisDroneRows:
    """Of one image; what is wrong is left out. `UserError` where all is."""
    return _meant(read_rows(path, columns=_OBJECT, least=6, frames=False, of_dataset=True))


def read_video_rows(path: Path) -> VisDroneRows:
    """Of one sequence; what is wrong is left out. `UserError` where all is."""
    return _meant(read_rows(path, columns=f"frame,id,{_OBJECT}", least=10, of_dataset=True))


def _meant(rows: Rows) -> VisDroneRows:
    column = rows.columns.index("category") + 1
    rows = rows.only(
        np.isin(rows["category"], np.arange(_OTHERS + 1)),
        accepted=f"a category from 0 to {_OTHERS} in column {column}",
    )
    category = rows["category"]
    judged = (category >= 1) & (category <= len(VISDRONE_NAMES)) & (rows["score"] != 0)
    frames = rows["frame"] if "frame" in rows.columns else np.zeros(len(rows))
    return VisDroneRows(
        frames=frames.astype(np.int64),
        ids=rows["id"].astype(np.int64),
        boxes=rows.boxes(),
        categories=category.astype(np.int64),
        counts=judged,
        land=category == _REGION,
    )
