"""Size, rate and preset of base frames at a given bitrate and on a given processor: models, fitted to measurements.

Fewer frames get more bits each. Measured on a still and on a fast moving camera from 100 to 400 kbps
(docs/base-stream.md), F1 and class agreement of tracks rise down to three to five frames a second wherever x265 needs
a mean quantiser above about 32, provided that positions between two frames are predicted from both. Smaller pictures
lose more objects than their bits win, so the size falls last.

`FrameSkip` chooses the source frames to code: each n-th, and with ``--fps auto`` n follows from the quantiser that
x265 needs at the given rate, held in a band; `PresetControl` chooses x265's preset by its processor time. Both change
at keyframes only, because the encoder is opened anew for it.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Final

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS
from hvt_edge.operating import Operating
from hvt_edge.video.encoder import SLOWEST

_log = logging.getLogger(__name__)

SIZES = ((1280, 720), (960, 540), (640, 360), (480, 270), (320, 180))
"""The ladder of ``--size auto`` for a source of 16:9; others keep its areas and their own aspect ratio. It ends where
x265 still codes 15 frames a second on two cores; ``--size`` may be larger."""

_STEPS = (1, 2, 3, 5, 8, 15)
"""The ladder of n: each n-th source frame is coded."""
_LEAST_FPS = 2.0
"""A budget's window of a second holds two frames at least (see config)."""

LEAST_SIDE_PX = 64
# Bits for each pixel of a coded frame: the least at which a size is worth its pixels, and at which a frame is coded.
_SIZE_BITS_PER_PX = 0.020
_RATE_BITS_PER_PX = 0.040

_COST: Final = {"ultrafast": 0.63, "superfast": 0.77, SLOWEST: 1.0}
"""Processor time relative to the slowest: .58 to .69 and .74 to .79 on two clips at 300 and 800 kbps."""
_LEAST_CORES: Final = 0.4
_SHARE: Final = 0.2
_PLAINLY: Final = 1.15
_WINDOW_NS: Final = 30 * SECOND_NS

Spent = Callable[[], tuple[int, int]]
"""(processor time in nanoseconds, frames) of the running encoder, since it was opened."""


@dataclass(frozen=True, slots=True)
class QuantiserBand:
    """Mean quantisers (0…51) at which frames are worth their bits."""

    fine: float
    """Below it more frames are coded, …"""
    coarse: float
    """… above it fewer, …"""
    far: float
    """… and above this two steps fewer."""


SPARING = QuantiserBand(fine=25.0, coarse=32.0, far=36.0)
"""For users who want the frame rate that shows most, whatever the delay. 7 wide: a step of the ladder moved the
quantiser by 1 to 2.5, two together by 4 at most, so that the choice settles."""
PROMPT = QuantiserBand(fine=28.0, coarse=33.5, far=51.0)
"""Between 15 and 7.5 frames a second, for users who want pictures early too. Measured at 200 and 300 kbps on drawn
scenes and on pictures under a virtual camera (docs/design-notes/auto.md): 7.5 named more objects where 15 needed 34
and more, and fewer where 15 needed 30."""


def choose_base(
    payload_bps: float,
    source_size: tuple[int, int],
    *,
    size: tuple[int, int] | None,
    fps: float | None,
    most_fps: float,
    least_fps: float = _LEAST_FPS,
) -> tuple[tuple[int, int], int]:
    """The base stream's (width, height), and n where each n-th frame of ``most_fps`` is coded.

    ``payload_bps`` is x265's rate, without headers of any transport. ``size`` and ``fps`` are the user's
    settings, None for ``auto``: then the base is never larger than the source, and no slower than ``least_fps``. A
    set ``fps`` codes each source frame, so n is 1. Raises `UserError` where the source is too small for any base
    stream.
    """
    nominal_fps = most_fps if fps is None else fps
    most_n = 1 if fps is not None else most_decimation(most_fps, least_fps=least_fps)
    if size is None:
        # The largest that a frame's bits fill at the lowest rate wanted: fewer frames can pay for a larger size.
        frame_bits, sizes = payload_bps / nominal_fps * min(most_n, 3), sizes_of(source_size)
        size = next((one for one in sizes if frame_bits / (one[0] * one[1]) >= _SIZE_BITS_PER_PX), sizes[-1])
    bits_per_px = payload_bps / nominal_fps / (size[0] * size[1])
    fitting = [n for n in _STEPS if n <= most_n and bits_per_px * n >= _RATE_BITS_PER_PX]
    return size, fitting[0] if fitting else max(n for n in _STEPS if n <= most_n)


