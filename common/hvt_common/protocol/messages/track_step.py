"""The edge's own tracks at one decision step, as payload of ``tracks``: the message, and the two ends of its coding.

    encoder = TrackStepEncoder(session_id=…)
    payload = encoder.encode(tracks, capture_ns=…, send_delay_ns=…).pack()

    decoder = TrackStepDecoder()
    tracks = decoder.decode(TrackStep.parse(payload))  # None: it builds on a step that never came

A step is coded against the one before it (``reference``), or by itself (-1) about once a second, so that a lost
message hurts no longer than that. How the boxes are coded stands in `track_boxes`.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Final

import numpy as np

from hvt_common.protocol.messages.fields import U32, Blob, Int, WireError, wire_field
from hvt_common.protocol.messages.stream import OfFrame
from hvt_common.protocol.messages.track_boxes import (
    CONFIDENCE_STEPS,
    MOST_BOXES,
    PER_PX,
    CodedTrack,
    read_tracks,
    write_tracks,
)
from hvt_common.values import Tracks

_MOST_BOX_BYTES: Final = 16_000
_EARLY: Final = 0.95
"""Steps come a little early or late: one that is due nearly is due."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackStep(OfFrame):
    """Payload of ``tracks``: the list of the edge's tracker at one frame. Boxes are in base pixels."""

    MAX_BYTES: ClassVar[int] = 16_384
    TRIMMED: ClassVar[bool] = True

    reference: int = wire_field(Int(-1, U32))
    """Sequence of the step that the boxes are coded against; -1 where they stand by themselves."""
    boxes: bytes = wire_field(Blob(_MOST_BOX_BYTES))
    """Range-coded; see docs/wire-tracks.md."""
    coding: int = wire_field(Int(1, 255), default=1)
    """How the boxes are coded: 1 is docs/wire-tracks.md."""


class TrackStepEncoder:
    """Makes the steps of one session, one after the other.

    ``refresh_ns`` is how long steps may build on each other, in capture time; 0 makes each stand by itself.
    """

    def __init__(self, *, session_id: int, refresh_ns: int = 1_000_000_000) -> None:
        self._session_id = session_id
        self._refresh_ns = refresh_ns
        self._sequence = -1
        self._frame_index = -1
        self._state: list[CodedTrack] = []
        self._fresh_ns: int | None = None
        """Capture time of the last step that stands by itself."""

    def encode(self, tracks: Tracks, *, capture_ns: int, send_delay_ns: int = 0) -> TrackStep:
        """The next step. Of more than `MOST_BOXES` tracks the most confident are taken.

        Frame indices must rise. ``tracks.class_ids`` are below 2048 (indices of ``Info.class_names``).
        """
        frames = tracks.frame_index - self._frame_index
        if frames <= 0:
            raise ValueError(f"frame_index is {tracks.frame_index}, must be above {self._frame_index}")
        alone = self._fresh_ns is None or capture_ns - self._fresh_ns >= self._refresh_ns * _EARLY
        count = min(len(tracks), MOST_BOXES)
        data, state = self._coded(tracks, count, alone=alone, frames=frames)
        while len(data) > _MOST_BOX_BYTES:  # no list of a tracker needs as many bytes
            count //= 2
            data, state = self._coded(tracks, count, alone=alone, frames=frames)
        if alone:
            self._fresh_ns = capture_ns
        self._sequence += 1
        self._frame_index, self._state = tracks.frame_index, state
        return TrackStep(
            session_id=self._session_id,
            sequence=self._sequence,
            frame_index=tracks.frame_index,
            capture_ns=capture_ns,
            send_delay_ns=send_delay_ns,
            reference=-1 if alone else self._sequence - 1,
            boxes=data,
        )

    def _coded(
        self, tracks: Tracks, count: int, *, alone: bool, frames: int
    ) -> tuple[bytes, list[CodedTrack]]:
        listed = _quantised(tracks, count)
        if not alone:
            return write_tracks(listed, reference=self._state, frames=frames)
        if self._sequence >= 0:  # coded once more, only to learn the velocities
            _, state = write_tracks(listed, reference=self._state, frames=frames)
            known = {track.track_id: track for track in state}
            listed = [
                replace(
                    one, velocity_x=known[one.track_id].velocity_x, velocity_y=known[one.track_id].velocity_y
                )
                for one in listed
            ]
        return write_tracks(listed, reference=None, frames=frames)


