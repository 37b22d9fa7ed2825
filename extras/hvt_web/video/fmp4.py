"""Fragmented MP4 for Media Source: coded pictures in, an initialisation segment and one fragment a picture out.

libavformat's muxer learns a picture's duration from the next one, and so gives out every picture one later; at 15
pictures a second that is 67 ms. Here the duration is expected instead, and the next picture begins where this one
ends: the timeline has no holes, at which browsers would stop. Media time is therefore not capture time; who shows a
picture finds the latter beside the fragment.

Boxes: ISO/IEC 14496-12; ``avcC`` and ``hvcC``: ISO/IEC 14496-15, 5.3.3.1 and 8.3.3.1.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass
from statistics import median
from typing import Literal

from hvt_common.video.hevc import nal_units

Codec = Literal["h264", "hevc"]

_TIMESCALE = 90_000
_MATRIX = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
_KEYFRAME_FLAGS, _OTHER_FLAGS = 0x02000000, 0x01010000
"""sample_depends_on 2; sample_depends_on 1 with sample_is_non_sync_sample."""
_DELIMITERS = {"h264": (9,), "hevc": (35,)}
_PARAMETER_SETS = {"h264": (7, 8), "hevc": (32, 33, 34)}
_DURATIONS_S = (0.01, 1.0)
_RECENT = 8


@dataclass(frozen=True, slots=True)
class Start:
    """The header that a player needs before the fragments."""

    codec: str
    """RFC 6381, such as ``avc1.42c01f``."""
    data: bytes


@dataclass(frozen=True, slots=True)
class Fragment:
    """One picture."""

    data: bytes
    media_s: float
    """When it begins in the player's timeline."""
    duration_s: float
    keyframe: bool


class Muxer:
    """One stream of one size. Feed it access units in order, the first a keyframe with its parameter sets."""

    def __init__(self, codec: Codec, *, size: tuple[int, int], fps: float) -> None:
        self._codec: Codec = codec
        self._size = size
        self._sets: tuple[bytes, ...] = ()
        self._sequence = 0
        self._next = 0
        self._last_ns: int | None = None
        self._intervals: deque[float] = deque([1 / fps], maxlen=_RECENT)

    def add(self, data: bytes, *, keyframe: bool, capture_ns: int) -> tuple[Start | None, Fragment | None]:
        """The fragment of an access unit (Annex B), and a start where the parameter sets are new.

        No fragment before the first parameter sets. ``capture_ns`` says how far apart pictures are.
        """
        sets, sample = self._split(data)
        start = None
        if len(sets) == len(_PARAMETER_SETS[self._codec]) and sets != self._sets:
            self._sets = sets
            start = Start(codec_string(self._codec, sets), self._start(sets))
        if not self._sets or not sample:
            return start, None
        duration = round(self._expected_s(capture_ns) * _TIMESCALE)
        self._sequence += 1
        fragment = Fragment(
            _fragment(
                sample, sequence=self._sequence, begins=self._next, duration=duration, keyframe=keyframe
            ),
            self._next / _TIMESCALE,
            duration / _TIMESCALE,
            keyframe,
        )
        self._next += duration
        return start, fragment

    def _expected_s(self, capture_ns: int) -> float:
        # How long this picture will be shown: as the last ones were.
        if self._last_ns is not None and capture_ns > self._last_ns:
            low, high = _DURATIONS_S
            self._intervals.append(min(high, max(low, (capture_ns - self._last_ns) / 1e9)))
        self._last_ns = capture_ns
        return median(self._intervals)

    def _split(self, data: bytes) -> tuple[tuple[bytes, ...], bytes]:
        # Parameter sets, the last of each kind in order, and all else with lengths for start codes.
        sets: dict[int, bytes] = {}
        sample = bytearray()
        for unit in nal_units(data):
            kind = unit[0] & 0x1F if self._codec == "h264" else unit[0] >> 1 & 0x3F
            if kind in _PARAMETER_SETS[self._codec]:
                sets[kind] = unit
            elif kind not in _DELIMITERS[self._codec]:
                sample += struct.pack(">I", len(unit)) + unit
        return tuple(sets[kind] for kind in sorted(sets)), bytes(sample)

    def _start(self, sets: tuple[bytes, ...]) -> bytes:
        width, height = self._size
        kind, configuration = (
            (b"avc1", _box(b"avcC", _avc_configuration(*sets)))
            if self._codec == "h264"
            else (b"hvc1", _box(b"hvcC", _hevc_configuration(*sets)))
        )
        sample_entry = _box(
            kind,
            struct.pack(">6xH16xHHIIIH32sHh", 1, width, height, 0x480000, 0x480000, 0, 1, bytes(32), 24, -1),
            configuration,
        )
        table = _box(
            b"stbl",
            _full(b"stsd", struct.pack(">I", 1), sample_entry),
            *(_full(kind, bytes(4)) for kind in (b"stts", b"stsc", b"stco")),
            _full(b"stsz", bytes(8)),
        )
        data_information = _box(b"dinf", _full(b"dref", struct.pack(">I", 1), _full(b"url ", flags=1)))
        media = _box(
            b"mdia",
            _full(b"mdhd", struct.pack(">IIIIHH", 0, 0, _TIMESCALE, 0, 0x55C4, 0)),
            _full(b"hdlr", struct.pack(">I4s12x", 0, b"vide"), b"\0"),
            _box(b"minf", _full(b"vmhd", bytes(8), flags=1), data_information, table),
        )
        track_header = _full(
            b"tkhd",
            struct.pack(">IIIII8xHHHH", 0, 0, 1, 0, 0, 0, 0, 0, 0),
            _MATRIX,
            struct.pack(">II", width << 16, height << 16),
            flags=3,
        )
        # No duration and no `mehd`: to a browser the stream is live, and it shows each picture as it comes.
        movie_header = _full(
            b"mvhd", struct.pack(">IIIIIH10x", 0, 0, _TIMESCALE, 0, 0x10000, 0x100), _MATRIX, bytes(24),
            struct.pack(">I", 2),
        )  # fmt: skip
        extends = _box(b"mvex", _full(b"trex", struct.pack(">IIIII", 1, 1, 0, 0, 0)))
        file_type = _box(b"ftyp", b"iso5", struct.pack(">I", 512), b"iso5iso6mp41")
        return file_type + _box(b"moov", movie_header, _box(b"trak", track_header, media), extends)


