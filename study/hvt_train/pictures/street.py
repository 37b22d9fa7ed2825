"""Clips without labels: a detector that knows the world names what it is sure of, and trains what it starts.

A network that begins with COCO's weights sees people and vehicles aslant and from near. Pictures from above alone
would make it forget them; these clips keep them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.inference.detect import Detector
from hvt_common.values import Image, iou
from hvt_scene.drawing.vehicles import CLASS_NAMES
from hvt_train.pictures.places import Picture

__all__ = ["street_pictures"]

_NAMES = {
    "person": "pedestrian",
    "car": "car",
    "truck": "truck",
    "bus": "bus",
    "motorcycle": "motor",
    "bicycle": "motor",
}
_SURE, _SAME = 0.5, 0.6
_ENLARGED = (1.0, 1.75)


def street_pictures(folder: Path, teacher: Detector, *, every: int = 2) -> Iterator[Picture]:
    """Every n-th picture of the clips in ``folder`` with what ``teacher`` names there.

    The teacher should show what it finds from a low confidence on (0.08): below 0.5 it counts neither way.
    """
    for clip in sorted(path for path in folder.iterdir() if path.suffix in {".gif", ".mp4"}):
        with av.open(str(clip)) as container:
            for number, frame in enumerate(container.decode(video=0)):
                if number % every == 0:
                    image = np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
                    boxes, kinds = _named(image, teacher)
                    yield Picture(image, boxes, kinds, np.ones(len(kinds), np.float32))


def _named(image: Image, teacher: Detector) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """(N, 4) boxes and (N,) classes, -1 where the teacher is unsure, of the picture as it is and enlarged."""
    rows: list[tuple[float, str, npt.NDArray[np.float32]]] = []
    for scale in _ENLARGED:
        how = cv2.INTER_CUBIC
        found = teacher.detect(
            np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=how), np.uint8)
        )
        for box, score, kind in zip(found.boxes_xyxy_px, found.confidences, found.class_ids, strict=True):
            if teacher.class_names[kind] in _NAMES:
                rows.append((float(score), teacher.class_names[kind], box / scale))
    boxes = np.empty((0, 4), np.float32)
    kinds: list[int] = []
    for score, name, box in sorted(rows, key=lambda row: -row[0]):
        if not len(boxes) or iou(box[None], boxes).max() < _SAME:
            boxes = np.vstack([boxes, box[None]]).astype(np.float32)
            kinds.append(CLASS_NAMES.index(_NAMES[name]) if score >= _SURE else -1)
    return boxes, np.array(kinds, np.int32)
