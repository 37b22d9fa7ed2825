"""The attachments of the two streams: the headers of access units and stills."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Any, ClassVar, Self

from hvt_common.protocol.messages.envelope import Message, Nested, from_values, kinds
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
    Box,
    Int,
    Listed,
    ListOf,
    MapOf,
    Scalar,
    Scaled,
    Text,
    WireError,
    Word,
    wire_field,
)
from hvt_common.protocol.messages.track_boxes import MOST_CLASSES
from hvt_common.runtime.statistics import Newest

MAX_ALSO = 15
"""How many further tracks one still may name."""

_FAR_PX = 32767
_BOX = Box(Scaled(-_FAR_PX, _FAR_PX, 8))
_CROP = Box(Int(0, _FAR_PX), empty=False)
_COMPACT = 5
"""Since this version a still's header is sent as `StillWire`."""


class Flags(IntFlag):
    """Bits of ``flags``; unknown bits are ignored."""

    KEYFRAME = 1
    """Decoding can start here."""
    PARAMETER_SETS = 2
    """VPS, SPS and PPS are inside."""
    LOCKSTEP = 4
    """Sent as fast as the parts allow: capture times are media time and say nothing about delay."""
    STORED = 8
    """Stored at the edge while the link was down, and sent afterwards."""
    RESENT = 16
    """Sent again, since a ground missed it (`Feedback.missing_base`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OfFrame(Message):
    """The beginning of each message that belongs to a frame."""

    session_id: int = wire_field(Int(0, U64))
    """Random, new at each start of the edge."""
    sequence: int = wire_field(Int(0, U32))
    """0, 1, 2 … for each message of the channel; a hole means that messages were lost."""
    frame_index: int = wire_field(Int(0, U32))
    """Index of the frame at the source rate; a frame dropped before encoding leaves a hole here only."""
    capture_ns: int = wire_field(Int(0, I63))
    """Unix time at the source, nanoseconds of the edge's clock."""
    send_delay_ns: int = wire_field(Int(-I63, I63))
    """Send time minus ``capture_ns``."""

    @property
    def send_ns(self) -> int:
        """When the edge handed the message to Zenoh, its clock; media time in lockstep."""
        return self.capture_ns + self.send_delay_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseHeader(OfFrame):
    """Attachment of ``base``."""

    MAX_BYTES: ClassVar[int] = 80

    flags: int = wire_field(Int(0, 255))

    @property
    def keyframe(self) -> bool:
        return bool(self.flags & Flags.KEYFRAME)


@dataclass(frozen=True, slots=True, kw_only=True)
class AlsoShown:
    """A further track that a still shows."""

    track_id: int = wire_field(Int(0, U32))
    """The edge's."""
    box_source_px: tuple[float, float, float, float] = wire_field(_BOX)
    """x1, y1, x2, y2 in eighths of a pixel."""


STILL_CODEC_WORDS = ("jpeg", "webp", "avif", "jxl", "h264-intra", "residual")
"""Their positions are sent; another codec by its name. A new one stands last."""
STILL_REASON_WORDS = ("gain", "due", "new", "uncertain", "small", "utility", "asked", "again", "stored")
_LAST_NS = 2**63 - 1
_MOST_CAPTURES = 1024
_PER_PX = 8
_PLACE = Int(-2 * _PER_PX * _FAR_PX, 2 * _PER_PX * _FAR_PX)


@dataclass(frozen=True, slots=True, kw_only=True)
class OfStill(OfFrame):
    """The beginning of a still's header, in each version."""

    MAX_BYTES: ClassVar[int] = 1024
    MAX_PAYLOAD: ClassVar[int] = 2**20
    """The largest still, 512x512 pixels, has 768 KiB before it is coded; a ground queues hundreds."""

    capture_ns: int = wire_field(Int(-1, I63))
    """-1: that of the access unit of this frame."""
    flags: int = wire_field(Int(0, 255))
    track_id: int = wire_field(Int(-1, U32))
    """The edge's track; -1 where the still belongs to none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillWire(OfStill):
    """A `RoiHeader` as it is sent."""

    TRIMMED: ClassVar[bool] = True

    place: tuple[int, ...] = wire_field(ListOf(_PLACE, 10, least=8))
    """The crop's x, y, width and height; how far the track's box lies inside its left, top, right and bottom side,
    in eighths; and, where it is not the crop's own, the coded size."""
    class_name: int | str = wire_field(Listed(MOST_CLASSES - 1, 64))
    """The first is its index in `Info.class_names`."""
    confidence: float = wire_field(Scaled(0, 1, 1000))
    reason: str = wire_field(Word(STILL_REASON_WORDS, 48))
    codec: str = wire_field(Word(STILL_CODEC_WORDS, 24))
    quality_pct: int = wire_field(Int(0, 100))
    base_check: int = wire_field(Int(-1, U32), default=-1)
    parameters: Mapping[str, int | float | str] = wire_field(MapOf(Scalar(), 8, key_bytes=16), default={})
    also: tuple[AlsoShown, ...] = wire_field(ListOf(Nested(AlsoShown), MAX_ALSO), default=())

    @classmethod
    def of(cls, header: RoiHeader) -> StillWire:
        x1, y1, x2, y2 = header.crop_source_px
        left, top, right, bottom = (round(_PER_PX * side) for side in header.box_source_px)
        parameters = dict(header.parameters)
        coded = (parameters.pop("w", x2 - x1), parameters.pop("h", y2 - y1))
        check: Any = parameters.pop("b", -1)
        return cls(
            **{name: getattr(header, name) for name in _SAME},
            place=(
                *(x1, y1, x2 - x1, y2 - y1),
                *(left - _PER_PX * x1, top - _PER_PX * y1, _PER_PX * x2 - right, _PER_PX * y2 - bottom),
                *(() if coded == (x2 - x1, y2 - y1) else coded),
            ),
            base_check=check,
            parameters=parameters,
        )

    @classmethod
    def of_version(cls, version: int, values: list[Any]) -> Self:
        """Checked as a `RoiHeader`."""
        return cls.of(RoiHeader.of_version(version, values))  # type: ignore[return-value]

    def header(self) -> RoiHeader:
        """The header with its boxes unpacked; raises `WireError` for an impossible place."""
        if len(self.place) == 9:
            raise WireError("a place of 9 numbers: 8 or 10 are accepted")
        x1, y1, width, height, left, top, right, bottom, *coded = self.place
        crop = x1, y1, x1 + width, y1 + height
        box = (
            *(_PER_PX * x1 + left, _PER_PX * y1 + top),
            *(_PER_PX * crop[2] - right, _PER_PX * crop[3] - bottom),
        )
        if not _APART.isdisjoint(self.parameters):
            raise WireError(f"{', '.join(sorted(_APART))} are fields of their own, not parameters")
        if coded and not all(1 <= side <= _FAR_PX for side in coded):
            raise WireError(f"a coded size of {coded[0]}x{coded[1]}")
        known: dict[str, int | float | str] = dict(zip(("w", "h"), coded, strict=False))
        if self.base_check >= 0:
            known["b"] = self.base_check
        return RoiHeader(
            **{name: getattr(self, name) for name in _SAME},
            crop_source_px=_CROP.decode(list(crop)),
            box_source_px=_BOX.decode(list(box)),
            parameters={**known, **self.parameters},
        )


