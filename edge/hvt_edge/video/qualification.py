"""Three seconds of the scene through an encoder before the flight: does it stay within the budget's limits?

A frame that is too large is not dropped, it waits for its window. So an encoder that overshoots makes the video late
all the time, and takes the stills' share. x265's peaks are known (`encoder_settings`); another's are measured:
the fullest window, and the largest of two keyframes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate

from hvt_common.errors import UserError, foreign
from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.runtime.failures import reason_of
from hvt_common.units import bitrate_text
from hvt_common.values import AccessUnit, Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES, BASE_PEAK
from hvt_edge.video.encoder import Encoder, usual_keyframe_bytes

_RUN_S = 3.0
_MOST_WINDOW_S = 1.5
"""A longer window is not measured: half of the run would be its first keyframe."""
_MOST_KEYFRAME_SHARE = 0.5
"""Largest keyframe, as a share of the base's part of a window."""
_MOST_RUNS = 3
_LEAST_HEADROOM = 0.5
"""An encoder whose target must be lowered further wastes most of the budget, most of the time."""
_MARGIN = 0.97
"""The flight is longer than the run, and will have a fuller window."""


@dataclass(frozen=True, slots=True)
class Allowed:
    """The base stream's limits, in line bytes: headers and transport included."""

    window_bytes: int
    window_frames: int
    window_s: float
    keyframe_bytes: int


@dataclass(frozen=True, slots=True)
class Measured:
    """The measured bytes of an encoder, in line bytes."""

    window_bytes: int
    keyframe_bytes: int

    def overshoot(self, limit: Allowed) -> float:
        """The larger of both ratios to the limits; above 1 is too much."""
        return max(self.window_bytes / limit.window_bytes, self.keyframe_bytes / limit.keyframe_bytes)


def allowed(*, size: tuple[int, int], fps: float, total_bps: int, base_bps: int, window_s: float) -> Allowed:
    """The limits that hold in flight (`RollingBudget`): `BASE_PEAK` times B_v in a window, and B_tot.

    ``fps`` is the rate of coded frames; ``total_bps`` without metadata, ``window_s`` the budget's. A keyframe may
    take half of the base's part of a window, or x265's need at this size if that is more.
    """
    window_s = min(window_s, max(_MOST_WINDOW_S, 2 / fps))
    share_bytes = base_bps * window_s / 8
    return Allowed(
        window_bytes=int(min(BASE_PEAK * share_bytes, total_bps * window_s / 8)),
        window_frames=max(1, round(window_s * fps)),
        window_s=window_s,
        keyframe_bytes=int(max(_MOST_KEYFRAME_SHARE * share_bytes, 1.5 * usual_keyframe_bytes(size))),
    )


def run_frames(fps: float, limit: Allowed) -> int:
    """Number of coded frames of a run: three seconds, and two windows at least."""
    return max(round(_RUN_S * fps), 2 * limit.window_frames)


def measure(units: Sequence[AccessUnit], limit: Allowed, *, edge_id: str) -> Measured:
    """The fullest window of the limit's frames, and the largest keyframe."""
    sizes = [line_bytes(len(unit.data), edge_id) for unit in units]
    sums = [0, *accumulate(sizes)]
    frames = min(limit.window_frames, len(sizes))
    windows = (sums[end] - sums[end - frames] for end in range(frames, len(sums)))
    keyframes = (size for unit, size in zip(units, sizes, strict=True) if unit.keyframe)
    return Measured(max(windows), max(keyframes))


def headroom_of(
    name: str,
    *,
    open_at: Callable[[float], Encoder],
    scene: Callable[[], Iterable[Frame]],
    frames: int,
    limit: Allowed,
    edge_id: str,
) -> float:
    """The factor of its target with which the encoder stays within ``limit``: 0.5…1.

    ``open_at(share)`` opens it at that share of its target. ``scene()`` gives the ``frames`` of a run, of which the
    first and the middle one are keyframes; it may give fewer, and none where the flight is over. Raises `UserError`
    where the encoder overshoots also with its target lowered, or its units cannot be decoded.
    """
    share, first, last = 1.0, None, None
    for _ in range(_MOST_RUNS):
        try:
            units = _coded(open_at(share), scene(), middle=frames // 2)
        except UserError:
            raise
        except foreign() as error:
            raise UserError(f"--encoder {name} does not work here ({reason_of(error)}): take x265") from error
        if not units:
            return share
        last = measure(units, limit, edge_id=edge_id)
        first = first or last
        if last.overshoot(limit) <= 1:
            return share
        lowered = share / last.overshoot(limit) * _MARGIN
        if lowered < _LEAST_HEADROOM:
            break
        share = lowered
    assert first is not None, "there was a run"
    raise UserError(_refusal(name, first, limit, share=share))


def _coded(encoder: Encoder, scene: Iterable[Frame], *, middle: int) -> list[AccessUnit]:
    units: list[AccessUnit] = []
    decoder: BaseDecoder | None = None
    for count, frame in enumerate(scene):
        unit = encoder.encode(frame, keyframe=count in (0, middle))
        high, wide = frame.base_bgr.shape[:2]
        decoder = decoder or BaseDecoder(size=(wide, high))
        picture = decoder.decode_yuv(unit.data)
        if picture is None or picture.size != (wide, high):
            raise ValueError(f"its unit of frame {count} gives no picture of {wide}x{high}")
        units.append(unit)
    return units


def line_bytes(payload: int, edge_id: str) -> int:
    key, encoding = EdgeKeys(edge_id)[Channel.BASE], DELIVERIES[Channel.BASE].encoding
    around = overhead_bytes(payload, BASE_ATTACHMENT_BYTES, key=key, encoding=encoding)
    return payload + BASE_ATTACHMENT_BYTES + around


def _refusal(name: str, found: Measured, limit: Allowed, *, share: float) -> str:
    rates = [
        bitrate_text(round(8 * size / limit.window_s)) for size in (found.window_bytes, limit.window_bytes)
    ]
    lowered = "" if share == 1 else f", and too much with its target lowered to {share:.0%}"
    return (
        f"--encoder {name} overshoots: its fullest {limit.window_s:g} s took {rates[0]} of the {rates[1]} that the "
        f"budget leaves it, its largest keyframe {found.keyframe_bytes / 1000:.1f} kB of "
        f"{limit.keyframe_bytes / 1000:.1f}{lowered}: take x265, or raise --budget"
    )
