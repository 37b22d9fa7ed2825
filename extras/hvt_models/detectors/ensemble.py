"""Several detectors on one picture, their boxes merged group by group: ``--detector aerial-nano+pvb-2003``.

Weighted boxes fusion (Solovyev, Wang and Gabruseva, Image and Vision Computing 2021): boxes of one group (vehicle,
person, see `class_names`) that overlap become one, whose sides are means weighted by confidence. The paper divides
the confidence of an object that not every detector found by their number. That suits detectors of one training set;
those here know different views, and the surest of a cluster counts (docs/embedded-models.md has both).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import group_of, kind_of
from hvt_common.inference.detect import Detector, FailingDetector
from hvt_common.inference.nms import MAX_DETECTIONS
from hvt_common.inference.retried import RetriedDetector
from hvt_common.runtime.failures import Failures
from hvt_common.values import Detections, Image

_SAME_IOU = 0.55
"""The paper's."""
_VAGUE_VOTE = 1e-6
_LEAST_WEIGHT = 1e-9
_PART_NAMES = ("detector 1", "detector 2", "detector 3")
"""As they are named to grounds: a path is private, too long for the wire, and no label of a metric."""


def on_scale_of(confidences: npt.NDArray[np.float32], own: float, wanted: float) -> npt.NDArray[np.float32]:
    """Confidences shifted, as log odds, so that ``own`` becomes ``wanted``.

    Each part has its own confidence from which a detection counts, and the ensemble has one.
    """
    if own == wanted or 1 in (own, wanted):
        return confidences
    factor = wanted / (1 - wanted) * (1 - own) / own
    sure = confidences.astype(np.float64)
    return (sure * factor / (1 - sure + sure * factor)).astype(np.float32)


def open_ensemble(
    opened: Callable[[str, float], Detector],
    owns: Mapping[str, float],
    *,
    confidence: float,
    failures: Failures | None = None,
) -> EnsembleDetector:
    """The ensemble of the parts that ``owns`` names, with their confidences of use.

    ``opened`` opens one, with the least confidence of a detection on the part's own scale. With ``failures`` one that
    raises is opened again, and the others go on.
    """
    first, least = next(iter(owns.values())), np.array([confidence], np.float32)
    parts: list[FailingDetector] = []
    for name, (part, own) in zip(_PART_NAMES, owns.items(), strict=False):
        open_one = partial(opened, part, float(on_scale_of(least, first, own)[0]))
        parts.append(open_one() if failures is None else RetriedDetector(open_one, name, failures))
    return EnsembleDetector(parts, list(owns.values()), confidence=confidence, failures=failures)


class EnsembleDetector:
    """Two or three detectors, itself one; ``owns`` are their confidences of use, the first the ensemble's.

    Its class names are those of all parts; a kind has the word of the first part that knows it. ``confidence`` is the
    least of a detection. ``failures`` lists it while all its parts fail.
    """

    def __init__(
        self,
        parts: Sequence[FailingDetector],
        owns: Sequence[float],
        *,
        confidence: float,
        failures: Failures | None = None,
    ) -> None:
        self._failures, self._failed = failures, False
        self._parts, self._owns, self._confidence = tuple(parts), tuple(owns), confidence
        names: list[str] = list(parts[0].class_names)
        kinds = [kind_of(name) for name in names]
        self._ids = [np.arange(len(names), dtype=np.int32)]
        for part in parts[1:]:
            for name in part.class_names:
                if kind_of(name) not in kinds:
                    names.append(name)
                    kinds.append(kind_of(name))
            self._ids.append(np.array([kinds.index(kind_of(name)) for name in part.class_names], np.int32))
        self.class_names = tuple(names)
        groups = [group_of(name) or name for name in names]
        self._groups = np.array([groups.index(group) for group in groups], np.int32)
        self._vague = np.array([kinds[i] == groups[i] for i in range(len(names))])

    def detect(self, image_bgr: Image) -> Detections | None:
        """Each part's detections on the confidence scale of the first, merged; None while all parts fail."""
        found: list[Detections] = []
        for part, own, ids in zip(self._parts, self._owns, self._ids, strict=True):
            if (one := part.detect(image_bgr)) is None:
                continue
            sure = on_scale_of(one.confidences, own, self._owns[0])
            found.append(Detections(one.boxes_xyxy_px, sure, ids[one.class_ids]))
        if self._failures is not None and self._failed != (not found):
            self._failed = not found
            if found:
                self._failures.works("detector")
            else:
                self._failures.failed("detector", "none of its networks works")
        if not found:
            return None
        fused = fuse(found, self._groups, self._vague)
        counts = fused.confidences >= self._confidence
        return fused.take(counts)


def fuse(
    found: Sequence[Detections], groups: npt.NDArray[np.int32], vague: npt.NDArray[np.bool_]
) -> Detections:
    """The detections of several detectors, those of one group that overlap merged into one; best first.

    Args:
        found: One list a detector, with one numbering of classes.
        groups: (C,) the group of each class.
        vague: (C,) whether the class is the name of its group: it gives way to any other (a vehicle is a truck).
    """
    boxes = np.concatenate([one.boxes_xyxy_px for one in found]).astype(np.float64)
    sure = np.concatenate([one.confidences for one in found])
    kinds = np.concatenate([one.class_ids for one in found])
    merged, weights = np.zeros((len(sure), 4)), np.zeros(len(sure))
    best, votes = np.zeros(len(sure), np.float32), np.zeros((len(sure), len(groups)))
    group = np.zeros(len(sure), np.int32)
    count = 0
    for row in np.argsort(-sure, kind="stable").tolist():
        kind = kinds[row]
        overlaps = _iou(boxes[row], merged[:count]) * (group[:count] == groups[kind])
        place = int(overlaps.argmax()) if count else 0
        if not count or overlaps[place] <= _SAME_IOU:
            place, count = count, count + 1
            best[place], group[place] = sure[row], groups[kind]
        weight = max(sure[row], _LEAST_WEIGHT)
        weights[place] += weight
        merged[place] += (boxes[row] - merged[place]) * (weight / weights[place])
        votes[place, kind] += sure[row] * (_VAGUE_VOTE if vague[kind] else 1)
    ids = votes[:count].argmax(axis=1).astype(np.int32)
    # A cluster begins with its surest box, and the surest cluster comes first.
    count = min(count, MAX_DETECTIONS)
    return Detections(merged[:count].astype(np.float32), best[:count], ids[:count])


def _iou(box: npt.NDArray[np.float64], others: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # (N,) overlap of one box with (N, 4) others.
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    shared = np.clip(sides, 0, None).prod(axis=1)
    areas = (others[:, 2:] - others[:, :2]).prod(axis=1) + (box[2:] - box[:2]).prod()
    return np.asarray(shared / np.maximum(areas - shared, 1e-9))
