"""Things for an edge's store: real access units, stills as they are kept, and a folder to put them in."""

from dataclasses import replace
from pathlib import Path

from hvt_common.protocol.messages import BacklogStill, pack_backlog_still
from hvt_common.values import AccessUnit
from hvt_edge.backlog.disk import Store
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.clips import START_NS, framed, hard_pictures
from rigs.flight import Flight
from rigs.messages import PLAIN

SIZE = (320, 192)
S = 1_000_000_000
INFO = Flight(1).info()


def coded(count: int, *, keyframe_each: int = 15) -> list[AccessUnit]:
    """Access units at 15 fps."""
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=200_000, preset="ultrafast"))
    frames = framed(hard_pictures(count, size=SIZE))
    return [encoder.encode(frame, keyframe=frame.index % keyframe_each == 0) for frame in frames]


UNITS = coded(60)


def opened(
    path: Path,
    *,
    max_bytes: int = 50_000_000,
    session_id: int = 7,
    oldest_ns: int = 0,
    at_s: tuple[float, float] = (0.0, 0.0),
    boot: str = "a boot",
) -> Store:
    """The store, as a run of an edge opens it ``at_s``: by its clock after `START_NS`, and after its boot."""
    store = Store(
        path,
        max_bytes=max_bytes,
        session_id=session_id,
        info=INFO.pack,
        oldest_ns=oldest_ns,
        clock=lambda: START_NS + round(at_s[0] * S),
        since_boot=lambda: (boot, round(at_s[1] * S)),
    )
    store.enter()
    return store


def packed_still(number: int, *, data: bytes = b"\xff" * 1500, session_id: int = 7) -> bytes:
    header = replace(
        PLAIN,
        session_id=session_id,
        sequence=number,
        frame_index=3,
        capture_ns=START_NS,
        flags=8,
        track_id=1,
        box_source_px=(10.0, 10.0, 42.0, 42.0),
        crop_source_px=(6, 6, 46, 46),
    )
    return pack_backlog_still(BacklogStill(header.pack(data), "image/jpeg", data))


def add_stills(folder: Store, utilities: dict[int, float], *, capture_ns: int = START_NS) -> None:
    for number, utility in utilities.items():
        folder.add_still(number, packed_still(number), utility=utility, capture_ns=capture_ns)


def add_units(folder: Store, units: list[AccessUnit]) -> None:
    for unit in units:
        folder.add_unit(unit)
    folder.end_segment()


def shifted(unit: AccessUnit, seconds: int) -> AccessUnit:
    return AccessUnit(
        unit.frame_index + 15 * seconds, unit.capture_ns + seconds * S, unit.data, unit.keyframe
    )
