"""The settings of x265, from a budget in line bits: rate, VBV, and the least it can follow; and ``--preset auto``."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hvt_common.protocol.channels import DELIVERIES, Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.units import SECOND_NS
from hvt_edge.link.budget import BASE_ATTACHMENT_BYTES, frames_bps
from hvt_edge.operating import Operating

_log = logging.getLogger(__name__)

PRESETS = ("ultrafast", "superfast", "veryfast", "faster", "fast", "medium")
VBV_S = 0.15
"""Depth of the VBV buffer in seconds of the base rate."""

# At QP 51 the keyframes of 25 aerial pictures took at the most 0.6, 1.6, 2.5, 3.9 and 7.8 kB at 320x180, 640x360,
# 960x540, 1280x720 and 1920x1080, half of them less than half of it: 770 bytes and 0.0034 a pixel. x265 can go no
# lower, whatever the target is; where one takes more, the stage codes it again with less detail.
_KEYFRAME_FLOOR_BYTES = 770
_KEYFRAME_FLOOR_BYTES_PER_PX = 0.0034
# At usual thin rates keyframes take more, as far as the VBV lets them: 3.0, 3.9, 4.9 and 5.9 kB up to 1280x720.
_KEYFRAME_BYTES = 2060
_KEYFRAME_BYTES_PER_SIDE_PX = 4.0
# The frames after a keyframe follow a target down to some 300 bits and 0.0045 bit a pixel each: 67 kbps at 1280x720
# and 15 fps.
_FRAME_FLOOR_BITS = 300
_FRAME_FLOOR_BITS_PER_PX = 0.0045

# The fullest rolling second over the target, keyframes on demand included, from 300 kbps up (see encode).
_PEAK = 1.14
_TIGHT_VBV_S = 0.1
_TIGHT_PEAK = 1.04  # of 1.05 to 1.09; what is left waits some milliseconds (budget.earliest_ns)
_KEYFRAME_EVERY_S = 5.0
"""x265 never takes back what keyframes cost beyond a frame's share: at low rates all of it, at 650 kbps two thirds.
x265 gets so much less, for the first keyframe, one each ten seconds, and some that grounds ask for."""
_KEYFRAME_SHARE = 0.005
"""Of the base's bytes, at most, for keyframes of the schedule."""
STATUS_BYTES = 320
"""The size of a `Status`."""
SLOWEST: Final = "veryfast"
"""The preset of studies, the demo and all of lockstep: there time does not matter."""
_COST: Final = {"ultrafast": 0.63, "superfast": 0.77, SLOWEST: 1.0}
"""Processor time against that of the slowest: .58 to .69 and .74 to .79 on two clips at 300 and 800 kbps."""
_LEAST_CORES: Final = 0.4
_SHARE: Final = 0.2
_PLAINLY: Final = 1.15
_WINDOW_NS: Final = 30 * SECOND_NS

Spent = Callable[[], tuple[int, int]]
"""(processor time in nanoseconds, frames) of the encoder that runs, since it was opened."""


@dataclass(frozen=True, slots=True)
class EncoderSettings:
    """Settings of x265; ``bitrate_bps`` is the payload alone, without headers of any transport."""

    size: tuple[int, int]
    fps: float
    bitrate_bps: int
    preset: str = SLOWEST
    vbv_s: float = VBV_S
    threads: int = 1
    """Worker threads; more than one is faster, and not the same bytes each run."""
    side_data: bool = False
    """Whether `BaseEncoder.encode` takes regions."""


def keyframe_floor_bytes(size: tuple[int, int]) -> int:
    """The smallest keyframe of a textured picture of ``size`` (width, height)."""
    return round(_KEYFRAME_FLOOR_BYTES + _KEYFRAME_FLOOR_BYTES_PER_PX * size[0] * size[1])


def usual_keyframe_bytes(size: tuple[int, int]) -> int:
    """The usual bytes of a keyframe of ``size`` (width, height) at thin rates."""
    return round(_KEYFRAME_BYTES + _KEYFRAME_BYTES_PER_SIDE_PX * math.sqrt(size[0] * size[1]))


