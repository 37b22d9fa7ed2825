"""Writes a session as MCAP with Foxglove's schemas: video, boxes, stills and events, for Foxglove and ROS tools.

Times are capture times. Topics begin with the edge's id, so that files of several edges can be opened together.
"""

from __future__ import annotations

import math
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.TextAnnotation_pb2 import TextAnnotation
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from hvt_common.errors import telling
from hvt_common.files import check_there, created, has_nothing
from hvt_common.units import SECOND_NS
from hvt_common.values import Pose
from hvt_gateways.decodable import DecodableRun
from hvt_ground.events import Event, FrameEvent, Notice, Overlay, PoseUpdate, Refinement, Shown, VideoSample
from hvt_ground.recordings.row import RecordedStill
from hvt_ground.sinks import SinkWriter
from hvt_ground.sinks.palette import Rgb, class_colour
from hvt_ground.sinks.rerun.stills import event_text, still_picture

_CHUNK_BYTES = 32 * 1024
"""The most that a kill loses: a chunk is written once it is full."""
_LATEST_NS = (1 << 63) - 1
_THIN_PX, _THICK_PX = 1.0, 3.0
_FONT_PX = 12.0
_Message = CompressedVideo | CompressedImage | ImageAnnotations | LocationFix | Log
_LEVELS = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}


class McapFile(SinkWriter[Event]):
    """An MCAP file; takes the place of one of that name. `UserError` where it cannot be written."""

    def __init__(self, path: Path, *, edge: str) -> None:
        self.path: Path = path
        self._edge = edge
        self._run = DecodableRun()
        self._still = -1
        """The newest one: of several objects in it each has an event, and all together one picture."""
        fresh = has_nothing(path)
        with telling(f"MCAP file {path} cannot be created: "):
            self._file: BinaryIO = os.fdopen(created(path), "wb")
            try:
                self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
                self._file.flush()
            except OSError:
                with suppress(OSError):
                    self._file.close()
                if fresh:  # or each try on a full disk would leave one more
                    path.unlink(missing_ok=True)
                raise

    def log(self, item: Event | RecordedStill) -> None:
        """Write events that have a schema, and stills that were read back; ignore the rest."""
        match item:
            case VideoSample():
                data = self._run.decodable(item)
                if data:
                    self._write("video", CompressedVideo(data=data, format="h265"), item)
            case Overlay():
                self._write("tracks", _annotations(item), item)
            case Refinement():
                if item.still_sequence != self._still and (picture := still_picture(item)) is not None:
                    self._still = item.still_sequence
                    self._write("stills", CompressedImage(data=picture[0], format="jpeg"), item)
                self._write("events", Log(level=Log.INFO, message=event_text(item)), item)
            case RecordedStill():
                self._write("stills", CompressedImage(data=item.jpeg, format="jpeg"), item)
            case PoseUpdate():
                self._write("location", _location(item.pose), item)
            case Notice():
                self._write("events", Log(level=_LEVELS[item.level], message=item.text), item)

    def skipped(self, count: int) -> None:
        """``count`` events are missing: video goes on at its next keyframe."""
        del count
        self._run.interrupt()

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        if self._file.closed:
            return
        with telling(f"MCAP file {self.path} cannot be finished: "), self._file:
            self._writer.finish()  # type: ignore[no-untyped-call]

    def _write(self, topic: str, message: _Message, at: FrameEvent | RecordedStill) -> None:
        if self._file.closed:
            return
        frame_index, capture_ns = at.frame_index, at.capture_ns
        if topic == "stills" and isinstance(at, Shown):
            frame_index, capture_ns = at.shown_at
        # Times come from the wire: one beyond the range of timestamps becomes the nearest that can be held.
        capture_ns = min(max(capture_ns, 0), _LATEST_NS)
        # Foxglove lays annotations over the picture of their own time, not of the whole message's.
        parts = (*message.points, *message.texts) if isinstance(message, ImageAnnotations) else ()
        for one in (message, *parts):
            one.timestamp.CopyFrom(Timestamp(seconds=capture_ns // SECOND_NS, nanos=capture_ns % SECOND_NS))
        if isinstance(message, CompressedVideo | CompressedImage | LocationFix):
            message.frame_id = self._edge
        elif isinstance(message, Log):
            message.name = self._edge
        with telling(f"MCAP file {self.path} cannot be written any further: "):
            check_there(self._file.fileno(), self.path)
            self._writer.write_message(
                f"/{self._edge}/{topic}",
                message,
                log_time=capture_ns,
                publish_time=capture_ns,
                sequence=max(0, frame_index) & 0xFFFFFFFF,
            )
            self._file.flush()  # nothing to do but after a chunk


def _location(pose: Pose) -> LocationFix:
    """The camera's place; NaN for an altitude that nobody says, and for its error."""
    spread = pose.position_error_m**2
    altitude_m, vertical = pose.altitude_m, pose.height_error_m**2
    if altitude_m is None:
        altitude_m = vertical = math.nan
    return LocationFix(
        latitude=pose.latitude_deg,
        longitude=pose.longitude_deg,
        altitude=altitude_m,
        position_covariance=[spread, 0, 0, 0, spread, 0, 0, 0, vertical],
        position_covariance_type=LocationFix.DIAGONAL_KNOWN,
    )


def _annotations(overlay: Overlay) -> ImageAnnotations:
    """A frame around each track, with its id and class, and the rest as metadata of the frame."""
    firm, words = overlay.firm, overlay.words
    result = ImageAnnotations()
    for row, track_id in enumerate(overlay.track_ids.tolist()):
        x1, y1, x2, y2 = overlay.boxes_base_px[row].tolist()
        name, refined = overlay.classes[row], bool(overlay.refined[row])
        colour = _colour(class_colour(words[row]))
        facts = {
            "id": track_id,
            "class": name,
            "base_class": overlay.base_classes[row],
            "confidence": f"{overlay.confidences[row]:.3f}",
            "refined": int(refined),
            "origin": overlay.origins[row],
            "doubted": int(overlay.doubted[row]),
        }
        corners = [Point2(x=x, y=y) for x, y in ((x1, y1), (x2, y1), (x2, y2), (x1, y2))]
        result.points.append(
            PointsAnnotation(
                type=PointsAnnotation.LINE_LOOP,
                points=corners,
                outline_color=colour,
                thickness=_THICK_PX if firm[row] else _THIN_PX,
                metadata=[KeyValuePair(key=key, value=str(value)) for key, value in facts.items()],
            )
        )
        result.texts.append(
            TextAnnotation(
                position=corners[0], text=f"{track_id} {words[row]}", font_size=_FONT_PX, text_color=colour
            )
        )
    return result


def _colour(rgb: Rgb) -> Color:
    red, green, blue = (channel / 255 for channel in rgb)
    return Color(r=red, g=green, b=blue, a=1.0)
