"""One stretch of the base stream on disk: a Matroska file that any player opens, with an index of its frames.

Matroska counts milliseconds and knows no frame index, so each frame has a record in the index: frame index,
capture time, size and checksum. Both files only ever grow, and what a kill leaves of them is a beginning of both: as
many frames as both have whole are read, the others are left out.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO

import av
import av.error

from hvt_common.protocol.messages import MAX_BACKLOG_BYTES, BacklogUnit
from hvt_common.values import AccessUnit

__all__ = [
    "BLOCK_BYTES",
    "SEGMENT_NS",
    "DamagedError",
    "OpenSegment",
    "SegmentWriter",
    "blocks",
    "index_of",
    "last_ns",
    "read_segment",
]

_RECORD = struct.Struct("<IQIIB")
"""Frame index, capture time (ns), CRC-32 and size of the frame with start codes of four bytes, keyframe."""
_LONG, _SHORT = b"\0\0\0\1", b"\0\0\1"
_PARAMETER_SETS = (32, 33, 34)
"""NAL unit types of HEVC: VPS, SPS, PPS. x265 puts the long start code before these and the first NAL of a frame."""
SEGMENT_NS = 10_000_000_000
"""A keyframe is wanted when a segment is so long: eviction and sending go by segments."""
_MOST_SEGMENT_BYTES = MAX_BACKLOG_BYTES - 512 * 1024
_MOST_SEGMENT_UNITS = 2400
BLOCK_BYTES = 4096
"""Files take whole blocks, as on most disks."""


class DamagedError(Exception):
    """What is on disk is not what was written."""


def index_of(video: Path) -> Path:
    """The index that belongs to a video file."""
    return video.with_suffix(".index")


class SegmentWriter:
    """Appends access units. ``parameter_sets`` is a keyframe that describes the stream: the first unit, if it is one.

    Raises `OSError` where the disk takes no more.
    """

    def __init__(self, video: Path, *, parameter_sets: bytes) -> None:
        self._index: BinaryIO = index_of(video).open("wb", buffering=0)
        # Short clusters, each flushed: a kill costs the last fifth of a second.
        options = {"cluster_time_limit": "100", "flush_packets": "1"}
        self._start_ns: int | None = None
        self._last_pts = -1
        try:
            self._container = av.open(str(video), "w", format="matroska", options=options)
            with av.open(io.BytesIO(parameter_sets), format="hevc") as template:
                self._stream = self._container.add_stream_from_template(template.streams.video[0])
        except (av.error.FFmpegError, OSError):
            self._index.close()
            raise
        self._stream.time_base = Fraction(1, 1000)

    def write(self, unit: AccessUnit) -> None:
        """Append one access unit; later than the one before."""
        self._start_ns = unit.capture_ns if self._start_ns is None else self._start_ns
        self._last_pts = max(self._last_pts + 1, round((unit.capture_ns - self._start_ns) / 1e6))
        packet = av.Packet(unit.data)
        packet.stream = self._stream
        packet.pts = packet.dts = self._last_pts
        packet.time_base = Fraction(1, 1000)
        packet.is_keyframe = unit.keyframe
        self._container.mux(packet)
        whole = b"".join(_LONG + nal for nal in _nals(unit.data))
        record = _RECORD.pack(
            unit.frame_index, unit.capture_ns, zlib.crc32(whole), len(whole), int(unit.keyframe)
        )
        if self._index.write(record) != len(record):
            raise OSError("the index was not written whole")

    def close(self) -> None:
        """End both files; on a full disk what is there stays readable all the same."""
        try:
            self._container.close()
        finally:
            self._index.close()


class OpenSegment:
    """The segment that is being written, and which unit begins the next.

    Raises OSError or FFmpegError where the disk takes no more.
    """

    def __init__(self, path: Path, first: AccessUnit, parameter_sets: bytes) -> None:
        self.path = path
        self.first = first
        self._last = (first.frame_index - 1, first.capture_ns - 1)
        self._size_bytes = self._units = 0
        self._writer = SegmentWriter(path, parameter_sets=parameter_sets)

    @property
    def span_ns(self) -> int:
        """From its first frame to its last."""
        return max(0, self._last[1] - self.first.capture_ns)

    @property
    def disk_bytes(self) -> int:
        """About."""
        return 2 * BLOCK_BYTES + blocks(self._size_bytes)

    def ends_before(self, unit: AccessUnit) -> bool:
        """Whether this unit begins another segment."""
        if unit.frame_index <= self._last[0] or unit.capture_ns <= self._last[1]:
            return True
        if self._units >= _MOST_SEGMENT_UNITS or self._size_bytes + len(unit.data) > _MOST_SEGMENT_BYTES:
            return True
        long = unit.capture_ns - self.first.capture_ns >= SEGMENT_NS // 2
        return unit.keyframe and (long or not self.first.keyframe)

    def write(self, unit: AccessUnit) -> None:
        """Append."""
        self._writer.write(unit)
        self._last = (unit.frame_index, unit.capture_ns)
        self._size_bytes += len(unit.data) + 64  # with what Matroska and the index add
        self._units += 1

    def close(self) -> None:
        """End it."""
        self._writer.close()


def read_segment(video: Path) -> tuple[BacklogUnit, ...]:
    """The frames of a segment up to the first damaged one. Raises `DamagedError` where not even one is whole."""
    units: list[BacklogUnit] = []
    try:
        records = index_of(video).read_bytes()
        for (frame_index, capture_ns, crc, size, keyframe), nals in zip(
            _RECORD.iter_unpack(records[: len(records) // _RECORD.size * _RECORD.size]),
            _stored(video),
            strict=False,
        ):
            whole = b"".join(_LONG + nal for nal in nals)
            late = units and not (frame_index > units[-1].frame_index and capture_ns > units[-1].capture_ns)
            if len(whole) != size or zlib.crc32(whole) != crc or late:
                break
            units.append(BacklogUnit(frame_index, capture_ns, bool(keyframe), _as_coded(nals)))
    except (av.error.FFmpegError, OSError, IndexError) as error:
        if not units:
            raise DamagedError(f"{video.name} cannot be read ({error})") from None
    if not units:
        raise DamagedError(f"{video.name} holds no whole frame")
    return tuple(units)


def last_ns(video: Path) -> int:
    """Capture time of the last frame in the index; 0 where there is none. Raises OSError."""
    with index_of(video).open("rb") as index:
        count = index.seek(0, io.SEEK_END) // _RECORD.size
        if not count:
            return 0
        index.seek((count - 1) * _RECORD.size)
        capture_ns: int = _RECORD.unpack(index.read(_RECORD.size))[1]
        return capture_ns


def blocks(size_bytes: int) -> int:
    """The disk space that a file of so many bytes takes."""
    return -(-size_bytes // BLOCK_BYTES) * BLOCK_BYTES


def _nals(data: bytes) -> list[bytes]:
    """The NAL units of an access unit in Annex B form, without start codes."""
    starts: list[tuple[int, int]] = []
    at = data.find(_SHORT)
    while at >= 0:
        starts.append((at - 1 if at and data[at - 1] == 0 else at, at + 3))
        at = data.find(_SHORT, at + 3)
    ends = [begin for begin, _ in starts[1:]] + [len(data)]
    return [data[inside:end] for (_, inside), end in zip(starts, ends, strict=True)]


def _stored(video: Path) -> Iterator[list[bytes]]:
    """The NAL units of each frame in a Matroska file, where each is preceded by its length."""
    with av.open(str(video)) as container:
        for packet in container.demux(video=0):
            data = bytes(packet)
            if not data:
                continue
            nals, at = [], 0
            while at + 4 <= len(data):
                size = int.from_bytes(data[at : at + 4], "big")
                nals.append(data[at + 4 : at + 4 + size])
                at += 4 + size
            yield nals


def _as_coded(nals: list[bytes]) -> bytes:
    return b"".join(
        (_LONG if number == 0 or (nal and nal[0] >> 1 & 0x3F in _PARAMETER_SETS) else _SHORT) + nal
        for number, nal in enumerate(nals)
    )
