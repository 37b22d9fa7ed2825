"""The base stream: x265 through PyAV, zero latency, bounded in every second.

Settings and why (measured on drone_carpark, intel_car-detection and a panning aerial still, 100 to 1138 kbps):

* A VBV of 0.15 s keeps the run within 1.02 and each rolling second within 1.14 of the target from 300 kbps up,
  on-demand keyframes included; with 0.2 s a keyframe on demand reaches 1.18. x265 leaves up to 40 % of the rate
  unused after a keyframe of a still scene (``strict-cbr`` only fills that up with filler): `SpareRate` uses it.
* ``keyint=-1``: no keyframe comes by itself. The edge requests each one, so that stills can yield to it. x265 is
  opened anew for it, in 2 ms: it never forgets the cost of earlier scenes, and coded a still one's keyframe at QP 51.
* ``pools``: with several worker threads the row-level rate control sees a different order of rows each run, and the
  same input gives other bytes. Lockstep therefore uses one; real time uses several, which halves the time of a
  frame on two cores (keyframes 151 to 81 ms, others 23 to 13).
* x265's workers lower their own priority by 10, to that of perception: a frame then takes twice as long wherever a
  network runs beside it. They get the frame loop's priority back, if the process has the right to raise it.
* ``open-gop=0`` makes a forced I frame an IDR, but within ``min-keyint`` of the last one (a second, by default) it
  stays a plain I frame at which no decoder can start; ``repeat-headers=1`` puts the parameter sets before an IDR.
* ``info=0``: else each keyframe carries x265's settings as text, 2.4 kB.
* BT.709 limited range, signalled: viewers assume it for HD.
* Each picture carries regions of interest (`RegionTagger`). An offset of 0 changes no byte, except in the two fastest
  presets.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import av
import av.error
import numpy as np
from av.filter import Graph
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter

from hvt_common.errors import UserError
from hvt_common.values import AccessUnit, Boxes, Frame, Image, Tracks
from hvt_common.video.hevc import UNBIASED
from hvt_edge.video.encoder import EncoderSettings

BLOCK_PX = 16
"""libx265 keeps one offset for each block of 16x16 luma pixels; a region takes all blocks that it touches."""
MOST_REGIONS = 96
"""Further regions are not attached: the deepest come first."""

_LEAST_SIDE_PX = 1


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle with its own quantiser."""

    box_px: tuple[int, int, int, int]
    """x1, y1, x2, y2 in base pixels, x2 and y2 exclusive; clipped to the picture."""
    offset: float
    """-1…1, in units of 51 steps of the quantiser parameter: -0.1 is 5 steps finer, about half the error."""


class RegionTagger:
    """Attaches regions to the pictures of one stream, which have one size and one format.

    libx265 takes them as side data of the picture. PyAV has no setter for it, but libavfilter's ``addroi`` attaches
    it while a picture passes through. Building the filter takes 0.4 ms for 30 regions; it is reused while they stay.

    Two things are easily got wrong. x265 decides at its first picture whether there are offsets: a stream that starts
    without and gets them later ends the process with a segmentation fault, so every picture is marked, with an offset
    of 0 where no region is wanted (the bytes are then those of a stream without any). And x265 ignores offsets with
    ``aq-mode=0``, which the presets ultrafast and superfast set.
    """

    def __init__(self) -> None:
        self._graph: Graph | None = None
        self._regions: Sequence[Region] = ()

    def tag(self, picture: av.VideoFrame, regions: Iterable[Region], *, whole: float = 0.0) -> av.VideoFrame:
        """The same picture with these regions; where two overlap, the deeper one counts.

        ``whole`` is an offset of the whole picture, to which the regions' offsets are added. The result is valid
        until the next call: its side data belongs to the filter graph of this call.
        """
        size = (picture.width, picture.height)
        wanted = usable(regions, size=size)
        if whole:
            wanted = [Region(one.box_px, min(1.0, max(-1.0, one.offset + whole))) for one in wanted]
            wanted.append(Region((0, 0, *size), whole))  # the first that covers a block counts
        if self._graph is None or wanted != self._regions:
            self._graph, self._regions = _attaching(wanted, picture), wanted
        self._graph.push(picture)
        tagged = self._graph.pull()
        assert isinstance(tagged, av.VideoFrame)
        return tagged


def _attaching(regions: Iterable[Region], picture: av.VideoFrame) -> Graph:
    graph = Graph()
    graph.threads = 1  # else each graph makes a pool of one thread for each core
    last = graph.add_buffer(
        width=picture.width,
        height=picture.height,
        format=picture.format,
        time_base=picture.time_base or Fraction(1, 1000),
    )
    for region in regions:
        x1, y1, x2, y2 = region.box_px
        node = graph.add("addroi", f"{x1}:{y1}:{x2 - x1}:{y2 - y1}:{region.offset:.4f}")
        last.link_to(node)
        last = node
    last.link_to(graph.add("buffersink"))
    graph.configure()
    return graph