def most_keyframe_bytes(size: tuple[int, int], fps: float, base_bps: int) -> int:
    """About the most that a keyframe takes: what the VBV holds at this B_v, or what x265 cannot go below."""
    return max(keyframe_floor_bytes(size), round(_vbv_s(fps) * base_bps / 8))


def keyframe_interval_s(size: tuple[int, int], base_bps: int) -> float:
    """The default time between scheduled keyframes: 10 s, up to 60 s where the rate is thin.

    A keyframe that the VBV lets through at a low rate is far coarser than the frames before it, and the picture takes
    seconds to recover: at 200 kbps and 1280x720 the objects found fell from 62 to 6. Grounds that join or lose
    something request theirs anyhow; the schedule only lets a viewer jump within a recording. So its bytes
    are held to half a percent of the stream.
    """
    return min(60.0, max(10.0, 8 * usual_keyframe_bytes(size) / (_KEYFRAME_SHARE * base_bps)))


def keyframe_total_bps(size: tuple[int, int], *, window_s: float, metadata_bps: int, edge_id: str) -> int:
    """The least total of which each window holds a keyframe, with ``status``, tracks and pose beside it."""
    keyframe_bps = 8 * keyframe_floor_bytes(size) / window_s
    beside_bps = base_overhead_bps(keyframe_bps, fps=1 / window_s, edge_id=edge_id)
    return math.ceil(keyframe_bps + beside_bps + metadata_bps)


def minimum_bps(size: tuple[int, int], fps: float) -> int:
    """The lowest payload rate that x265 can follow at this size and frame rate, keyframes apart."""
    return round(fps * (_FRAME_FLOOR_BITS + size[0] * size[1] * _FRAME_FLOOR_BITS_PER_PX))


def base_overhead_bps(base_bps: float, *, fps: float, edge_id: str) -> float:
    """The share of headers, framing and ``status`` in ``base_bps``: the encoder gets the rest."""
    payload = round(base_bps / 8 / fps)
    key = EdgeKeys(edge_id).key(Channel.BASE)
    encoding = DELIVERIES[Channel.BASE].encoding
    per_frame = BASE_ATTACHMENT_BYTES + overhead_bytes(
        payload, BASE_ATTACHMENT_BYTES, key=key, encoding=encoding
    )
    per_second = STATUS_BYTES + overhead_bytes(STATUS_BYTES, 0, key=EdgeKeys(edge_id).key(Channel.STATUS))
    return 8 * (per_frame * fps + per_second)


def encoder_settings(
    *,
    size: tuple[int, int],
    fps: float,
    preset: str,
    total_bps: int,
    base_bps: int,
    edge_id: str,
    window_s: float = 1.0,
    side_data: bool = False,
) -> EncoderSettings:
    """Settings of x265 that keep the base stream within B_v, and its fullest second within B_tot.

    Where stills have a share, they yield to the base's peaks. Where video takes (nearly) the whole budget, as in M0,
    nothing can yield: the VBV is made tighter and the target lowered by the peak that is left. Where a window of
    ``window_s`` holds no whole number of frames, the target is lowered until it holds all that fall into it.

    ``fps`` is the rate of coded frames: with fewer of them less goes into headers, and the VBV holds one at least.
    ``side_data`` is needed by `TrackRegions`.
    """
    tight = base_bps * _PEAK > total_bps
    line_bps = min(base_bps, total_bps / _TIGHT_PEAK) if tight else base_bps
    payload_bps = line_bps - _beside_bps(line_bps, size=size, fps=fps, edge_id=edge_id)
    frames_line_bps = line_bps - _debt_bps(size)
    payload_bps += frames_bps(frames_line_bps, total_bps, fps=fps, window_s=window_s) - frames_line_bps
    return EncoderSettings(
        size=size,
        fps=fps,
        bitrate_bps=max(1, round(payload_bps)),
        preset=preset,
        vbv_s=_vbv_s(fps, tight=tight),
        side_data=side_data,
    )


def least_base_bps(size: tuple[int, int], fps: float, *, edge_id: str) -> int:
    """The lowest B_v at which x265 can still follow its target."""
    payload_bps = minimum_bps(size, fps)
    return round(payload_bps + _beside_bps(payload_bps, size=size, fps=fps, edge_id=edge_id))


