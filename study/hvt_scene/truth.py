"""The exact ground truth of a scene, and its file in the layout of MOTChallenge."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hvt_common.files import at_once
from hvt_common.units import exact_rate
from hvt_common.values import Boxes, View


@dataclass(frozen=True, slots=True)
class Truth:
    """The objects in the picture at one moment, as parallel arrays ordered by id."""

    ids: npt.NDArray[np.int64]
    """(N,) one for each object, the same for the whole clip, from 1."""
    boxes_source_px: Boxes
    """(N, 4) float32, tight around the body (not its shadow), clipped to the frame; under a tree the whole body."""
    class_ids: npt.NDArray[np.int32]
    """(N,) index into the scene's ``class_names``."""
    visible: npt.NDArray[np.float32]
    """(N,) share of the body that is inside the frame and not under a canopy, 0…1."""

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class CodeInView:
    """A code painted on a roof, at one moment."""

    object_id: int
    """As in `Truth.ids`."""
    text: str
    corners_source_px: npt.NDArray[np.float32]
    """(4, 2) of the characters: where reading begins, then along the line, and round. They may lie outside."""
    visible: float
    """Share that is inside the frame and not under a canopy, 0…1."""

    @property
    def height_px(self) -> float:
        """Height of the characters, source pixels."""
        return float(np.linalg.norm(self.corners_source_px[3] - self.corners_source_px[0]))

    @property
    def box_source_px(self) -> Boxes:
        """(4,) float32 x1 y1 x2 y2 around the characters."""
        corners = self.corners_source_px
        return np.concatenate([corners.min(0), corners.max(0)])


class TruthSource(Protocol):
    """The parts of a scene that `write_truth` needs."""

    duration_s: float

    def truth(self, t_s: float) -> Truth: ...


def frame_times(duration_s: float, fps: float) -> Iterator[tuple[int, float]]:
    """(index, seconds) of every frame of a clip at that rate, the last one before ``duration_s``."""
    rate = exact_rate(fps)
    index = 0
    while index / rate < duration_s:
        yield index, float(index / rate)
        index += 1


def write_truth(scene: TruthSource, path: Path, *, fps: float, view: View) -> int:
    """Write the truth as MOTChallenge's gt.txt, in base pixels, and return the number of lines.

    A line is ``frame,id,x,y,w,h,1,class,visibility``: frames and classes count from 1 (class 1 is the scene's
    first name), x y w h in pixels of the base frame, clipped to it; objects wholly outside it are left out.
    """
    lines: list[str] = []
    wide, high = view.base_size
    for index, t_s in frame_times(scene.duration_s, fps):
        truth = scene.truth(t_s)
        boxes = np.clip(view.to_base(truth.boxes_source_px), 0, (wide, high, wide, high))
        for number, box, kind, share in zip(truth.ids, boxes, truth.class_ids, truth.visible, strict=True):
            x, y, w, h = box[0], box[1], box[2] - box[0], box[3] - box[1]
            if w > 0 and h > 0:
                lines.append(
                    f"{index + 1},{number},{x:.2f},{y:.2f},{w:.2f},{h:.2f},1,{kind + 1},{share:.3f}\n"
                )
    with open(path, "w", encoding="ascii", opener=at_once) as file:
        file.writelines(lines)
    return len(lines)
