"""The events of a stream at the ground, as one sequence of values: recording, viewers and exports hang on these.

All boxes are in base pixels. Every event carries the frame it belongs to and that frame's capture time, which
are the two timelines of a recording.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hvt_common.protocol.messages import RoiHeader
from hvt_common.values import Boxes, Image, Pose, View

VEHICLE = "vehicle"


def shown_word(name: str, vague: bool, doubted: bool = False) -> str:  # noqa: FBT001, FBT002 - for `map`
    """The word for people: that of the class, ``vehicle`` where it is vague, ``something`` where it is doubted."""
    return "something" if doubted else VEHICLE if vague else name


def _nowhere() -> npt.NDArray[np.bool_]:
    return np.zeros(0, np.bool_)


Level = Literal["info", "warning", "error"]

Origin = Literal["base", "edge", "edge+base", "still"]
"""Who knows of a track: the ground's own tracker on the base stream, the edge's report, both, or (``still``) nobody
but a still in which it was found."""


@dataclass(frozen=True, slots=True)
class VideoSample:
    """One decodable access unit of the base stream, just as received (Annex B)."""

    frame_index: int
    capture_ns: int
    data: bytes
    keyframe: bool
    stored: bool = False
    """It was stored at the edge while the link was down: it lies before others that are logged already."""


@dataclass(frozen=True, slots=True)
class Places:
    """The places of N objects on the ground; NaN if unknown."""

    places_deg: npt.NDArray[np.float64]
    """(N, 2) latitude and longitude, WGS 84."""
    ellipses: npt.NDArray[np.float64]
    """(N, 3) of the ellipse that holds the object with 95 %: half its longer axis and half its shorter one, metres,
    and the longer one's direction, degrees clockwise from north, 0 up to 180."""


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """The pose of the camera."""

    frame_index: int
    """The newest frame when it came."""
    capture_ns: int
    pose: Pose
    view: View
    """From the source frame, whose field of view the pose says, to the base."""


@dataclass(frozen=True, slots=True)
class Overlay:
    """The ground's tracks at one frame, as parallel arrays ordered by track id.

    A frame that the base stream left out may have one too: tracks that the edge reported, and predictions of others.
    """

    frame_index: int
    capture_ns: int
    track_ids: npt.NDArray[np.int64]
    """(N,)"""
    boxes_base_px: Boxes
    """(N, 4) x1 y1 x2 y2."""
    base_classes: tuple[str, ...]
    """N names: the detector's classes on the base stream."""
    classes: tuple[str, ...]
    """N names: the same after refinement; equal to the base class where no still has refined it."""
    confidences: npt.NDArray[np.float32]
    """(N,) of the class that is shown, 0…1."""
    refined: npt.NDArray[np.bool_]
    """(N,) True once a still has refined the track's class."""
    origins: tuple[Origin, ...] = ()
    """N words; by default ``base`` for all."""
    stored: bool = False
    """Whether the `VideoSample` was stored."""
    doubted: npt.NDArray[np.bool_] = field(default_factory=_nowhere)
    """(N,) True where stills say that it is nothing of mine, or it is a guess (`hvt_ground.perception.guesses`), as
    all are in a view that the detector does not know; by default nowhere."""
    sure: npt.NDArray[np.bool_] = field(default_factory=_nowhere)
    """(N,) True where stills agree on the class with a calibrated probability above .9; by default nowhere."""
    vague: npt.NDArray[np.bool_] = field(default_factory=_nowhere)
    """(N,) True where it is a vehicle, and its class rather a guess; by default nowhere."""
    looked_ns: int | None = None
    """Capture time of the picture from which the list goes on, where its own was not looked at; None is its own."""
    places: Places | None = None
    """Their places on the ground; None without a pose."""

    def __post_init__(self) -> None:
        count = len(self.track_ids)
        nowhere = np.zeros(count, np.bool_)
        usual = {"origins": ("base",) * count, "doubted": nowhere, "sure": nowhere, "vague": nowhere}
        for name, value in usual.items():
            if not len(getattr(self, name)):
                object.__setattr__(self, name, value)

    @classmethod
    def none(cls, frame_index: int, capture_ns: int, *, stored: bool = False) -> Overlay:
        boxes, none = np.empty((0, 4), np.float32), np.empty(0, np.float32)
        return cls(
            frame_index, capture_ns, np.empty(0, np.int64), boxes, (), (), none, _nowhere(), stored=stored
        )

    def take(self, rows: npt.NDArray[np.intp]) -> Overlay:
        """Those tracks alone; without places."""
        each = {name: getattr(self, name) for name in _OF_TRACKS}
        chosen: dict[str, Any] = {
            name: one[rows] if isinstance(one, np.ndarray) else tuple(one[row] for row in rows.tolist())
            for name, one in each.items()
        }
        return replace(self, **chosen)

    @property
    def words(self) -> tuple[str, ...]:
        return tuple(map(shown_word, self.classes, self.vague.tolist(), self.doubted.tolist()))

    @property
    def firm(self) -> npt.NDArray[np.bool_]:
        """(N,) True where a still has refined the class, and nothing doubts it: drawn thick."""
        return self.refined & ~self.doubted


