"""The exact ground truth of a scene at one moment."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_common.values import Boxes


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
