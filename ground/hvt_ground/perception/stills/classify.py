"""Names the objects of a still: a classifier on the crop, or an extra's `StillReader`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from hvt_common.inference.classify import Classifier
from hvt_common.values import Detections, Image, Posterior, View
from hvt_ground.perception.stills.decode import Box, DecodedStill

_PADDING = 0.15
"""Share of an object's width and height on each side, as the edge pads a crop."""


@dataclass(frozen=True, slots=True)
class ObjectReading:
    """The reading of one object in a still."""

    posterior: Posterior | None = None
    """None is no opinion."""
    box_base_px: Box | None = None
    """The object's box at the still's frame; None if the reader finds no boxes."""


@dataclass(frozen=True, slots=True)
class FrameReadings:
    """The readings of all stills of one frame."""

    objects: tuple[tuple[ObjectReading, ...], ...]
    """For each still, in order: the lead object's reading, then one for each ``also`` box."""
    found: Detections = field(default_factory=Detections.none)
    """Objects that were seen inside a still and are none of the named ones; base pixels, class ids of the reader's
    ``class_names``. Some may be tracks that the caller knows already."""


class StillReader(Protocol):
    """Names the objects in stills."""

    @property
    def wants_base(self) -> bool:
        """It uses the base frame: all stills wait for theirs, not only residuals."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes of the posteriors, and of ``found``."""

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:
        """One reading for every object of every still.

        All stills are of one frame, ``base_bgr`` is that frame decoded, where it is still at hand.
        """


def silent(stills: Sequence[DecodedStill]) -> FrameReadings:
    """No opinion on any object."""
    return FrameReadings(tuple((ObjectReading(),) * len(still.boxes_base_px) for still in stills))


class NoReader:
    """Shows stills without any names: the reader of a ground without models."""

    wants_base = False
    class_names: tuple[str, ...] = ("object",)

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:  # noqa: ARG002
        return silent(stills)


class CropReader:
    """An image classifier on the crop alone, all objects of a frame's stills in one call."""

    wants_base = False

    def __init__(self, classifier: Classifier, *, view: View) -> None:
        self._classifier = classifier
        self._view = view

    @property
    def class_names(self) -> tuple[str, ...]:
        return self._classifier.class_names

    def read(self, stills: Sequence[DecodedStill], base_bgr: Image | None) -> FrameReadings:  # noqa: ARG002
        """The classifier's posteriors; it finds neither boxes nor new objects."""
        crops = [crop for still in stills for crop in object_crops(still, view=self._view)]
        said = self._classifier.classify(crops)
        if len(said) < len(crops):  # its model fails
            return silent(stills)
        answers = iter(said)
        return FrameReadings(
            tuple(tuple(ObjectReading(next(answers)) for _ in still.boxes_base_px) for still in stills)
        )


def object_crops(still: DecodedStill, *, view: View) -> list[Image]:
    """The picture of each object in a still, the lead's first: its box with the still's padding.

    A still of one object is that picture already.
    """
    if len(still.boxes_base_px) == 1:
        return [still.image_bgr]
    height, width = still.image_bgr.shape[:2]
    x1, y1, x2, y2 = still.crop_source_px
    boxes = view.to_source(np.array(still.boxes_base_px, np.float32)).astype(np.float64)
    sides = boxes[:, 2:] - boxes[:, :2]
    grown = boxes + np.hstack([-sides, sides]) * _PADDING
    pixels = (grown - [x1, y1, x1, y1]) * ([width / (x2 - x1), height / (y2 - y1)] * 2)
    first = np.clip(np.floor(pixels[:, :2]), 0, [width - 1, height - 1]).astype(int)
    last = np.clip(np.ceil(pixels[:, 2:]), first + 1, [width, height]).astype(int)
    return [
        still.image_bgr[top:bottom, left:right]
        for (left, top), (right, bottom) in zip(first.tolist(), last.tolist(), strict=True)
    ]