_APART = frozenset(("w", "h", "b"))
_SAME = tuple(name for name, _ in kinds(StillWire) if name not in ("place", "base_check", "parameters"))


@dataclass(frozen=True, slots=True, kw_only=True)
class RoiHeader(OfStill):
    """Attachment of ``roi``. Boxes are x1, y1, x2, y2 in source pixels, x2 and y2 exclusive.

    Its fields are those of version 4; `StillWire` is the form on the link.
    """

    box_source_px: tuple[float, float, float, float] = wire_field(_BOX)
    """The track's box at that frame, in eighths of a pixel; may reach beyond the frame."""
    crop_source_px: tuple[int, int, int, int] = wire_field(_CROP)
    """The part of the source frame in the still."""
    class_name: str = wire_field(Text(64))
    """By the edge's detector. As it comes it may be an index: see `named`."""
    confidence: float = wire_field(Scaled(0, 1, 1000))
    reason: str = wire_field(Text(48))
    """Why the method sent it."""
    codec: str = wire_field(Text(24))
    quality_pct: int = wire_field(Int(0, 100))
    parameters: Mapping[str, int | float | str] = wire_field(MapOf(Scalar(), 8, key_bytes=16))
    """Further parameters for the decoder; empty for JPEG. ``w`` and ``h`` are the coded size where that is not
    the size of the crop."""
    also: tuple[AlsoShown, ...] = wire_field(ListOf(Nested(AlsoShown), MAX_ALSO))
    """Further tracks that the same crop shows."""

    def on_wire(self) -> StillWire:
        return StillWire.of(self)

    @classmethod
    def of_version(cls, version: int, values: list[Any]) -> Self:
        """The message whose ``values`` are those of version 4."""
        if version < _COMPACT:
            return from_values(cls, values, version)
        return from_values(StillWire, values, version).header()  # type: ignore[return-value]

    def named(self, class_names: Sequence[str]) -> RoiHeader:
        """With the name of its class, from `Info.class_names`; `WireError` where that has no such index."""
        index: Any = self.class_name
        if isinstance(index, str):
            return self
        if index >= len(class_names):
            raise WireError(f"a still of class {index}, where {len(class_names)} are named")
        return replace(self, class_name=class_names[index])


class CaptureTimes:
    """When the frames of ``base`` were captured: the header of a still leaves that out where its frame was sent."""

    def __init__(self) -> None:
        self._known: Newest[tuple[int, int], int] = Newest(_MOST_CAPTURES)
        """Session and frame → capture time, the newest."""

    def note(self, header: BaseHeader) -> None:
        self._known[header.session_id, header.frame_index] = header.capture_ns

    def knows(self, session_id: int, frame_index: int) -> bool:
        """Whether a still of this frame need not say it."""
        return (session_id, frame_index) in self._known

    def filled(self, header: RoiHeader, *, otherwise_ns: int) -> RoiHeader:
        """The header with its time: that of its frame; where that was lost, reckoned from the two nearest frames.

        Of one frame that is known the time is its; where none is, ``otherwise_ns``.
        """
        if header.capture_ns >= 0:
            return header
        capture_ns = self._known.get((header.session_id, header.frame_index))
        if capture_ns is None:
            capture_ns = self._reckoned(header.session_id, header.frame_index, otherwise_ns)
        return replace(header, capture_ns=min(max(0, capture_ns), _LAST_NS))

    def _reckoned(self, session_id: int, frame_index: int, otherwise_ns: int) -> int:
        near = sorted(
            (
                (abs(index - frame_index), index, at)
                for (one, index), at in self._known.items()
                if one == session_id
            )
        )
        if len(near) < 2:
            return near[0][2] if near else otherwise_ns
        (_, first, first_ns), (_, second, second_ns) = near[:2]
        return first_ns + (frame_index - first) * (second_ns - first_ns) // (second - first)