def payload_bps(base_bps: int, *, size: tuple[int, int], fps: float, edge_id: str) -> float:
    """About what x265 gets of B_v; never below 1."""
    return max(1.0, base_bps - _beside_bps(base_bps, size=size, fps=fps, edge_id=edge_id))


def _vbv_s(fps: float, *, tight: bool = False) -> float:
    return max(_TIGHT_VBV_S if tight else VBV_S, 1 / fps)


def _beside_bps(line_bps: float, *, size: tuple[int, int], fps: float, edge_id: str) -> float:
    # The part of the base's rate beside x265: headers, framing, ``status``, and its debt of keyframes.
    return base_overhead_bps(line_bps, fps=fps, edge_id=edge_id) + _debt_bps(size)


def _debt_bps(size: tuple[int, int]) -> float:
    return 8 * usual_keyframe_bytes(size) / _KEYFRAME_EVERY_S


@dataclass(frozen=True, slots=True)
class PresetChoice:
    """A preset, and why it is not the slowest."""

    preset: str = SLOWEST
    says: str = ""
    """One line for people; empty for the slowest, and for one that the user has chosen."""


def share_of(cores: float) -> float:
    """Processors, of so many, that encoding may take."""
    return max(min(_LEAST_CORES, cores / 2), _SHARE * cores)


def choose_preset(slowest_cores: float, *, most_cores: float) -> PresetChoice:
    """The slowest preset within ``most_cores``, where `SLOWEST` would take so much; else the fastest."""
    within = [one for one, cost in _COST.items() if slowest_cores * cost <= most_cores]
    preset = within[-1] if within else next(iter(_COST))
    if preset == SLOWEST:
        return PresetChoice()
    took = f"{slowest_cores:.2g} of a core" if slowest_cores < 1 else f"{slowest_cores:.1f} cores"
    return PresetChoice(preset, f"preset {preset}: {SLOWEST} would take {took}")


class PresetControl:
    """Decides at keyframes whether x265 is to be opened with another preset; sets ``operating.now.preset``.

    It is the slowest for which the machine has time, measured and not guessed: encoding is to take at most `share_of`
    the processors at the full rate of coded frames, by the processor time that it takes and not by the clock: what
    waits behind others takes none. What another preset would take follows from the one that runs by `_COST`. It steps
    only where half a minute in the mean says so plainly.
    Whoever opens an encoder says how to ask it what it takes (`watch`). Time is an argument.
    """

    def __init__(self, operating: Operating, *, nominal_fps: float, most_cores: float) -> None:
        self._operating = operating
        self._nominal_fps, self._most_cores = nominal_fps, most_cores
        self._spent: Spent = lambda: (0, 0)
        self._before = (0, 0)
        self._total = (0, 0)
        """Of this window, in encoders that are closed."""
        self._since_ns: int | None = None

    def watch(self, spent: Spent) -> None:
        """Another encoder codes from now on, with the preset that is in force."""
        self._total = self._in_window()
        self._spent, self._before = spent, spent()

    def wants_another(self, now_ns: int) -> bool:
        """Whether the encoder is to be opened anew with the preset that this sets; call it at each keyframe."""
        if self._since_ns is None:
            self._begin(now_ns)
        assert self._since_ns is not None, "set above"
        spent_ns, frames = self._in_window()
        if now_ns - self._since_ns < _WINDOW_NS or not frames:
            return False
        self._begin(now_ns)
        now = self._operating.now
        fps = self._nominal_fps / now.decimation
        slowest_cores = spent_ns / frames / SECOND_NS * fps / _COST[now.preset]
        faster, choice, slower = (
            choose_preset(slowest_cores * by, most_cores=self._most_cores)
            for by in (_PLAINLY, 1, 1 / _PLAINLY)
        )
        if now.preset in (faster.preset, choice.preset, slower.preset):
            return False
        self._operating.encode_with(choice.preset, choice.says)
        _log.info("%s", choice.says or f"preset {choice.preset}: there is time for it again")
        return True

    def _in_window(self) -> tuple[int, int]:
        spent_ns, frames = self._spent()
        return self._total[0] + spent_ns - self._before[0], self._total[1] + frames - self._before[1]

    def _begin(self, now_ns: int) -> None:
        self._since_ns, self._total, self._before = now_ns, (0, 0), self._spent()
