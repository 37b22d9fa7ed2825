"""A still's reading and its effect: the values that refinement takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from hvt_common.values import Image, Posterior
from hvt_ground.perception.stills.decode import Box, DecodedStill, ReceivedStill

Outcome = Literal["matched", "superseded", "no track", "ambiguous", "frame lost", "late", "overflow", "ended"]
"""What became of a still:

matched
    it spoke on the class of ``track_id``.
superseded
    it belongs to ``track_id``, but a still of a later frame has already replaced the class.
no track
    no track of the ground overlaps its box enough at its frame.
ambiguous
    two tracks of the ground fit its box about equally well.
frame lost
    the ground never decoded its frame.
late
    its frame is older than the history, or was not reached within the hold time.
overflow
    more stills wait than are held; the oldest goes.
ended
    it still waited when the stream or its session ended.
"""


@dataclass(frozen=True, slots=True)
class StillContext:
    """The context of a still that waits for its track, for one of the objects in it."""

    received: ReceivedStill
    decoded: DecodedStill
    track_id: int
    """The edge's."""
    box_base_px: Box
    found_base_px: Box | None
    """The reader's box of the object."""
    base_crop_bgr: Image | None


@dataclass(frozen=True, slots=True)
class StillSeen:
    """A still that was decoded and classified."""

    sequence: int
    frame_index: int
    capture_ns: int
    edge_track_id: int
    """The edge's own track; negative when the still was requested by box."""
    box_base_px: tuple[float, float, float, float]
    """x1 y1 x2 y2, base pixels, without padding."""
    class_name: str
    """The class name of the edge's detector."""
    posterior: Posterior
    """Its class posterior, over `Vocabulary.names`."""
    context: StillContext
    side_px: float
    """The shorter side of the object, source pixels."""
    news: float = 1.0
    """How much the still shows that the base did not, 0…1; see `news`."""
    part: int = 0
    """Number of the object in the still: each is matched by itself, under the still's sequence number."""
    stored: bool = False
    """It was stored while the link was down. Where nothing is known of its frame it may refine the track that its
    edge track is known as now: the object is the same, and so is its class."""

    @property
    def key(self) -> tuple[int, int]:
        """Sequence and part."""
        return self.sequence, self.part


@dataclass(frozen=True, slots=True)
class ResolvedStill:
    """A still and its effect."""

    still: StillSeen
    outcome: Outcome
    track_id: int | None
    """The ground's track; None unless the outcome is matched or superseded."""
    class_before: str
    """The class that was shown for the track; without a track the class of the edge's detector."""
    class_after: str
    """The class that is shown from now on; without a track the class of the still alone."""
    confidence: float
    """Confidence of ``class_after``, 0…1."""
    doubted: bool = False
    """``class_after`` is nothing of mine."""
    sure: bool = False
    """``class_after`` has a calibrated probability above .9."""


@dataclass(frozen=True, slots=True)
class ShownClasses:
    """Classes of N tracks, parallel to the given `Tracks`; fields of `events.Overlay`."""

    base_classes: tuple[str, ...]
    classes: tuple[str, ...]
    confidences: npt.NDArray[np.float32]
    """(N,) of ``classes``, 0…1."""
    refined: npt.NDArray[np.bool_]
    """(N,) True once a still has refined it."""
    doubted: npt.NDArray[np.bool_]
    """(N,) True where stills say that it is nothing of mine."""
    sure: npt.NDArray[np.bool_]
    """(N,) True where stills agree on the class with a calibrated probability above .9."""
