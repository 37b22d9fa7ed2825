"""The reader, and from readings to figures: which codes were read right at least once, how soon, which misread.

It is RapidOCR's text recognition, a network of others that is given a small picture and nothing else.
"""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from hvt_common.errors import needs_extra
from hvt_common.values import Image
from hvt_common.video.base_crop import resampled
from hvt_scene import CodeInView
from hvt_study.datasets.sequence import NOMINAL_FPS

_HEIGHT_PX = 48  # of a line of text, as the network takes it
_WIDTH_PX = 192
_MARGIN = 0.15


@dataclass(frozen=True, slots=True)
class Reading:
    """The reader's answer on one picture."""

    text: str
    """Capitals and digits without spaces; empty where it reads nothing."""
    confidence: float
    """0…1, by its own account."""
    picture_bgr: Image
    """The picture of the reading, turned as it was read."""


class CodeReader:
    """Reads one line of text in each picture, whichever of the four ways it is turned.

    The networks come in the package: nothing is fetched. Raises `UserError` where RapidOCR is not installed.
    """

    def __init__(self) -> None:
        with needs_extra("'hvt[reading]'"):
            rapidocr: Any = import_module("rapidocr")  # an extra that only this class needs
        self._engine = rapidocr.RapidOCR(
            params={
                "Global.log_level": "critical",
                "Rec.rec_img_shape": [3, _HEIGHT_PX, _WIDTH_PX],
                "EngineConfig.onnxruntime.intra_op_num_threads": 1,
                "EngineConfig.onnxruntime.inter_op_num_threads": 1,
            }
        )
        self._engine.update_params(use_det=False, use_cls=False, use_rec=True)
        self.name = f"rapidocr {version('rapidocr')}"

    def read(self, crops: Sequence[Image]) -> list[Reading]:
        """One reading of each crop, (h, w, 3) uint8 BGR: the more confident of the two ways in which it lies flat."""
        turned = [picture for crop in crops for picture in _lying(crop)]
        said = [self._line(picture) for picture in turned]
        return [max(pair, key=lambda one: one.confidence) for pair in zip(said[::2], said[1::2], strict=True)]

    def _line(self, picture: Image) -> Reading:
        found = self._engine(picture)
        text = "".join(found.txts or ("",)).upper().replace(" ", "")
        return Reading(text, float((found.scores or (0.0,))[0]) if text else 0.0, picture)


def code_crop(image: Image, box_px: Sequence[float]) -> Image:
    """The part of a picture around a box x1 y1 x2 y2, its shorter side enlarged to the reader's size.

    Sub-pixel exact and cubic: the coarser picture gets its best chance.
    """
    x1, y1, x2, y2 = box_px
    margin = _MARGIN * min(x2 - x1, y2 - y1)
    width, height = x2 - x1 + 2 * margin, y2 - y1 + 2 * margin
    step = min(width, height) / _HEIGHT_PX
    size = max(_HEIGHT_PX, round(width / step)), max(_HEIGHT_PX, round(height / step))
    return resampled(image, (x1 - margin, y1 - margin), (step, step), size)


def _lying(crop: Image) -> tuple[Image, Image]:
    flat = crop if crop.shape[1] >= crop.shape[0] else cv2.rotate(crop, cv2.ROTATE_90_CLOCKWISE)
    return np.asarray(flat, np.uint8), np.asarray(cv2.rotate(flat, cv2.ROTATE_180), np.uint8)


def share_inside(box_px: npt.NDArray[Any], place_px: npt.NDArray[Any]) -> float:
    """How much of a box lies in a place, both x1 y1 x2 y2, 0…1."""
    low, high = np.maximum(box_px[:2], place_px[:2]), np.minimum(box_px[2:], place_px[2:])
    return float(np.clip(high - low, 0, None).prod() / (box_px[2:] - box_px[:2]).prod())


LEAST_VISIBLE = 0.95
"""A code of which less is in the frame and under no crown cannot be asked for at that moment."""
_LEAST_FRAMES = 15
"""A code that is whole in view for less than a second is not counted."""
_SURE = 0.5


@dataclass(frozen=True, slots=True)
class Code:
    """One code of a clip."""

    object_id: int
    text: str
    first_s: float
    """Media time at which it is first in view as a whole."""
    height_px: float
    """Median of its characters, source pixels."""


@dataclass(slots=True)
class Evidence:
    """The readings of one code in one channel: grows while a flight lasts."""

    read_s: float = math.inf
    """Media time at which the picture arrived that was first read right."""
    best: Reading | None = None
    """The first right reading, or before it the most confident one; None where there is none."""

    @property
    def right(self) -> bool:
        return math.isfinite(self.read_s)

    def add(self, reading: Reading, *, code: str, at_s: float) -> None:
        """One more reading; nothing changes once one was right."""
        if self.right:
            return
        right = reading.text == code
        if right:
            self.read_s = at_s
        if right or self.best is None or reading.confidence > self.best.confidence:
            self.best = reading


@dataclass(frozen=True, slots=True)
class ChannelScore:
    """Score of one channel of one flight."""

    read: float | None
    """Share of the codes that were read right at least once; None where there are none."""
    median_s: float | None
    """Median time from coming in view to the first right reading, over all codes; None where under half were read."""
    misread: float | None
    """Share that was never read right, and once wrong with confidence as a code of the same length."""


def codes_to_read(views: Sequence[Iterable[CodeInView]]) -> dict[int, Code]:
    """The codes of a clip by object, from those in view in each of its frames; those in view for a second."""
    seen: dict[int, list[tuple[int, CodeInView]]] = {}
    for frame_index, codes in enumerate(views):
        for one in codes:
            if one.visible >= LEAST_VISIBLE:
                seen.setdefault(one.object_id, []).append((frame_index, one))
    return {
        object_id: Code(
            object_id,
            found[0][1].text,
            found[0][0] / NOMINAL_FPS,
            statistics.median(one.height_px for _, one in found),
        )
        for object_id, found in sorted(seen.items())
        if len(found) >= _LEAST_FRAMES
    }


def channel_score(codes: Iterable[Code], evidence: Mapping[int, Evidence]) -> ChannelScore:
    """The figures of these codes; a code without evidence was never shown."""
    shown = [(code, evidence.get(code.object_id, Evidence())) for code in codes]
    if not shown:
        return ChannelScore(None, None, None)
    waits = [max(0.0, one.read_s - code.first_s) for code, one in shown]
    median_s = statistics.median(waits)
    wrong = sum(
        not one.right
        and one.best is not None
        and len(one.best.text) == len(code.text)
        and one.best.confidence >= _SURE
        for code, one in shown
    )
    return ChannelScore(
        sum(one.right for _, one in shown) / len(shown),
        median_s if math.isfinite(median_s) else None,
        wrong / len(shown),
    )
