"""From an on-demand request to the crop of the frame that shows it, or to the sentence that says why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hvt_common.values import Boxes, Still, View
from hvt_common.video.base_crop import MAX_REQUESTED_SIDE_PX, coded_size
from hvt_edge.perception.crop import MIN_SIDE_PX, crop_box
from hvt_edge.perception.frame_ring import FrameRing, RingFrame
from hvt_edge.stills.crop_job import CropJob, crop_of, size_parameters
from hvt_edge.stills.maker import StillMaker

ON_DEMAND = "asked"
"""The reason that such a still carries on the wire and in the ledger."""

Box = tuple[float, float, float, float]
Crop = tuple[int, int, int, int]


class RefusedError(Exception):
    """A request cannot be served; the text is one plain sentence for whoever requested it."""


@dataclass(frozen=True, slots=True)
class OnDemandRequest:
    """A track or a box, or neither for the whole frame; at a frame or so long ago, or neither for the newest."""

    track_id: int | None = None
    """The edge's."""
    box_xywh_px: tuple[int, int, int, int] | None = None
    """Left, top, width and height in source pixels."""
    frame_index: int | None = None
    ago_ms: int | None = None
    """Before the newest frame."""
    quality_pct: int | None = None
    """None for the quality of all stills."""


def frame_for(request: OnDemandRequest, ring: FrameRing) -> RingFrame:
    """The frame that is requested, or the nearest in the ring; raises `RefusedError` where it is gone or to come.

    The newest means the newest that was coded, unless the track is not in it. A track is in frames that were analyzed
    alone; anything else may be requested of the newest from the camera too.
    """
    tracked = request.track_id is not None
    newest, newest_held = ring.newest(tracked=False), ring.newest(tracked=tracked)
    if newest is None or newest_held is None:
        raise RefusedError("there is no frame yet, or none is kept (--ring)")
    if request.frame_index is not None:
        if request.frame_index > newest.frame_index:
            raise RefusedError(
                f"frame {request.frame_index} is yet to come: the newest is {newest.frame_index}"
            )
        index = min(request.frame_index, newest_held.frame_index)
        frame, wanted = ring.near_index(index, tracked=tracked), f"frame {request.frame_index}"
    elif not request.ago_ms:
        coded = ring.newest_coded(tracked=tracked)
        lacks = coded is None or (tracked and request.track_id not in coded.tracks.ids)
        return newest_held if lacks or coded is None else coded
    else:
        ago_ms = request.ago_ms
        frame = ring.near_time(newest.capture_ns - ago_ms * 1_000_000, tracked=tracked)
        wanted = f"the frame of {ago_ms / 1000:g} s ago"
    if frame is None:
        raise RefusedError(f"{wanted} is not held: frames go back {ring.reach_s():.1f} s")
    return frame


def crop_job_for(
    request: OnDemandRequest, frame: RingFrame, *, maker: StillMaker, view: View, class_names: tuple[str, ...]
) -> CropJob:
    """Crop what is requested out of that frame; raises `RefusedError` where it is not in it."""
    width, height = frame.size
    box: Box
    if request.track_id is not None:
        row = _row(frame, request.track_id)
        box = box_of(
            np.clip(view.to_source(frame.tracks.boxes_xyxy_px), 0, (width, height, width, height)), row
        )
        crop = crop_box(box, padding=maker.padding, source_size=(width, height))
        if box[2] - box[0] < 1 or box[3] - box[1] < 1:
            raise RefusedError(
                f"track {request.track_id} is outside the picture at frame {frame.frame_index}"
            )
        class_id = int(frame.tracks.class_ids[row])
        name, confidence = class_names[class_id], float(frame.tracks.confidences[row])
    else:
        crop = _inside(request.box_xywh_px or (0, 0, width, height), (width, height))
        box, name, confidence = (*map(float, crop),), "", 0.0  # type: ignore[assignment]
    size = coded_size(crop, max_side_px=MAX_REQUESTED_SIDE_PX)
    codec = maker.without_base
    header = Still(
        sequence=0,
        frame_index=frame.frame_index,
        capture_ns=frame.capture_ns,
        track_id=-1 if request.track_id is None else request.track_id,
        box_source_px=box,
        crop_source_px=crop,
        class_name=name,
        confidence=confidence,
        reason=ON_DEMAND,
        codec=codec.name,
        quality_pct=maker.quality_pct,
        data=b"",
        media_type=codec.media_type,
        parameters=size_parameters(crop, size),
    )
    pixels = crop_of(frame.source_bgr, crop, size)
    return CropJob(header=header, crop_bgr=pixels, base_crop_bgr=None, alternative=None)


def _row(frame: RingFrame, track_id: int) -> int:
    rows = np.flatnonzero(frame.tracks.ids == track_id)
    if len(rows):
        return int(rows[0])
    known = frame.tracks.ids.tolist()
    listed = ", ".join(map(str, known[:12])) + (" and more" if len(known) > 12 else "")
    raise RefusedError(
        f"there is no track {track_id} at frame {frame.frame_index}: the edge's own tracks there are "
        f"{listed or 'none'}"
    )


def _inside(box_xywh_px: tuple[int, int, int, int], size: tuple[int, int]) -> Crop:
    x, y, w, h = box_xywh_px
    if x < 0 or y < 0 or w < 1 or h < 1 or x + w > size[0] or y + h > size[1]:
        raise RefusedError(
            f"box {x},{y},{w},{h} is not inside the frame of {size[0]}x{size[1]} source pixels (x,y,w,h)"
        )
    if min(w, h) < MIN_SIDE_PX:
        raise RefusedError(f"box {x},{y},{w},{h} is too small: {MIN_SIDE_PX} pixels a side at least")
    return x, y, x + w, y + h


def box_of(boxes: Boxes, row: int) -> Box:
    """One row as plain numbers."""
    x1, y1, x2, y2 = (float(one) for one in boxes[row])
    return x1, y1, x2, y2
