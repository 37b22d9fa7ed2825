"""What a VisDrone annotation means, in its image layout (DET) and its video layouts (VID, MOT).

DET is ``x,y,w,h,score,category,truncation,occlusion``; VID and MOT put ``frame,id`` in front. Category 0 is a region
whose objects nobody has labelled, 1 to 10 are `VISDRONE_NAMES`, 11 is "others". A score of 0 means that the object
does not count (https://github.com/VisDrone/VisDrone2018-DET-toolkit).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hvt_common.inference.class_names import VISDRONE_NAMES
from hvt_study.datasets.annotation_rows import Rows, read_rows
from hvt_study.datasets.label_table import LabelTable, Regions
from hvt_study.datasets.labels import FrameLabels

_OBJECT = "x,y,w,h,score,category,truncation,occlusion"
_REGION, _OTHERS = 0, 11


def image_labels(path: Path, size: tuple[int, int]) -> FrameLabels:
    """Of one image of this (width, height); what is wrong is left out. `UserError` where all is."""
    table = _table(read_rows(path, columns=_OBJECT, least=6, frames=False, of_dataset=True), size)
    return table.at(-1)  # the value of a column that the file does not have


def video_table(path: Path, size: tuple[int, int]) -> LabelTable:
    """Of one sequence of pictures of this (width, height); what is wrong is left out. `UserError` where all is."""
    return _table(read_rows(path, columns=f"frame,id,{_OBJECT}", least=10, of_dataset=True), size)


def _table(rows: Rows, size: tuple[int, int]) -> LabelTable:
    """Objects that are asked for, and what is not: regions, and single objects ("others", and those of score 0)."""
    column = rows.columns.index("category") + 1
    rows = rows.only(
        np.isin(rows["category"], np.arange(_OTHERS + 1)),
        accepted=f"a category from 0 to {_OTHERS} in column {column}",
    )
    category, frames, boxes = rows["category"].astype(np.int64), rows["frame"].astype(np.int64), rows.boxes()
    judged = (category >= 1) & (category <= len(VISDRONE_NAMES)) & (rows["score"] != 0)
    return LabelTable.of(
        frames=frames[judged],
        boxes=boxes[judged],
        ids=rows["id"].astype(np.int64)[judged],
        class_ids=category[judged] - 1,
        class_names=VISDRONE_NAMES,
        ignored=Regions(frames[~judged], boxes[~judged], category[~judged] == _REGION),
        size=size,
    )
