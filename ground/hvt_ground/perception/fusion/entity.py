"""One object of the world, its sources, and the evidence against it; see `fuse`.

`CameraPath` moves boxes from one frame to another, by the camera's motion over the last seconds.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine
from hvt_common.tracking.recall import EDGE_ONLY_CONFIDENCE, Recall
from hvt_common.values import Tracks, iou
from hvt_ground.events import Origin

_MOST_CACHED = 256


class CameraPath:
    """The motion between decoded frames, and from it that between any two frames.

    Between two decoded frames the motion is spread evenly over the frames; after the newest it goes on as it was
    for ``ahead_frames`` and then stands; before the oldest it stands. ``frames`` motions are remembered.
    """

    def __init__(self, *, ahead_frames: int, frames: int = 90) -> None:
        self._ahead_frames = ahead_frames
        self._steps: deque[tuple[int, int, _Floats]] = deque(maxlen=frames)
        self._cached: dict[tuple[int, int], Affine] = {}
        """Results since the last picture: a hundred boxes need the same two frames."""

    def add(self, affine: Affine, *, start: int, end: int) -> None:
        """Take the (2, 3) map from the picture of frame ``start`` to that of ``end``, base pixels, end > start."""
        self._steps.append((start, end, np.vstack((affine, [0.0, 0.0, 1.0]))))
        self._cached.clear()

    def between(self, start: int, end: int) -> Affine:
        """The (2, 3) map from the base pixels of one frame to those of another, either of which may be the later."""
        affine = self._cached.get((start, end))
        if affine is None:
            affine = self._cached[start, end] = self._between(start, end)
            if len(self._cached) > _MOST_CACHED:
                self._cached.clear()
        return affine

    def _between(self, start: int, end: int) -> Affine:
        if start > end:
            back = np.vstack((self._between(end, start), [0.0, 0.0, 1.0]))
            return np.asarray(np.linalg.inv(back)[:2], np.float64)
        whole = np.eye(3)
        for first, last, step in self._steps:
            shared = min(end, last) - max(start, first)
            if shared > 0:
                whole = _part(step, shared / (last - first)) @ whole
        if self._steps:
            first, last, step = self._steps[-1]
            frames = min(end - max(start, last), self._ahead_frames)
            if frames > 0:
                whole = np.linalg.matrix_power(_part(step, 1 / (last - first)), frames) @ whole
        return np.asarray(whole[:2], np.float64)

    def carry(self, boxes: _Floats, *, start: int, end: int) -> _Floats:
        """(N, 4) boxes of frame ``start``, base pixels, where they lie at frame ``end`` if only the camera moves.

        They stay upright: the centre is mapped, the sides grow by the mean scale.
        """
        if start == end or not self._steps or not len(boxes):
            return boxes
        affine = self.between(start, end)
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2 @ affine[:, :2].T + affine[:, 2]
        halves = (boxes[:, 2:] - boxes[:, :2]) / 2 * np.sqrt(abs(np.linalg.det(affine[:, :2])))
        return np.concatenate((centres - halves, centres + halves), axis=1)


def _part(step: _Floats, share: float) -> _Floats:
    # A share of a small motion: linear in its distance from standing still.
    return step if share == 1 else np.eye(3) + (step - np.eye(3)) * share


_Floats = npt.NDArray[np.float64]

_NEW_VELOCITY = 0.6
"""Weight of the newest velocity against those before: two boxes of a small object give a rough one."""
_NEW_CONFIDENCE = 0.2
MISSED_STEPS = 2
"""Steps in a row without a track that end the edge's knowledge of it."""


