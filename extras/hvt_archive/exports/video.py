"""The base stream as a video file: its units copied, or decoded with the overlays drawn in and coded again."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.container import OutputContainer

from hvt_common.units import SECOND_NS
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder, parameter_sets
from hvt_ground.events import Overlay, VideoSample
from hvt_ground.recordings.row import Recorded
from hvt_ground.sinks.palette import class_colour

CONTAINERS = {"mp4": "mp4", "mkv": "matroska", "ts": "mpegts"}
"""libavformat's names of the containers."""
_TIME_BASE = Fraction(1, 1000)
_LONGEST = 2**31
"""MP4 has 32 bits for the time between two pictures: 24 days."""
_SET_BACK = 1000
"""A picture this much before the last one is of a clock that was set."""
_CRF = "20"


def write_video(recorded: Recorded, path: Path, *, container: str, burn_in: bool) -> None:
    """Write the pictures with their capture times, from 0 on; ``creation_time`` is when the first was taken.

    ``burn_in`` draws boxes, ids and classes into them, which codes them again (H.264).
    Raises `UserError` where the recording has no video.
    """
    samples = recorded.decodable_video()
    taken = datetime.fromtimestamp(samples[0].capture_ns / SECOND_NS, UTC).isoformat()
    with av.open(str(path.absolute()), "w", format=CONTAINERS[container]) as output:
        output.metadata["creation_time"] = taken
        output.metadata["title"] = f"{recorded.edge}, session {recorded.session}"
        if burn_in:
            _draw(recorded, output)
        else:
            _copy(samples, output, container)


def pictures(recorded: Recorded) -> Iterator[tuple[VideoSample, Image, Overlay]]:
    """Each decodable sample, its picture (uint8 (H, W, 3) BGR, base pixels) and the boxes on it."""
    decoder = BaseDecoder()
    overlays = recorded.overlays()  # at every sample, and at some frames between
    for sample in recorded.decodable_video():
        overlay = next(one for one in overlays if one.frame_index == sample.frame_index)
        if sample.keyframe:
            decoder.reset()
        picture = decoder.decode(sample.data)
        if picture is not None:
            yield sample, picture, overlay


def _copy(samples: Sequence[VideoSample], output: OutputContainer, container: str) -> None:
    with av.open(io.BytesIO(samples[0].data), format="hevc") as probe:
        stream = output.add_stream_from_template(probe.streams.video[0])
    if container == "mp4" and len({parameter_sets(one.data) for one in samples if one.keyframe}) == 1:
        # Apple's players take no other; it has parameter sets once for all, so that they must not change.
        stream.codec_context.codec_tag = "hvc1"
    stream.time_base = _TIME_BASE
    times = _Times(samples[0].capture_ns)
    for sample in samples:
        packet = av.Packet(sample.data)
        packet.stream, packet.time_base = stream, _TIME_BASE
        packet.pts = packet.dts = times.next(sample.capture_ns)
        packet.is_keyframe = sample.keyframe
        output.mux(packet)


def _draw(recorded: Recorded, output: OutputContainer) -> None:
    stream = None
    times = _Times(recorded.decodable_video()[0].capture_ns)
    for sample, picture, overlay in pictures(recorded):
        if stream is None:
            stream = output.add_stream("libx264", options={"crf": _CRF, "preset": "veryfast"})
            stream.height, stream.width = (side - side % 2 for side in picture.shape[:2])
            stream.pix_fmt = "yuv420p"
            stream.time_base = stream.codec_context.time_base = _TIME_BASE
        drawn = _with_boxes(picture, overlay)
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(drawn[: stream.height, : stream.width]), "bgr24"
        )
        frame.pts, frame.time_base = times.next(sample.capture_ns), _TIME_BASE
        output.mux(stream.encode(frame))
    if stream is not None:
        output.mux(stream.encode())


def _with_boxes(picture: Image, overlay: Overlay) -> Image:
    """A copy with a frame, id and class for each track; thick where a still has spoken, unnamed where in doubt."""
    drawn = picture.copy()
    firm, words = overlay.firm, overlay.words
    for row, track_id in enumerate(overlay.track_ids.tolist()):
        x1, y1, x2, y2 = (round(value) for value in overlay.boxes_base_px[row].tolist())
        colour = class_colour(words[row])[::-1]
        cv2.rectangle(drawn, (x1, y1), (x2, y2), colour, 2 if firm[row] else 1)
        text = f"{track_id} {words[row]}"
        x, y = x1, y1 - 4 if y1 > 14 else y2 + 12
        for at, ink in (((x + 1, y + 1), (0, 0, 0)), ((x, y), colour)):
            cv2.putText(drawn, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, ink, 1, cv2.LINE_AA)
    return drawn


class _Times:
    # Of the pictures in `_TIME_BASE`, which grow. After a clock that was set the next one is a frame later: until it
    # had caught up an hour's pictures would pass in seconds.

    def __init__(self, first_ns: int) -> None:
        self._zero_ns, self._last, self._between = first_ns, -1, 1

    def next(self, capture_ns: int) -> int:
        at = round(Fraction(capture_ns - self._zero_ns, SECOND_NS) / _TIME_BASE)
        if self._last - _SET_BACK < at < self._last + _LONGEST:
            at = max(self._last + 1, at)
            self._between = at - self._last
        else:
            at = self._last + self._between
            self._zero_ns = capture_ns - int(at * _TIME_BASE * SECOND_NS)
        self._last = at
        return at
