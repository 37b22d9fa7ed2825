"""The values that pass from stage to stage. Nothing here knows bytes, Zenoh, codecs or models.

Coordinate spaces: *source* pixels are those of the untouched camera frame, *base* pixels those of the
resampled frame that the base stream carries (``--size``). `View` maps one to the other. Boxes are always
``x1, y1, x2, y2`` with ``x2, y2`` exclusive, float32. Colour images are uint8 ``(height, width, 3)`` in
BGR order.
Times ending in ``_ns`` are Unix time in nanoseconds unless the name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

Boxes = npt.NDArray[np.float32]
"""(N, 4) float32, x1 y1 x2 y2; the name says the space (``boxes_base_px``, ``boxes_source_px``)."""

Image = npt.NDArray[np.uint8]
"""(height, width, 3) uint8, BGR."""

Fit = Literal["letterbox", "crop"]
"""How a source of another aspect ratio is brought into the base frame: padded with black, or cut to fill."""


@dataclass(frozen=True, slots=True)
class View:
    """The affine map between source and base pixels: ``base = source * scale + offset`` for each axis.

    The scale is the same on both axes (pixels stay square), so a box keeps its aspect ratio.
    """

    source_size: tuple[int, int]
    """(width, height) of the source frame in pixels."""
    base_size: tuple[int, int]
    """(width, height) of the base frame in pixels."""
    scale: float
    offset_px: tuple[float, float]
    """(x, y) in base pixels."""

    @classmethod
    def fitted(cls, source_size: tuple[int, int], base_size: tuple[int, int], *, fit: Fit) -> View:
        """The map that centres the source in the base frame, whole (letterbox) or filling it (crop)."""
        ratios = (base_size[0] / source_size[0], base_size[1] / source_size[1])
        scale = min(ratios) if fit == "letterbox" else max(ratios)
        offset = ((base_size[0] - source_size[0] * scale) / 2, (base_size[1] - source_size[1] * scale) / 2)
        return cls(source_size=source_size, base_size=base_size, scale=scale, offset_px=offset)

    @property
    def enlarges(self) -> bool:
        """Whether the base has more pixels of the scene than the source."""
        return self.scale > 1

    def to_base(self, boxes_source_px: Boxes) -> Boxes:
        """Map (N, 4) boxes from source to base pixels; not clipped."""
        return (boxes_source_px * self.scale + self._shift()).astype(np.float32)

    def to_source(self, boxes_base_px: Boxes) -> Boxes:
        """Map (N, 4) boxes from base to source pixels; not clipped."""
        return ((boxes_base_px - self._shift()) / self.scale).astype(np.float32)

    def _shift(self) -> npt.NDArray[np.float32]:
        return np.array([*self.offset_px, *self.offset_px], np.float32)


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the base rate, as the source hands it on."""

    index: int
    """0, 1, 2 … in this session; also the frame index of the access unit made from it."""
    capture_ns: int
    """When the camera took it; taken once, at the source."""
    source_bgr: Image
    """The untouched frame; stills are cropped from it."""
    base_bgr: Image
    """The same moment resampled to the base size; the encoder's input."""
    camera_unit: CameraUnit | None = None
    """The same frame as the camera has coded it, where that is to be the base stream (``--encoder passthrough``)."""


@dataclass(frozen=True, slots=True)
class CameraUnit:
    """One frame as the camera itself has coded it, in place of x265."""

    data: bytes = field(repr=False)
    """An HEVC access unit, Annex B. It builds on the one before it, that of the frame with the index before."""
    keyframe: bool
    """A decoder can begin with it: VPS, SPS and PPS are before the picture."""


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One coded frame of the base stream, Annex B; a keyframe carries its parameter sets."""

    frame_index: int
    capture_ns: int
    data: bytes
    keyframe: bool


@dataclass(frozen=True, slots=True)
class Orientation:
    """A direction in degrees: aircraft angles (yaw, then pitch, then roll), as in MISB ST 0601."""

    yaw_deg: float
    """Clockwise from true north, 0 up to 360."""
    pitch_deg: float
    """Up from the horizon, -90 to 90; a camera that points straight down has -90, and its yaw is where the upper
    edge of the picture points."""
    roll_deg: float
    """To the right (clockwise, seen along the direction), -180 up to 180."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Place and direction of a camera, with their errors. WGS 84."""

    capture_ns: int
    """By the clock of the frames."""
    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    """Above the ground; where that is not flat, above the place that the height counts from, as a rule the
    take-off."""
    altitude_m: float | None = None
    """Above mean sea level."""
    camera: Orientation | None = None
    """Orientation of the optical axis."""
    platform: Orientation | None = None
    """Orientation of the aircraft or vehicle."""
    hfov_deg: float | None = None
    """Horizontal field of view of the source frame, above 0 and below 180."""
    position_error_m: float = 3.0
    """Standard deviation along each horizontal axis."""
    height_error_m: float = 3.0
    """Standard deviation of ``height_m``."""
    angle_error_deg: float = 2.0
    """Standard deviation of each of the camera's angles."""


