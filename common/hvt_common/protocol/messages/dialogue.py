"""Messages of the ground: info and control requests with their answers, and the receiver report."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from hvt_common.protocol.messages.backlog import MAX_ACKNOWLEDGED_RANGES, AcknowledgedRange
from hvt_common.protocol.messages.envelope import MOST_VERSION, WIRE_VERSION, Message, Nested
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
    Box,
    Flag,
    Int,
    ListOf,
    MapOf,
    Scalar,
    Scaled,
    Text,
    wire_field,
)

MAX_STILL_RESULTS = 32
MAX_MISSING_STILLS = 32
"""How many one report names; of more, the newest."""
MAX_MISSING_BASE = 8
"""How many one report names; of more, none."""
MAX_STILL_CODECS = 24
"""How many a ground names."""
MAX_BASE_CODECS = 8
BASE_CODEC = "h265"
"""The codec of all that an edge of HVT sends on ``base``."""
MAX_TRACKS_NOW = 64
"""How many tracks one answer lists: the most confident."""
_COUNT = Int(0, 2**53 - 1)
_FAR_PX = 32767


class Command(StrEnum):
    """A command of a ground; an edge refuses a command that it does not serve, with a reason."""

    KEYFRAME = "keyframe"
    STILL = "still"
    STILL_OUTCOME = "still-outcome"
    """The outcome of an accepted still."""
    TRACKS = "tracks"
    """The edge's present tracks, by its own ids."""
    SET_BUDGET = "set-budget"
    SET_METHOD = "set-method"
    SEND_BACKLOG = "send-backlog"
    """Send the stored base stream too, before the remaining stills."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoRequest(Message):
    """Payload of a question on ``info``. A question without one is answered alike, and says nothing of codecs."""

    NEGOTIATES: ClassVar[bool] = True

    lowest_version: int = wire_field(Int(1, MOST_VERSION), default=WIRE_VERSION, since=5, before=4)
    """As in `Info`, of the ground."""
    highest_version: int = wire_field(Int(1, MOST_VERSION), default=WIRE_VERSION, since=5, before=4)
    requester_id: int = wire_field(Int(0, U64))
    """Random, new at each start of the ground: a later request of the same number takes the place of this one."""
    still_codecs: tuple[str, ...] = wire_field(ListOf(Text(24), MAX_STILL_CODECS))
    """Codecs of stills that the ground reads: the edge sends no other, but for ``jpeg``."""
    base_codecs: tuple[str, ...] = wire_field(
        ListOf(Text(24), MAX_BASE_CODECS), default=(BASE_CODEC,), since=5, before=(BASE_CODEC,)
    )
    """Codecs of video that the ground reads."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlRequest(Message):
    """Payload of a question on ``control``."""

    TRIMMED: ClassVar[bool] = True

    session_id: int = wire_field(Int(0, U64))
    """The session it is meant for; 0 for whichever runs."""
    command: str = wire_field(Text(24))
    """A `Command`, or a word of some later version."""
    arguments: Mapping[str, int | float | str] = wire_field(MapOf(Scalar(), 8, key_bytes=16))
    request_id: int = wire_field(Int(0, U64), default=0)
    """Random: a question of the same number is the same, repeated since its answer may be lost, and is obeyed once.
    0: each is obeyed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackNow:
    """A track of the edge, as an answer lists it."""

    track_id: int = wire_field(Int(0, U32))
    class_id: int = wire_field(Int(0, 2047))
    """Index into `Info.class_names`."""
    confidence: float = wire_field(Scaled(0, 1, 1000))
    box_source_px: tuple[float, float, float, float] = wire_field(Box(Scaled(-_FAR_PX, _FAR_PX, 8)))
    """x1, y1, x2, y2 in eighths of a pixel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlAnswer(Message):
    """Payload of the answer on ``control``."""

    MAX_BYTES: ClassVar[int] = 4096

    session_id: int = wire_field(Int(0, U64))
    accepted: bool = wire_field(Flag())
    reason: str = wire_field(Text(200))
    """One sentence; empty where accepted."""
    still_request: int = wire_field(Int(-1, U32))
    """The number of the still that was accepted: it comes on ``roi`` with the parameter ``ask`` of this value; -1
    for any other command."""
    frame_index: int = wire_field(Int(-1, U32))
    """The frame that the still shows, or whose tracks these are; -1 where neither."""
    tracks: tuple[TrackNow, ...] = wire_field(ListOf(Nested(TrackNow), MAX_TRACKS_NOW))
    """For the command ``tracks``; else empty."""
    note: str = wire_field(Text(200), default="")
    """A sentence for the user beside an accepted command; for a pending still, how and when it will come."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StillResult:
    """The ground's result for one still."""

    still_sequence: int = wire_field(Int(0, U32))
    track_id: int = wire_field(Int(-1, U32))
    """The edge's track, as the still said."""
    class_name: str = wire_field(Text(64))
    confidence: float = wire_field(Scaled(0, 1, 1000))
    entropy_nats: float = wire_field(Scaled(0, 20, 1000))
    ground_track_id: int = wire_field(Int(-1, U32))
    """The ground's track that it refined; -1 where it matched none, or none yet."""
    again: bool = wire_field(Flag())
    """The still names a base frame that this ground does not have: send it once more, without the base."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Feedback(Message):
    """Payload of ``feedback``: a receiver report, counts since the receiver met this session."""

    MAX_BYTES: ClassVar[int] = 6144

    session_id: int = wire_field(Int(0, U64))
    receiver_id: int = wire_field(Int(0, U64))
    """Random, new at each start of the ground: several grounds may report on one edge."""
    sequence: int = wire_field(Int(0, U32))
    send_ns: int = wire_field(Int(0, I63))
    """The ground's clock, without steps since its start."""
    last_frame_index: int = wire_field(Int(-1, U32))
    """The last frame that the ground is done with; -1 before the first. A lockstep edge waits for it."""
    base_messages: int = wire_field(_COUNT)
    base_bytes: int = wire_field(_COUNT)
    roi_messages: int = wire_field(_COUNT)
    roi_bytes: int = wire_field(_COUNT)
    lost: int = wire_field(_COUNT)
    """Messages of base that were not received, or not before they were sent again; while a ground waits for the first
    keyframe of the session, all that the edge says it has sent."""
    corrupt: int = wire_field(_COUNT)
    """Messages of base that came damaged."""
    base_sequence: int = wire_field(Int(-1, U32))
    """The highest of ``base`` received; -1 for none. With the next field, it drives the edge's rate control."""
    base_held_us: int = wire_field(Int(0, U32))
    """``send_ns`` minus its time of arrival."""
    still_sequence: int = wire_field(Int(-1, U32))
    """The highest of ``roi`` received; -1 for none."""
    missing_stills: tuple[int, ...] = wire_field(ListOf(Int(0, U32), MAX_MISSING_STILLS))
    """Sequences of ``roi`` below it that were not received; the edge may send them again."""
    delay_p50_ms: float = wire_field(Scaled(-1, 3_600_000, 10))
    """Median capture to receive since the last report, clocks reconciled; -1 where unknown."""
    clock_offset_ns: int = wire_field(Int(-I63, I63))
    """Edge clock minus ground clock, as the ground estimates it."""
    clock_error_ns: int = wire_field(Int(-1, I63))
    """The estimate is right within this; -1 where there is none."""
    stills: tuple[StillResult, ...] = wire_field(ListOf(Nested(StillResult), MAX_STILL_RESULTS))
    """New since the last report."""
    backlog: tuple[AcknowledgedRange, ...] = wire_field(
        ListOf(Nested(AcknowledgedRange), MAX_ACKNOWLEDGED_RANGES)
    )
    """Objects of which chunks were received since the last report."""
    objects_detected: int = wire_field(Int(-1, 65535), default=-1)
    """Objects that the ground's own detector showed when it last looked at a picture, up to ``last_frame_index``.
    Objects known only from the edge's tracks or from stills do not count. -1 before it has looked."""
    missing_base: tuple[int, ...] = wire_field(ListOf(Int(0, U32), MAX_MISSING_BASE), default=())
    """Sequences of ``base`` behind which newer ones wait; the edge may send each again. None where they are more: a
    keyframe is the shorter way then."""

    @property
    def misses_video(self) -> bool:
        """Whether pictures were sent to it and none could be shown: a ground that takes no video misses none."""
        return self.base_sequence < 0 and self.lost > 0

    @property
    def lost_so_far(self) -> int:
        """Lost frames, the missing ones of now included."""
        return self.lost + len(self.missing_base)
