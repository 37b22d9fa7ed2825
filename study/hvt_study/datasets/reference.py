"""Reference labels: the answers of a detector, and of a classifier if wanted, on the untouched source frames.

The protocol of DDS, AccMPEG and Reducto: such labels tell how many objects that the model *could* have seen survive
the link, not that the model was right. A detector in tiles (`hvt_common.inference.tiles`) sees the source as finely
as the edge may. Answers are remembered by the pixels that were asked about (`CachedDetector`), so that a run that was
killed does not ask twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from hvt_common.inference.classify import Classifier
from hvt_common.inference.detect import Detector
from hvt_common.inference.labels import first_synonym
from hvt_common.values import Boxes, Image
from hvt_edge.perception.candidates import PADDING, crop_box
from hvt_edge.source.resample import Resizer
from hvt_study.datasets.labels import FrameLabels, inside_frame
from hvt_study.datasets.sequence import Sequence

CONFIDENCE = 0.25
"""From which a detection is a label."""


@dataclass(frozen=True, slots=True)
class ReferenceLabels:
    """Labels of those source frames that frames show. Small, and it can be sent to another process."""

    frames: Mapping[int, FrameLabels]
    class_set: tuple[str, ...]
    """All that the model can say, sorted."""

    def __call__(self, index: int) -> FrameLabels:
        return self.frames[index]

    def pack(self) -> dict[str, Any]:
        frames = {
            str(index): [one.boxes_xyxy_px.tolist(), list(one.class_names)]
            for index, one in self.frames.items()
        }
        return {"class_set": list(self.class_set), "frames": frames}

    @classmethod
    def unpack(cls, packed: Mapping[str, Any]) -> ReferenceLabels:
        frames = {
            int(index): FrameLabels.plain(boxes, names) for index, (boxes, names) in packed["frames"].items()
        }
        return cls(frames, tuple(packed["class_set"]))


def reference_labels(
    sequence: Sequence,
    *,
    detector: Detector,
    classifier: Classifier | None = None,
    size: tuple[int, int] | None = None,
) -> ReferenceLabels:
    """Label the source frames that the clip shows, one at a time, brought to ``size``.

    Answers of the detector below `CONFIDENCE` are passed over. A classifier names each box anew, by its crop with the
    margin of stills.
    """
    resizer = None if size is None else Resizer(sequence.source_size, size, fit="letterbox")
    found: dict[int, FrameLabels] = {}
    with closing(sequence.clip.images()) as images:
        for frame_index, image in enumerate(islice(images, sequence.clip_frames)):
            index = sequence.source_frame(frame_index)
            if index not in found:
                found[index] = _label(np.asarray(image), detector, classifier, resizer)
    model = detector if classifier is None else classifier
    return ReferenceLabels(found, tuple(sorted({first_synonym(name) for name in model.class_names})))


def with_labels(sequence: Sequence, labels: ReferenceLabels) -> Sequence:
    """The sequence with these labels in place of its own."""
    return replace(sequence, labels=labels, class_set=labels.class_set, one_target=False)


def _label(
    image: Image, detector: Detector, classifier: Classifier | None, resizer: Resizer | None
) -> FrameLabels:
    """(height, width, 3) BGR source pixels to labels in source pixels."""
    frame = None if resizer is None else resizer.frame(image, index=0, capture_ns=0)
    found = detector.detect(image if frame is None else frame.base_bgr)
    sure = found.confidences >= CONFIDENCE
    boxes = found.boxes_xyxy_px[sure]
    if resizer is not None:
        boxes = resizer.view.to_source(boxes)
    boxes = inside_frame(boxes, (image.shape[1], image.shape[0]))
    there = (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    boxes = boxes[there]
    names = tuple(first_synonym(detector.class_names[kind]) for kind in found.class_ids[sure][there].tolist())
    if classifier is not None and len(boxes):
        answers = classifier.classify(list(_crops(image, boxes)))
        names = tuple(first_synonym(answer.class_name) for answer in answers)
    return FrameLabels.plain(boxes, names)


def _crops(image: Image, boxes: Boxes) -> Iterator[Image]:
    size = image.shape[1], image.shape[0]
    for left, top, right, bottom in boxes.tolist():
        x1, y1, x2, y2 = crop_box((left, top, right, bottom), padding=PADDING, source_size=size)
        yield image[y1:y2, x1:x2]