@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of one frame, best first."""

    boxes_xyxy_px: Boxes
    """(N, 4) in the pixels of the image that was given to the detector."""
    confidences: npt.NDArray[np.float32]
    """(N,) in 0…1."""
    class_ids: npt.NDArray[np.int32]
    """(N,) index into the detector's ``class_names``."""

    def __len__(self) -> int:
        return len(self.confidences)

    def take(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Detections:
        """Those at ``rows``, an index or mask."""
        return Detections(self.boxes_xyxy_px[rows], self.confidences[rows], self.class_ids[rows])

    @classmethod
    def none(cls) -> Detections:
        return cls(np.empty((0, 4), np.float32), np.empty(0, np.float32), np.empty(0, np.int32))


@dataclass(frozen=True, slots=True)
class Tracks:
    """The confirmed tracks at one frame, as parallel arrays ordered by id (oldest first)."""

    frame_index: int
    ids: npt.NDArray[np.int64]
    """(N,) unique within one tracker, from 1."""
    boxes_xyxy_px: Boxes
    """(N, 4) in base pixels."""
    confidences: npt.NDArray[np.float32]
    """(N,) of the last detection that was matched, 0…1."""
    class_ids: npt.NDArray[np.int32]
    """(N,) the class the track's detections have voted for, weighted by confidence."""
    born_frames: npt.NDArray[np.int64]
    """(N,) frame index of the track's first detection."""
    seen_frames: npt.NDArray[np.int64]
    """(N,) frame index of the last detection that was matched; older than ``frame_index`` while predicted."""
    started: npt.NDArray[np.bool_]
    """(N,) True where the track was created, or found again after being lost, at this very frame."""

    @classmethod
    def none(cls, frame_index: int) -> Tracks:
        none, found = np.empty(0, np.int64), Detections.none()
        boxes, started = found.boxes_xyxy_px, np.empty(0, np.bool_)
        return cls(frame_index, none, boxes, found.confidences, found.class_ids, none, none, started)

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Tracks:
        """Those at ``rows``, an index or mask."""
        arrays = (one.name for one in fields(self) if one.name != "frame_index")
        return Tracks(self.frame_index, **{name: getattr(self, name)[rows] for name in arrays})


@dataclass(frozen=True, slots=True)
class Posterior:
    """A classifier's answer for one crop."""

    class_name: str
    confidence: float
    """Probability of ``class_name``, 0…1."""
    entropy_nats: float
    """Entropy of the whole distribution; 0 is certain."""
    probabilities: npt.NDArray[np.float32] = field(repr=False)
    """(C,) over the classifier's ``class_names``."""


def iou(
    a_xyxy_px: npt.NDArray[np.floating[Any]], b_xyxy_px: npt.NDArray[np.floating[Any]]
) -> npt.NDArray[np.float64]:
    """Intersection over union of (N, 4) with (M, 4) boxes in one pixel space, (N, M); 0 for empty boxes.

    ByteTrack measures boxes differently: see `tracking.association.overlaps`.
    """
    a, b = np.asarray(a_xyxy_px, np.float64), np.asarray(b_xyxy_px, np.float64)
    areas = [np.clip(one[:, 2:] - one[:, :2], 0, None).prod(-1) for one in (a, b)]
    shared = intersections(a, b)
    union = np.add.outer(*areas) - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0), np.float64)


def intersections(
    a_xyxy_px: npt.NDArray[np.floating[Any]], b_xyxy_px: npt.NDArray[np.floating[Any]]
) -> npt.NDArray[Any]:
    """The area that each of (N, 4) shares with each of (M, 4) boxes in one pixel space, (N, M)."""
    a, b = a_xyxy_px[:, None, :], b_xyxy_px[None, :, :]
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    return np.asarray(np.clip(sides, 0, None).prod(-1))
