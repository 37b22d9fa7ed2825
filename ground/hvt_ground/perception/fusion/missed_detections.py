"""Whether the edge's missed detection is evidence against a track of ours; see `fuse`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.recall import EDGE_ONLY_CONFIDENCE, Recall
from hvt_common.values import Tracks, iou
from hvt_ground.perception.fusion.entity import Entity

NEAR_IOU = 0.1
"""A box of the edge that overlaps ours by so much is no miss: of a small object two boxes overlap little."""
LET_GO_STEPS = 6
"""An object once listed by the edge must be missed in so many steps in a row: a detection may fail."""
SURER = 0.1
"""An object that was suppressed must be surer by this than one that never was, or it would come and go."""


class MissedDetections:
    """Sets `Entity.is_doubted` at each step of the edge.

    ``edge_classes`` are the unified class ids that the edge can name; a still speaks for an object for
    ``still_frames``.
    """

    def __init__(self, edge_classes: npt.NDArray[np.int32], *, fps: float, still_frames: int) -> None:
        self._edge_classes = frozenset(edge_classes.tolist())
        self._fps = fps
        self._still_frames = still_frames
        self._recall = Recall()
        self._stepped = -1

    def take(self, step: Tracks, own: Tracks, *, by_own: Mapping[int, Entity]) -> None:
        """Find which of our tracks at a step's frame it misses, and suppress the unsure."""
        near = np.any(iou(own.boxes_xyxy_px, step.boxes_xyxy_px) >= NEAR_IOU, axis=1).tolist()
        ours = []
        for own_id, is_near in zip(own.ids.tolist(), near, strict=True):
            entity = by_own.get(own_id)
            if entity is None:
                continue
            if entity.own_vote.class_id not in self._edge_classes:
                entity.unlisted, entity.is_doubted = 0, False
                continue
            is_listed = is_near or (entity.edge_id is not None and not entity.missed)
            # The edge's tracker may need two detections, and has had one at most of what is newer than its last step.
            is_new = self._stepped < entity.born < step.frame_index
            entity.unlisted = 0 if is_listed or is_new else entity.unlisted + 1
            ours.append((entity, is_listed))
        sure = [one for one in ours if one[0].own_vote.confidence >= EDGE_ONLY_CONFIDENCE]
        self._recall.take(
            np.array([entity.own_vote.class_id for entity, _ in sure], np.int32),
            reported=np.array([is_listed for _, is_listed in sure], bool),
            at_s=step.frame_index / self._fps,
        )
        for entity, _ in ours:
            entity.is_doubted = self._is_doubted(entity, step.frame_index)
        self._stepped = step.frame_index

    def _is_doubted(self, entity: Entity, frame_index: int) -> bool:
        was_listed = entity.edge_vote.class_id >= 0
        if entity.unlisted < (LET_GO_STEPS if was_listed else 1):
            return False
        if entity.still_frame >= 0 and frame_index - entity.still_frame <= self._still_frames:
            return False
        vote = entity.own_vote
        least = self._recall.least_confidence(vote.class_id)
        return least > 0 and vote.confidence < least + (SURER if entity.is_doubted else 0.0)
