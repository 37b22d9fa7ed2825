"""One object of the world and its sources; see `fuse`."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hvt_ground.events import Origin
from hvt_ground.perception.fusion.camera_path import CameraPath

_Floats = npt.NDArray[np.float64]

_NEW_VELOCITY = 0.6
"""Weight of the newest velocity against those before: two boxes of a small object give a rough one."""
_NEW_CONFIDENCE = 0.2
MISSED_STEPS = 2
"""Steps in a row without a track that end the edge's knowledge of it."""


@dataclass(frozen=True, slots=True)
class Observation:
    """A box reported by the edge or a still at one frame, and the object's own motion beyond the camera's."""

    box: _Floats
    """(4,) float64 x1 y1 x2 y2, base pixels."""
    frame_index: int
    confidence: float
    velocity: _Floats = field(default_factory=lambda: np.zeros(2))
    """(2,) float64, base pixels a frame."""
    steps: int = 1
    """Number of observations."""

    def updated(self, box: _Floats, frame_index: int, confidence: float, *, path: CameraPath) -> Observation:
        """The same object at a later frame."""
        frames = frame_index - self.frame_index
        stood = path.carry(self.box[None], start=self.frame_index, end=frame_index)[0]
        newest = (_centre(box) - _centre(stood)) / max(1, frames)
        share = 1.0 if self.steps == 1 else _NEW_VELOCITY
        velocity = share * newest + (1 - share) * self.velocity
        return Observation(box, frame_index, confidence, velocity, self.steps + 1)


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

    def origin(self, own_ids: Container[int | None], frame_index: int, *, patience: int) -> Origin | None:
        """Its sources; ``own_ids`` are our tracks at this frame. None without any (any more)."""
        observed = self.is_report_live(frame_index, patience=patience)
        if self.own_id is not None and self.own_id in own_ids:
            return "edge+base" if observed and self.edge_id is not None else "base"
        if not observed:
            return None
        return "still" if self.edge_id is None else "edge"

    def part_from_own(self) -> None:
        """Forget our track, which is another object."""
        self.own_id, self.own_vote = None, Vote()
        self.apart, self.own_then, self.correction = 0, None, None


def _centre(box: _Floats) -> _Floats:
    return (box[:2] + box[2:]) / 2