@dataclass(frozen=True, slots=True)
class Observation:
    """A box reported by the edge or a still at one frame, and how the object moves."""

    box: _Floats
    """(4,) float64 x1 y1 x2 y2, base pixels."""
    frame_index: int
    confidence: float
    ways: _Floats = field(default_factory=lambda: np.zeros(4))
    """(4,) float64, its sides' own motion beyond the camera's, base pixels a frame: x1 y1 x2 y2."""
    steps: int = 1
    """Number of observations."""

    def updated(self, box: _Floats, frame_index: int, confidence: float, *, path: CameraPath) -> Observation:
        """The same object at a later frame."""
        frames = frame_index - self.frame_index
        stood = path.carry(self.box[None], start=self.frame_index, end=frame_index)[0]
        share = 1.0 if self.steps == 1 else _NEW_VELOCITY
        ways = share * (box - stood) / max(1, frames) + (1 - share) * self.ways
        return Observation(box, frame_index, confidence, ways, self.steps + 1)

    @property
    def velocity(self) -> _Floats:
        """(2,) of its centre, base pixels a frame."""
        return (self.ways[:2] + self.ways[2:]) / 2

    def stays(self, frames: int) -> bool:
        """Whether the object is known to go less than half of its own size in so many frames.

        Of one that leaves the picture only the inner side moves.
        """
        way = frames * float(np.abs(self.ways).max())
        return self.steps > 1 and way < float((self.box[2:] - self.box[:2]).max()) / 2


@dataclass(slots=True)
class Vote:
    """The class that one side has settled on."""

    class_id: int = -1
    confidence: float = 0.0
    """Smoothed over its detections."""

    def update(self, class_id: int, confidence: float) -> None:
        """Take the side's present class."""
        share = 1.0 if self.class_id < 0 else _NEW_CONFIDENCE
        self.confidence += share * (confidence - self.confidence)
        self.class_id = class_id


@dataclass(slots=True, eq=False)
class Entity:
    """An id that never changes, and its sources."""

    born: int
    id: int = 0
    """0 until it is listed for the first time."""
    own_id: int | None = None
    edge_id: int | None = None
    reported: Observation | None = None
    """The edge's newest box, or a still's if the edge has never listed it."""
    own_vote: Vote = field(default_factory=Vote)
    voted_frame: int = -1
    """The frame at which our detector last saw it."""
    edge_vote: Vote = field(default_factory=Vote)
    missed: int = 0
    """Steps in a row that have not listed it."""
    unlisted: int = 0
    """Steps in a row that have not shown it though we track it."""
    is_doubted: bool = False
    """Suppressed by the edge: it is ground-only, missed by the edge, and not sure enough."""
    still_frame: int = -1
    """Frame of the newest still that showed it."""
    apart: int = 0
    """Steps in a row at which its two tracks lay apart."""
    own_then: tuple[_Floats, int] | None = None
    """(2,) the centre of our own box at the frame of a step, and that frame."""
    correction: tuple[_Floats, int] | None = None
    """(4,) correction of our own box, and the frame of the still that showed it."""
    last_frame: int = -1
    """The newest frame at which any source observed it."""

    def is_report_live(self, frame_index: int, *, patience: int) -> bool:
        """Whether the edge's knowledge of it, or a still's, holds at this frame."""
        if self.reported is None or frame_index - self.reported.frame_index > patience:
            return False
        return self.edge_id is None or self.missed < MISSED_STEPS

    def origin(
        self, own_ids: Container[int | None], frame_index: int, *, patience: int, reach: int
    ) -> Origin | None:
        """Its sources; ``own_ids`` are our tracks at this frame. None without any (any more), or if it has moved off.

        That is one that only the edge has seen, more than ``reach`` frames ago, and that moves or may move.
        """
        observed = self.is_report_live(frame_index, patience=patience)
        if self.own_id is not None and self.own_id in own_ids:
            return "edge+base" if observed and self.edge_id is not None else "base"
        if not observed or self.reported is None:
            return None
        if self.edge_id is None:
            return "still"
        unknown = frame_index - self.reported.frame_index - reach
        return "edge" if unknown <= 0 or self.reported.stays(unknown) else None

    def part_from_own(self) -> None:
        """Forget our track, which is another object."""
        self.own_id, self.own_vote = None, Vote()
        self.apart, self.own_then, self.correction = 0, None, None


NEAR_IOU = 0.1
"""The least IoU of a box of the edge that is no miss of ours: two boxes of a small object overlap little."""
LET_GO_STEPS = 6
"""An object once listed by the edge must be missed in 6 steps in a row: a detection may fail."""
SURER = 0.1
"""An object that was suppressed must be surer by this than one that never was, or it would come and go."""


class MissedDetections:
    """Sets `Entity.is_doubted` at each step of the edge: a track that it does not report may be false.

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
            # The edge's tracker may need two detections, with one at most of an object newer than its last step.
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