class TrackStepDecoder:
    """Reads the steps of one session; make a new one for a new session."""

    def __init__(self) -> None:
        self._sequence = -1
        self._frame_index = -1
        self._state: list[CodedTrack] = []
        self._born: dict[int, int] = {}
        """Track id → the first frame at which it was listed here; of the tracks in the state."""

    def decode(self, step: TrackStep) -> Tracks | None:
        """The tracks of this step, boxes in base pixels, ordered by id; None where its reference never came.

        None too for a step that is not newer than the last one. ``ids`` are the edge's; ``class_ids`` index
        ``Info.class_names``; ``confidences`` are right within 0.1; ``born_frames`` is the first step that
        listed the track here; ``started`` marks those that the last readable step did not list. Raises
        `WireError` where the coded boxes make no sense; the decoder is as it was before.
        """
        if step.coding != 1:
            raise WireError(f"boxes of coding {step.coding}, which is not known here")
        if step.sequence <= self._sequence or step.reference not in (-1, self._sequence):
            return None
        frames = step.frame_index - self._frame_index
        if frames <= 0:
            raise WireError(f"frame {step.frame_index} of a track step does not follow {self._frame_index}")
        reference = None if step.reference < 0 else self._state
        state = read_tracks(step.boxes, reference=reference, frames=frames)
        before = {track.track_id for track in self._state if not track.missed}
        self._sequence, self._frame_index, self._state = step.sequence, step.frame_index, state
        self._born = {track.track_id: self._born.get(track.track_id, step.frame_index) for track in state}
        return self._listed(step.frame_index, before)

    def predicted(self, *, frame_index: int) -> Tracks | None:
        """The last step's tracks, moved on to a later frame with constant velocity; None before the first step."""
        if self._sequence < 0:
            return None
        return self._listed(frame_index, None)

    def _listed(self, frame_index: int, before: set[int] | None) -> Tracks:
        listed = [track for track in self._state if not track.missed]
        ahead = max(0, frame_index - self._frame_index)
        centre = np.array([track.moved(ahead) for track in listed], np.float64).reshape(-1, 2)
        half = np.array([(track.width, track.height) for track in listed], np.float64).reshape(-1, 2) / 2
        boxes = np.concatenate((centre - half, centre + half), axis=1) / PER_PX
        ids = [track.track_id for track in listed]
        return Tracks(
            frame_index=frame_index,
            ids=np.array(ids, np.int64),
            boxes_xyxy_px=boxes.astype(np.float32),
            confidences=np.array([track.confidence / CONFIDENCE_STEPS for track in listed], np.float32),
            class_ids=np.array([track.class_id for track in listed], np.int32),
            born_frames=np.array([self._born[one] for one in ids], np.int64),
            seen_frames=np.full(len(listed), self._frame_index, np.int64),
            started=np.array([before is not None and one not in before for one in ids], np.bool_),
        )


def _quantised(tracks: Tracks, count: int) -> list[CodedTrack]:
    # The ``count`` most confident tracks in whole numbers, ordered by id.
    best = np.sort(np.argsort(-tracks.confidences, kind="stable")[:count])
    boxes = tracks.boxes_xyxy_px[best].astype(np.float64)
    centre = np.rint((boxes[:, :2] + boxes[:, 2:]) * (PER_PX / 2)).astype(np.int64).tolist()
    side = np.rint((boxes[:, 2:] - boxes[:, :2]) * PER_PX).astype(np.int64).tolist()
    confidence = np.rint(tracks.confidences[best] * CONFIDENCE_STEPS).astype(np.int64).tolist()
    rows = zip(
        tracks.ids[best].tolist(), tracks.class_ids[best].tolist(), confidence, centre, side, strict=True
    )
    return [
        CodedTrack(
            track_id=track_id, class_id=class_id, confidence=sure, x=x, y=y, width=width, height=height
        )
        for track_id, class_id, sure, (x, y), (width, height) in rows
    ]