_OF_TRACKS = (
    *("track_ids", "boxes_base_px", "base_classes", "classes", "confidences", "refined"),
    *("origins", "doubted", "sure", "vague"),
)


class Shown:
    """A still that was known at ``frame_index``."""

    __slots__ = ()
    frame_index: int
    capture_ns: int
    header: RoiHeader | None

    @property
    def shown_at(self) -> tuple[int, int]:
        """The frame that it shows, and when that was captured; as known where it has no header."""
        of = self.header or self
        return of.frame_index, of.capture_ns


@dataclass(frozen=True, slots=True)
class Refinement(Shown):
    """A still that was decoded and classified, and its effect on one object.

    A still that shows several objects makes one event for each, under the same number.
    """

    frame_index: int
    capture_ns: int
    still_sequence: int
    track_id: int | None
    """The ground's track; None while or when no track matches."""
    edge_track_id: int
    box_base_px: tuple[float, float, float, float]
    still: bytes
    """The coded still as received."""
    media_type: str
    """``image/jpeg`` and the like."""
    base_crop_bgr: Image | None
    """The same padded crop of the decoded base frame, at base resolution; None when that frame is gone."""
    class_before: str
    class_after: str
    confidence: float
    reason: str
    """Why the edge's method sent it."""
    quality_pct: int
    still_bgr: Image | None = None
    """The decoded still; needed where ``media_type`` is none that any viewer reads, such as a residual."""
    crop_base_px: tuple[float, float, float, float] | None = None
    """x1 y1 x2 y2, where the whole still lies in the base picture of its own frame (that of ``box_base_px``), not
    clipped; None leaves it out of the enhanced picture."""
    stored: bool = False
    """It was stored at the edge while the link was down: its frame is the one that it shows, long ago."""
    unread: bool = False
    """Nothing could read it: both classes are the edge's word."""
    note: str = ""
    """The classifier's name for an unread still, which no track can have."""
    doubted: bool = False
    """The still says that the object is nothing of mine."""
    sure: bool = False
    """``class_after`` has a calibrated probability above .9."""
    vague: tuple[bool, bool] = (False, False)
    """`Overlay.vague` for the class before and for the class after."""
    header: RoiHeader | None = None
    """The still's own message, in source pixels; None where nobody has it."""

    @property
    def words(self) -> tuple[str, str]:
        return shown_word(self.class_before, self.vague[0]), shown_word(self.class_after, self.vague[1])


@dataclass(frozen=True, slots=True)
class Traffic:
    """The link over the last second, and the age of the shown picture."""

    frame_index: int
    capture_ns: int
    base_bps: float
    roi_bps: float
    total_bps: float
    """Base, stills, metadata and transport overhead."""
    budget_bps: float
    receive_latency_ms: float | None
    """Capture to receive, the newest frame; None where clocks do not tell (lockstep, a camera's that is wrong)."""
    overlay_latency_ms: float | None
    """Capture to overlay."""
    tracks: int
    tracks_refined: int


@dataclass(frozen=True, slots=True)
class Notice:
    """Something an operator would want to read later: a gap, a keyframe request, a refinement, an end."""

    frame_index: int
    capture_ns: int
    level: Level
    text: str


@dataclass(frozen=True, slots=True)
class MessageTiming:
    """The times of a message: captured, sent, received, handled; Unix nanoseconds, 0 where there is none."""

    kind: str
    """The channel; of a backlog chunk with its kind, as ``backlog-still``."""
    sequence: int
    frame_index: int
    """-1 where it is about no frame."""
    capture_ns: int
    send_ns: int
    received_ns: int
    handled_ns: int | None
    """0: nothing was made of it; None: a `StillsRead` will tell."""
    line_bytes: int
    clock_offset_ns: int
    """The edge's clock less this one."""


@dataclass(frozen=True, slots=True)
class StillsRead:
    """The stills of these numbers were read by the classifier."""

    sequences: tuple[int, ...]
    at_ns: int


FrameEvent = VideoSample | Overlay | Refinement | Traffic | Notice | PoseUpdate
"""Everything that a recording shows at the frame and capture time that it carries."""
Event = FrameEvent | MessageTiming | StillsRead