def better_decimation(
    decimation: int, *, mean_qp: float, most_decimation: int, band: QuantiserBand = SPARING
) -> int:
    """The n one step of the ladder, or two, nearer to the band in which frames are worth their bits."""
    steps = [n for n in _STEPS if n <= most_decimation]
    at = max((index for index, n in enumerate(steps) if n <= decimation), default=0)
    if mean_qp > band.coarse:
        at += 2 if mean_qp > band.far else 1
    elif mean_qp < band.fine:
        at -= 1
    return steps[min(len(steps) - 1, max(0, at))]


def most_decimation(fps: float, *, least_fps: float = _LEAST_FPS) -> int:
    """The largest n of the ladder that leaves ``least_fps`` of ``fps`` source frames a second."""
    return max((n for n in _STEPS if fps / n >= least_fps), default=1)


def sizes_of(source_size: tuple[int, int]) -> list[tuple[int, int]]:
    """The ladder for a source of this (width, height), largest first: its aspect ratio, even sides, none larger."""
    width, height = source_size
    if min(width, height) < LEAST_SIDE_PX:
        raise UserError(
            f"the source has {width}x{height} pixels, and a base stream has {LEAST_SIDE_PX} on each side at least: "
            "give --size"
        )
    whole = (width // 2 * 2, height // 2 * 2)
    sizes = [whole]
    for area in (wide * high for wide, high in SIZES):
        scale = math.sqrt(area / (width * height))
        size = (round(width * scale / 2) * 2, round(height * scale / 2) * 2)
        if min(size) >= LEAST_SIDE_PX and size[0] * size[1] < 0.9 * sizes[-1][0] * sizes[-1][1]:
            sizes.append(size)
    largest = SIZES[0][0] * SIZES[0][1]
    return [size for size in sizes if size[0] * size[1] <= 1.05 * largest] or [whole]


@dataclass(eq=False)
class FrameSkip:
    """Codes each ``decimation``-th source frame. Where one was missed, the next is coded in its place.

    It codes no more frames than ``least_decimation()`` allows at the time of a keyframe.
    """

    decimation: int = 1
    """The n in force, changed by `at_keyframe` only."""
    _: KW_ONLY
    least_decimation: Callable[[], int] = lambda: 1

    def __post_init__(self) -> None:
        assert self.decimation >= 1
        self._wanted = self.decimation
        """n without the limit."""
        self._next: int | None = None

    def codes(self, index: int) -> bool:
        """Tell whether this source frame is to be coded; indices rise."""
        return self._next is None or index >= self._next

    def coded(self, index: int, *, keyframe: bool, mean_qp: float) -> None:
        """Note that this frame was coded. After a keyframe, which may come at any index, the count starts anew."""
        del mean_qp
        if self._next is None or keyframe:
            self._next = index + self.decimation
        else:
            self._next += self.decimation * max(1, math.ceil((index + 1 - self._next) / self.decimation))

    def at_keyframe(self, index: int) -> int:
        """Decide on ``decimation`` from this frame on, which will be a keyframe."""
        self._decide(index)
        self.decimation = max(self._wanted, self.least_decimation())
        return self.decimation

    def wants_keyframe(self, index: int) -> bool:
        """Whether more frames are worth a keyframe of their own after this one."""
        del index
        return False

    def _decide(self, index: int) -> None:
        del index


@dataclass(eq=False)
class MeasuredFrameSkip(FrameSkip):
    """``--fps auto``: decided anew at keyframes, from the mean quantiser of the newest ``window_frames``.

    With ``own_keyframes`` an increase of frames gets a keyframe of its own; a decrease waits for the next one. The
    decision depends on the coded frames alone, so that in lockstep the same input gives the same bytes.
    """

    _: KW_ONLY
    most_decimation: int
    rest_frames: int
    window_frames: int
    band: QuantiserBand = SPARING
    own_keyframes: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._decided_index: int | None = None
        self._quantisers: deque[tuple[int, float]] = deque()
        """(index, mean quantiser) of the newest frames."""

    def coded(self, index: int, *, keyframe: bool, mean_qp: float) -> None:
        """See `FrameSkip`. Keyframes are coarser by nature and do not count."""
        super().coded(index, keyframe=keyframe, mean_qp=mean_qp)
        if self._decided_index is None:
            self._decided_index = index
        if not keyframe and math.isfinite(mean_qp):
            self._quantisers.append((index, mean_qp))
        while self._quantisers and self._quantisers[0][0] <= index - self.window_frames:
            self._quantisers.popleft()

    def wants_keyframe(self, index: int) -> bool:
        return self.own_keyframes and self._may_decide(index) and self._better() < self._wanted

    def _decide(self, index: int) -> None:
        if self._may_decide(index):
            self._wanted, self._decided_index = self._better(), index
            self._quantisers.clear()

    def _may_decide(self, index: int) -> bool:
        decided = self._decided_index
        return decided is not None and index - decided >= self.rest_frames and bool(self._quantisers)

    def _better(self) -> int:
        return better_decimation(
            self._wanted,
            mean_qp=sum(qp for _, qp in self._quantisers) / len(self._quantisers),
            most_decimation=self.most_decimation,
            band=self.band,
        )


@dataclass(frozen=True, slots=True)
class PresetChoice:
    """A preset, and why it is not the slowest."""

    preset: str = SLOWEST
    says: str = ""
    """A line for the user; empty for the slowest, and for a preset that the user has chosen."""


def share_of(cores: float) -> float:
    """Cores that encoding may take, of ``cores``."""
    return max(min(_LEAST_CORES, cores / 2), _SHARE * cores)


def choose_preset(slowest_cores: float, *, most_cores: float) -> PresetChoice:
    """The slowest preset within ``most_cores``, if `SLOWEST` takes ``slowest_cores``; else the fastest."""
    within = [one for one, cost in _COST.items() if slowest_cores * cost <= most_cores]
    preset = within[-1] if within else next(iter(_COST))
    if preset == SLOWEST:
        return PresetChoice()
    took = f"{slowest_cores:.2g} of a core" if slowest_cores < 1 else f"{slowest_cores:.1f} cores"
    return PresetChoice(preset, f"preset {preset}: {SLOWEST} would take {took}")


class PresetControl:
    """Decides at keyframes whether x265 is to be opened with another preset; sets ``operating.now.preset``.

    It is the slowest for which the machine has time, by measurement: encoding is to take at most `share_of`
    the processors at the full rate of coded frames, in processor time and not by the clock, because a frame that
    waits behind other work takes none. The cost of another preset follows from the running one by `_COST`. It steps
    only where the mean over half a minute shows plainly that it should.
    The opener of an encoder passes a function that returns its cost (`watch`). Time is an argument.
    """

    def __init__(self, operating: Operating, *, nominal_fps: float, most_cores: float) -> None:
        self._operating = operating
        self._nominal_fps, self._most_cores = nominal_fps, most_cores
        self._spent: Spent = lambda: (0, 0)
        self._before = (0, 0)
        self._total = (0, 0)
        """Cost in this window of encoders that are closed."""
        self._since_ns: int | None = None

    def watch(self, spent: Spent) -> None:
        """Measure another encoder from now on, which runs with the preset that is in force."""
        self._total = self._in_window()
        self._spent, self._before = spent, spent()

    def wants_another(self, now_ns: int) -> bool:
        """Whether the encoder is to be opened anew with the preset that this call sets; called at each keyframe."""
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
        self._operating.set(preset=choice.preset, preset_says=choice.says)
        _log.info("%s", choice.says or f"preset {choice.preset}: there is time for it again")
        return True

    def _in_window(self) -> tuple[int, int]:
        spent_ns, frames = self._spent()
        return self._total[0] + spent_ns - self._before[0], self._total[1] + frames - self._before[1]

    def _begin(self, now_ns: int) -> None:
        self._since_ns, self._total, self._before = now_ns, (0, 0), self._spent()
