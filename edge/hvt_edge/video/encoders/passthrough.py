"""``--encoder passthrough``: the camera's own units in place of an encoder's, measured against the budget before."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_common.values import AccessUnit, Frame
from hvt_edge.source.contract import CameraStream
from hvt_edge.video.encoders.camera_rates import FullestWindow
from hvt_edge.video.encoders.qualification import Allowed, Measured, line_bytes
from hvt_edge.video.regions import Region

_LONG_KEYFRAMES_S = 4.0
"""A ground that joins, or has lost something, waits so long for a picture: it is told of at the start."""


class Passthrough:
    """An `Encoder` that encodes nothing. The camera decides on keyframes, whatever is requested."""

    mean_qp = math.nan

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """The unit that came with the frame."""
        del keyframe
        assert not regions, "config.check() refuses regions with another encoder than x265"
        return unit_of(frame)


def unit_of(frame: Frame) -> AccessUnit:
    """The camera's unit of this frame, as it is sent."""
    unit = frame.camera_unit
    assert unit is not None, "the source was opened for passthrough"
    return AccessUnit(frame.index, frame.capture_ns, unit.data, keyframe=unit.keyframe)


def measure_camera(stream: CameraStream, *, window_s: float, edge_id: str) -> Measured:
    """The fullest window of the surveyed camera by its own times, and its largest keyframe; line bytes."""
    window, largest = FullestWindow(round(window_s * SECOND_NS)), 0
    for unit in stream.units:
        size = line_bytes(unit.size_bytes, edge_id)
        window.add(size, at_ns=round(unit.at_s * SECOND_NS))
        largest = max(largest, size if unit.keyframe else 0)
    return Measured(window.most_bytes, largest)


def check_camera(name: str, stream: CameraStream, limit: Allowed, *, budget_bps: int, edge_id: str) -> str:
    """The measurement as a sentence. Raises `UserError` with the figure if it does not fit the budget."""
    found = measure_camera(stream, window_s=limit.window_s, edge_id=edge_id)
    rate = bitrate_text(round(8 * found.window_bytes / limit.window_s))
    takes = (
        f"{rate} in its fullest {limit.window_s:g} s (largest keyframe {found.keyframe_bytes / 1000:.1f} kB)"
    )
    if found.window_bytes > limit.window_bytes:
        leaves = bitrate_text(round(8 * limit.window_bytes / limit.window_s))
        raise UserError(
            f"source {name} makes {takes}, and --budget {bitrate_text(budget_bps)} leaves {leaves} for it: "
            "re-encode it with --encoder x265, lower the camera's rate, or raise --budget"
        )
    return f"source {name} is passed through: {stream.fps:g} fps, {takes}"


def about_keyframes(name: str, stream: CameraStream) -> str:
    """The cost of a camera's rare keyframes, as a sentence; empty if there are enough."""
    if stream.keyframe_s <= _LONG_KEYFRAMES_S:
        return ""
    return (
        f"source {name} goes {stream.keyframe_s:.0f} s without a keyframe, and a ground that joins or has lost "
        "something waits so long for a picture: set the camera to one each second or two"
    )
