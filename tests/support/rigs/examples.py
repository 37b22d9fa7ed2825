"""What the parts hand to each other, of a car: a new field is filled in here. The wire's are in `messages`."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from hvt_common.units import SECOND_NS
from hvt_common.values import Detections, Posterior, Tracks
from hvt_edge.perception.candidates import Candidate
from hvt_edge.stills.policy.base import CostEstimate, Step
from hvt_ground.events import Overlay, Refinement
from hvt_ground.perception.stills.decode import Box
from hvt_ground.perception.stills.match import StillSeen


class Clock:
    """Stands still until it is set."""

    def __init__(self, now_ns: int) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns


def decision_step(frame_index: int = 300, **changes: Any) -> Step:
    """At 15 frames a second, with plenty of room."""
    fields: dict[str, Any] = {
        "frame_index": frame_index,
        "now_ns": round(frame_index / 15 * SECOND_NS),
        "fps": 15.0,
        "base_size": (1280, 720),
        "cost": CostEstimate(),
        "allowance_bytes": 1e9,
    }
    return Step(**(fields | changes))


def detections(boxes: Any, confidences: Any = 0.9, classes: Any = 0) -> Detections:
    boxes = np.array(boxes, np.float32).reshape(-1, 4)

    def each(value: Any, kind: Any) -> npt.NDArray[Any]:
        return np.broadcast_to(np.asarray(value, kind), len(boxes)).copy()

    return Detections(boxes, each(confidences, np.float32), each(classes, np.int32))


def tracks_of(
    frame_index: int,
    boxes: Any,
    *,
    ids: Any = None,
    confidences: Any = 0.5,
    classes: Any = 0,
    born: Any = 0,
    seen: Any = None,
    started: Any = False,
) -> Tracks:
    """A tracker's list of ``boxes``, ``{id: box}`` or numbered from 1; a value is that of all, or one for each."""
    if isinstance(boxes, Mapping):
        ids = sorted(boxes)
        boxes = [boxes[one] for one in ids]
    boxes = np.asarray(boxes, np.float32).reshape(-1, 4)

    def each(value: Any, kind: Any) -> npt.NDArray[Any]:
        return np.broadcast_to(np.asarray(value, kind), len(boxes)).copy()

    return Tracks(
        frame_index=frame_index,
        ids=each(range(1, len(boxes) + 1) if ids is None else ids, np.int64),
        boxes_xyxy_px=boxes,
        confidences=each(confidences, np.float32),
        class_ids=each(classes, np.int32),
        born_frames=each(born, np.int64),
        seen_frames=each(frame_index if seen is None else seen, np.int64),
        started=each(started, np.bool_),
    )


def candidate(track_id: int = 1, box: tuple[float, ...] = (100, 100, 150, 140), **changes: Any) -> Candidate:
    area_px = (box[2] - box[0]) * (box[3] - box[1])
    fields: dict[str, Any] = {
        "frame_index": 300,
        "track_id": track_id,
        "box_base_px": box,
        "box_source_px": box,
        "class_id": 3,
        "class_name": "car",
        "confidence": 0.6,
        "area_share": area_px / (1280 * 720),
        "crop_area_px": 7000.0,
        "born_frame": 200,
    }
    return Candidate(**(fields | changes))


def refinement(**changes: Any) -> Refinement:
    """What the ground says of a still of edge track 5: a car, as before."""
    fields: dict[str, Any] = {
        "frame_index": 0,
        "capture_ns": 0,
        "still_sequence": 0,
        "track_id": 1,
        "edge_track_id": 5,
        "box_base_px": (0.0, 0.0, 9.0, 9.0),
        "still": b"",
        "media_type": "image/jpeg",
        "base_crop_bgr": None,
        "class_before": "car",
        "class_after": "car",
        "confidence": 0.9,
        "reason": "gain",
        "quality_pct": 50,
    }
    return Refinement(**(fields | changes))


def overlay(frame_index: int, boxes: Any, *, capture_ns: int = 0, **changes: Any) -> Overlay:
    boxes = np.asarray(boxes, np.float32).reshape(-1, 4)
    count = len(boxes)
    fields: dict[str, Any] = {
        "frame_index": frame_index,
        "capture_ns": capture_ns,
        "track_ids": np.arange(1, count + 1),
        "boxes_base_px": boxes,
        "base_classes": ("car",) * count,
        "classes": ("car",) * count,
        "confidences": np.full(count, 0.8, np.float32),
        "refined": np.zeros(count, np.bool_),
    }
    return Overlay(**(fields | changes))


def seen(
    sequence: int,
    frame_index: int,
    posterior: Posterior,
    box: Box,
    *,
    edge: int,
    class_name: str = "car",
    side_px: float = 20.0,
) -> StillSeen:
    event = refinement(
        frame_index=frame_index,
        capture_ns=frame_index * 66_666_667,
        still_sequence=sequence,
        track_id=None,
        edge_track_id=edge,
        box_base_px=box,
        still=f"still {sequence}".encode(),
        class_before=class_name,
        class_after=posterior.class_name,
        confidence=posterior.confidence,
        reason="uncertainty",
    )
    return StillSeen(event, posterior, side_px)