def usable(regions: Iterable[Region], *, size: tuple[int, int]) -> list[Region]:
    """Clip to the picture, deepest first, at most `MOST_REGIONS`; one region of offset 0 where none is left."""
    width, height = size
    inside = []
    for region in regions:
        x1, y1, x2, y2 = region.box_px
        box = (max(0, x1), max(0, y1), min(width, x2), min(height, y2))
        if box[2] - box[0] < _LEAST_SIDE_PX or box[3] - box[1] < _LEAST_SIDE_PX:
            continue
        if not math.isfinite(region.offset):
            continue
        inside.append(Region(box, min(1.0, max(-1.0, region.offset))))
    inside.sort(key=lambda region: region.offset)
    return inside[:MOST_REGIONS] or [Region((0, 0, min(BLOCK_PX, width), min(BLOCK_PX, height)), 0.0)]


@dataclass(eq=False)
class TrackRegions:
    """R0: the boxes of the tracks at ``-depth``, less where they cover much of the picture.

    Up to ``free_share`` of the area the depth is as set; beyond, it shrinks in proportion, so that the bits taken
    from the rest of the picture stay about the same.
    """

    size: tuple[int, int]
    _: KW_ONLY
    depth: float
    padding: float = 0.1
    free_share: float = 0.25

    def regions(self, tracks: Tracks | None) -> list[Region]:
        """Return the regions of the next frame, keyframe or not; ``tracks`` (base pixels) may be some frames old."""
        if tracks is None or not tracks.ids.size:
            return []
        best = np.argsort(-tracks.confidences, kind="stable")[:MOST_REGIONS]
        blocks = self._blocks(tracks.boxes_xyxy_px[np.sort(best)])
        share = self._covered(blocks)
        if share <= 0:
            return []
        offset = -self.depth * min(1.0, self.free_share / share)
        return [Region((x1, y1, x2, y2), offset) for x1, y1, x2, y2 in blocks]

    def _blocks(self, boxes: Boxes) -> list[tuple[int, int, int, int]]:
        # The padded boxes on the grid of blocks, inside the picture; boxes outside it are left out.
        pad = (boxes[:, 2:] - boxes[:, :2]) * self.padding
        grown = np.concatenate([boxes[:, :2] - pad, boxes[:, 2:] + pad], axis=1)
        limits = np.array([*self.size, *self.size], np.float64)
        grown = np.clip(np.nan_to_num(grown.astype(np.float64)), 0, limits)
        low = np.floor(grown[:, :2] / BLOCK_PX) * BLOCK_PX
        high = np.minimum(np.ceil(grown[:, 2:] / BLOCK_PX) * BLOCK_PX, limits[:2])
        whole = np.concatenate([low, high], axis=1).astype(int).tolist()
        return [(x1, y1, x2, y2) for x1, y1, x2, y2 in whole if x2 > x1 and y2 > y1]

    def _covered(self, blocks: Sequence[tuple[int, int, int, int]]) -> float:
        width, height = self.size
        mask = np.zeros((math.ceil(height / BLOCK_PX), math.ceil(width / BLOCK_PX)), np.bool_)
        for x1, y1, x2, y2 in blocks:
            mask[y1 // BLOCK_PX : -(-y2 // BLOCK_PX), x1 // BLOCK_PX : -(-x2 // BLOCK_PX)] = True
        return float(mask.mean())


class SpareRate:
    """Steps of the quantiser by which frames are coded finer than by x265's own choice, so that they use the rate.

    x265 follows a scene slowly: a keyframe is as coarse as the VBV makes it, and after it the picture of a still
    camera would get better for five seconds while a third of the rate, and more, is left unused. So each frame whose
    unused bits do not fit into the VBV makes the next ones finer. x265 sees only the bits that this takes, and
    keeps its VBV, except in the first frames where a still scene begins to move.
    """

    _STEPS_PER_FRAME = 5.0
    """Added steps for a frame that has used none of its share."""
    _DECAY = 0.985
    """Factor on the steps from one frame to the next, so that unneeded steps fade."""
    _MOST_STEPS = 24.0

    def __init__(self, settings: EncoderSettings) -> None:
        self._frame_bits = settings.bitrate_bps / settings.fps
        self._depth_bits = settings.bitrate_bps * settings.vbv_s
        self._free_bits = 0.9 * self._depth_bits  # x265's ``vbv-init``
        self._steps = 0.0

    @property
    def steps(self) -> int:
        """Steps for the next frame; 0 for the first, which is a keyframe."""
        return round(self._steps)

    def coded(self, size_bytes: int) -> None:
        """Note a coded frame of ``size_bytes``."""
        self._free_bits = max(0.0, self._free_bits - 8 * size_bytes) + self._frame_bits
        lost_bits = max(0.0, self._free_bits - self._depth_bits)
        self._free_bits -= lost_bits
        finer = self._DECAY * self._steps + self._STEPS_PER_FRAME * lost_bits / self._frame_bits
        self._steps = min(self._MOST_STEPS, finer)


_QP_STEPS = 51
_RATE_BY_DEPTH = 0.45
"""x265's rate grows as a power of .3 to .8 of the depth: less from 60 kbps up in long flights, more at first."""
_QP_TO_LAMBDA = 118
_FEW_ROWS_PX, _SHALLOW_FRAMES = 192, 2.0
"""The rate is held from row to row, and up to this height there are at most three of the usual blocks of 64. Where
the VBV holds less than these frames, blocks of 32 use .86 to 1 of the rate where 64 use .6 to .95, and are .2 to 1.6
dB better. In a deeper VBV they are as good or .3 dB worse, and so they are in higher pictures."""
_WITHOUT_AQ = ("ultrafast", "superfast")
"""Presets without adaptive quantisation, where x265 ignores regions: a trace of it makes them count."""


class BaseEncoder:
    """Turns frames into access units, each at once."""

    def __init__(self, settings: EncoderSettings) -> None:
        # Never `av.logging.set_level`: it makes a decoder's worker that logs wait for the GIL, while the thread that
        # closes that decoder holds the GIL and waits for the worker. PyAV is silent by default.
        self._to_yuv = VideoReformatter()
        self._settings, self._workers = settings, NewThreads()
        self._spent = (0, 0)
        """`spent`, once the encoder is closed."""
        self._context: VideoCodecContext | None = None
        self._tagger = RegionTagger()
        self._count = 0
        self._caller_ns = self._wall_ns = self._ended_ns = 0
        """Processor time of the calling thread, wall time, and processor time of workers that have ended."""
        self._open()
        self.mean_qp = math.nan
        """Quantiser parameter (0…51) of the frame encoded last, averaged over its blocks."""

    def encode(self, frame: Frame, *, keyframe: bool = False, regions: Sequence[Region] = ()) -> AccessUnit:
        """Encode ``frame.base_bgr``; with ``keyframe`` as an IDR that starts a new decodable run.

        Where ``regions`` overlap the deeper one counts.
        """
        began_ns, began_cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        if keyframe and self._count:
            self._ended_ns += self._workers.cpu_ns or 0
            self._context = None  # its memory goes first
            self._open()
        assert self._context is not None, "it is open"
        picture = yuv_picture(self._to_yuv, frame.base_bgr)
        picture = self._tagger.tag(picture, regions, whole=-self._spare.steps / _QP_STEPS)
        picture.pts = self._count
        picture.pict_type = PictureType.I if keyframe else PictureType.NONE
        self._count += 1
        (packet,) = self._context.encode(picture)  # zero latency: one in, one out
        if packet.is_keyframe:  # the first is one, and by then each worker has lowered its priority
            self._workers.raise_priority()
        self._spare.coded(packet.size)
        self.mean_qp = mean_qp_of(packet)
        self._caller_ns += time.thread_time_ns() - began_cpu_ns
        self._wall_ns += time.perf_counter_ns() - began_ns
        return AccessUnit(
            frame_index=frame.index,
            capture_ns=frame.capture_ns,
            data=bytes(packet),
            keyframe=packet.is_keyframe,
        )

    @property
    def spent(self) -> tuple[int, int]:
        """(processor time in nanoseconds, frames) so far; wall time where the system gives no processor time."""
        if self._context is None:
            return self._spent
        workers_ns = self._workers.cpu_ns
        if workers_ns is None:
            return self._wall_ns, self._count
        return self._caller_ns + self._ended_ns + workers_ns, self._count

    def close(self) -> None:
        """End x265's threads, and release its memory: 12.5 MB for each of some frames of 1280x720."""
        self._spent = self.spent
        self._context, self._tagger = None, RegionTagger()

    def _open(self) -> None:
        with self._workers:
            self._context = _opened(self._settings)
        self._spare = SpareRate(self._settings)


def yuv_picture(
    converter: VideoReformatter, base_bgr: Image, *, pixel_format: str = "yuv420p"
) -> av.VideoFrame:
    """A picture, uint8 (height, width, 3) BGR, in the encoder's format: BT.709, limited range."""
    return converter.reformat(
        av.VideoFrame.from_numpy_buffer(base_bgr, format="bgr24"),
        format=pixel_format,
        dst_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
        interpolation=UNBIASED,
        threads=1,
    )


def mean_qp_of(packet: av.Packet[Any]) -> float:
    """The encoder's own value, or NaN: a little-endian 32-bit number in units of 1/118 (``FF_QP2LAMBDA``)."""
    if not packet.has_sidedata("quality_stats"):
        return math.nan
    stats = bytes(packet.get_sidedata("quality_stats"))
    return int.from_bytes(stats[:4], "little") / _QP_TO_LAMBDA


def encoder_context(name: str, settings: EncoderSettings, *, pixel_format: str) -> VideoCodecContext:
    """An encoder of FFmpeg, not open; raises `UserError` if FFmpeg was built without it."""
    try:
        context = av.CodecContext.create(name, "w")
    except (av.error.FFmpegError, ValueError):
        raise UserError(
            f"PyAV {av.__version__} has no encoder {name}: install its wheel from PyPI, which brings one"
        ) from None
    assert isinstance(context, VideoCodecContext)
    context.width, context.height = settings.size
    context.pix_fmt = pixel_format
    context.framerate = Fraction(settings.fps).limit_denominator(100_000)
    context.time_base = 1 / context.framerate
    return context


def _whole(settings: EncoderSettings) -> tuple[int, int]:
    # Rate and depth of the VBV in x265's units: kilobits a second, and kilobits. At these depths a deeper VBV uses
    # more of the rate, and from 7 to 8 kbit is 14 %: with rounding alone, the bits spent would jump by 5 to 8 %
    # there. So depth is rounded up, and the rate lowered by the gain.
    exact_kbit = settings.bitrate_bps / 1000 * settings.vbv_s
    depth_kbit = max(1, math.ceil(exact_kbit))
    kbps = settings.bitrate_bps / 1000 * min(1.0, exact_kbit / depth_kbit) ** _RATE_BY_DEPTH
    return max(1, int(kbps)), depth_kbit


def _opened(settings: EncoderSettings) -> VideoCodecContext:
    kbps, depth_kbit = _whole(settings)
    parameters = {
        "keyint": -1,
        "min-keyint": 1,
        "scenecut": 0,
        "bframes": 0,
        "rc-lookahead": 0,
        "repeat-headers": 1,
        "open-gop": 0,
        "vbv-maxrate": kbps,
        "vbv-bufsize": depth_kbit,
        "pools": settings.threads,
        "frame-threads": 1,
        "colorprim": "bt709",
        "transfer": "bt709",
        "colormatrix": "bt709",
        "range": "limited",
        "log-level": "none",
        "info": 0,
    }
    if settings.preset in _WITHOUT_AQ:
        parameters |= {"aq-mode": 1, "aq-strength": 0.01}
    if settings.size[1] <= _FEW_ROWS_PX and settings.vbv_s * settings.fps < _SHALLOW_FRAMES:
        parameters["ctu"] = 32
    context = encoder_context("libx265", settings, pixel_format="yuv420p")
    context.bit_rate = kbps * 1000
    context.options = {
        "preset": settings.preset,
        "tune": "zerolatency",
        "x265-params": ":".join(f"{key}={value}" for key, value in parameters.items()),
    }
    try:
        context.open()
    except (av.error.FFmpegError, ValueError) as error:
        raise UserError(
            f"x265 does not take {settings.size[0]}x{settings.size[1]} at {settings.fps:g} fps and {kbps} kbps "
            f"({error}): use another --size, --fps or --budget"
        ) from None
    return context


class NewThreads:
    """The threads that a library starts within ``with``, so that they can be given the caller's priority.

    For a library that lowers the priority of its own workers. Raising it again takes a right (``RLIMIT_NICE``,
    ``LimitNICE=+0`` of systemd): without it, they stay as they are.
    """

    def __init__(self) -> None:
        self._before: set[str] = set()
        self._threads: set[str] = set()

    def __enter__(self) -> Self:
        self._before = _threads()
        return self

    def __exit__(self, *_error: object) -> None:
        self._threads = _threads() - self._before

    @property
    def cpu_ns(self) -> int | None:
        """Their processor time; None where the system does not give it."""
        spent = [_cpu_ns(thread) for thread in self._threads]
        return sum(spent) if spent and all(spent) else None

    def raise_priority(self) -> None:
        """Give them the priority of the calling thread, whatever they have set themselves."""
        for thread in list(self._threads):
            try:
                own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
                if os.getpriority(os.PRIO_PROCESS, int(thread)) > own:
                    os.setpriority(os.PRIO_PROCESS, int(thread), own)
            except OSError:  # it has ended, or this is not allowed
                self._threads.discard(thread)


def _threads() -> set[str]:
    try:
        return {one.name for one in Path("/proc/self/task").iterdir()}
    except OSError:
        return set()


def _cpu_ns(thread: str) -> int:
    # Processor time of a thread of this process (proc_pid_schedstat(5)); 0 where it is not known.
    try:
        return int(Path(f"/proc/self/task/{thread}/schedstat").read_text(encoding="ascii").split()[0])
    except (OSError, ValueError, IndexError):
        return 0