def codec_string(codec: Codec, sets: tuple[bytes, ...]) -> str:
    """The argument of `MediaSource.isTypeSupported` (RFC 6381; ISO/IEC 14496-15, annex E)."""
    if codec == "h264":
        return f"avc1.{sets[0][1:4].hex()}"
    profile = _profile(sets[1])
    space = ("", "A", "B", "C")[profile[0] >> 6]
    compatibility = int(f"{int.from_bytes(profile[1:5]):032b}"[::-1], 2)
    tier = "H" if profile[0] & 0x20 else "L"
    constraints = "".join(f".{byte:X}" for byte in profile[5:11].rstrip(b"\0"))
    return f"hvc1.{space}{profile[0] & 0x1F}.{compatibility:X}.{tier}{profile[11]}{constraints}"


def _profile(sequence_set: bytes) -> bytes:
    # ``profile_tier_level`` of an HEVC sequence parameter set: 12 bytes behind two of header and one of ids.
    return sequence_set.replace(b"\0\0\3", b"\0\0")[3:15]


def _avc_configuration(sequence_set: bytes, picture_set: bytes) -> bytes:
    return b"".join(
        (
            b"\1" + sequence_set[1:4] + b"\xff\xe1",
            struct.pack(">H", len(sequence_set)) + sequence_set,
            b"\1" + struct.pack(">H", len(picture_set)) + picture_set,
        )
    )


def _hevc_configuration(*sets: bytes) -> bytes:
    # 4:2:0 and 8 bits, as of every base stream; one temporal layer, nested; lengths of four bytes.
    head = b"\1" + _profile(sets[1]) + struct.pack(">HBBBBHB", 0xF000, 0xFC, 0xFD, 0xF8, 0xF8, 0, 0x0F)
    arrays = (struct.pack(">BHH", 0x80 | one[0] >> 1 & 0x3F, 1, len(one)) + one for one in sets)
    return head + bytes([len(sets)]) + b"".join(arrays)


def _fragment(sample: bytes, *, sequence: int, begins: int, duration: int, keyframe: bool) -> bytes:
    def moof(data_offset: int) -> bytes:
        flags = _KEYFRAME_FLAGS if keyframe else _OTHER_FLAGS
        run = struct.pack(">IiIII", 1, data_offset, duration, len(sample), flags)
        track = _box(
            b"traf",
            _full(b"tfhd", struct.pack(">I", 1), flags=0x020000),
            _full(b"tfdt", struct.pack(">Q", begins), version=1),
            _full(b"trun", run, flags=0x000701),
        )
        return _box(b"moof", _full(b"mfhd", struct.pack(">I", sequence)), track)

    return moof(len(moof(0)) + 8) + _box(b"mdat", sample)


def _box(kind: bytes, *parts: bytes) -> bytes:
    return struct.pack(">I4s", 8 + sum(map(len, parts)), kind) + b"".join(parts)


def _full(kind: bytes, *parts: bytes, version: int = 0, flags: int = 0) -> bytes:
    return _box(kind, struct.pack(">I", version << 24 | flags), *parts)
