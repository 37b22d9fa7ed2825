"""Reads MPEG-TS with KLV back, with PyAV and klvdata."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import av
import av.error
import klvdata
from klvdata.klvparser import KLVParser
from klvdata.misb0601 import UASLocalMetadataSet
from klvdata.setparser import SetParser


@UASLocalMetadataSet.add_parser
class _Vmti(SetParser):
    """Item 74, which klvdata knows and cannot read."""

    key = b"\x4a"
    parsers: ClassVar[dict[bytes, Any]] = {}


@dataclass(frozen=True, slots=True)
class Target:
    """A VTarget pack."""

    track_id: int
    items: dict[int, bytes]

    def number(self, tag: int) -> int:
        return int.from_bytes(self.items[tag])

    @property
    def class_name(self) -> str:
        return dict(KLVParser(self.items[102], 1))[b"\x02"].decode()


@dataclass(frozen=True, slots=True)
class KlvPacket:
    """A UAS Datalink local set."""

    at: int
    """In 90 kHz, from the stream's first picture."""
    data: bytes
    items: dict[int, Any]
    """By tag: what klvdata makes of it."""
    vmti: dict[int, bytes] | None
    targets: list[Target]


@dataclass
class ReadStream:
    """All of a file."""

    video: list[tuple[int, bytes]] = field(default_factory=list)
    """Times, and units without the access unit delimiter that a transport stream has."""
    klv: list[KlvPacket] = field(default_factory=list)


def read_stream(source: Path | str, **options: Any) -> ReadStream:
    """Read it to its end, or until nothing more comes."""
    found = ReadStream()
    packets: list[tuple[str, int, bytes]] = []
    with av.open(str(source), **options) as container, suppress(av.error.FFmpegError):
        assert [stream.type for stream in container.streams] == ["video", "data"]
        packets.extend(
            (one.stream.type, one.pts, bytes(one)) for one in container.demux() if one.pts is not None
        )
    first = min((at for kind, at, _ in packets if kind == "video"), default=0)
    for kind, at, data in packets:
        if kind == "video":
            found.video.append((at - first, data))
        else:
            found.klv += packets_of(data, at=at - first)
    return found


def packets_of(data: bytes, *, at: int = 0) -> Iterator[KlvPacket]:
    """The local sets in the bytes of a packet; their checksums hold."""
    for local_set in klvdata.StreamParser(data):
        assert isinstance(local_set, UASLocalMetadataSet), data
        assert klvdata.common.packet_checksum(data) == data[-2:]
        items = {key[0]: one for key, one in local_set.items.items()}
        nested = items.pop(74, None)
        vmti = None if nested is None else {key[0]: one.value for key, one in nested.items.items()}
        targets = [] if vmti is None else list(_targets(vmti.get(101, b"")))
        yield KlvPacket(at, data, {tag: one.value.value for tag, one in items.items()}, vmti, targets)


def _targets(series: bytes) -> Iterator[Target]:
    while series:
        size, series = _length(series)
        pack, series = series[:size], series[size:]
        assert len(pack) == size, "the series is as long as it says"
        track_id, more = 0, 0x80
        while more:
            track_id, more, pack = track_id << 7 | pack[0] & 0x7F, pack[0] & 0x80, pack[1:]
        yield Target(track_id, {key[0]: value for key, value in KLVParser(pack, 1)})


def _length(data: bytes) -> tuple[int, bytes]:
    if data[0] < 0x80:
        return data[0], data[1:]
    more = data[0] & 0x7F
    return int.from_bytes(data[1 : 1 + more]), data[1 + more :]
