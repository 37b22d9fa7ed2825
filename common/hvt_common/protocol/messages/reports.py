"""Reports of the edge: `Info` as answer to a query, `Status` once a second."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.ledger import MOST_WINDOW_NS
from hvt_common.protocol.messages.envelope import MOST_VERSION, WIRE_VERSION, Message, Nested
from hvt_common.protocol.messages.fields import (
    I63,
    U32,
    U64,
    Flag,
    Int,
    ListOf,
    MapOf,
    OneOf,
    Real,
    Scaled,
    Text,
    fitted_text,
    wire_field,
)
from hvt_common.values import View

_TIME = Int(0, I63)
_COUNT = Int(0, 2**53 - 1)
_BPS = Int(0, 2**53 - 1)
_SIDE = Int(1, 32767)
_CLASS_NAME_BYTES = 64
_CLASS_NAMES = 2048
_CLASS_NAMES_BYTES = 60_000
_LAST = Int(-1, U32)
_REASONS = MapOf(Int(0, U32), 24)
_CORES = Scaled(0, 4096, 100)
MOST_FAILED_PARTS = 8


def fitted_class_names(names: Sequence[str]) -> tuple[str, ...]:
    """As many of a detector's class names as an `Info` holds, each as it takes them."""
    fitted: list[str] = []
    size_bytes = 0
    for name in names[:_CLASS_NAMES]:
        fitted.append(fitted_text(name, _CLASS_NAME_BYTES))
        size_bytes += 2 + len(fitted[-1].encode())
        if size_bytes > _CLASS_NAMES_BYTES:
            break
    return tuple(fitted)


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Message):
    """Payload of the answer to ``info``: everything about the session that does not change while it runs."""

    MAX_BYTES: ClassVar[int] = 65536
    NEGOTIATES: ClassVar[bool] = True

    lowest_version: int = wire_field(Int(1, MOST_VERSION), default=WIRE_VERSION, since=5, before=4)
    """Versions of the wire that the edge speaks: both sides use the highest that they have in common."""
    highest_version: int = wire_field(Int(1, MOST_VERSION), default=WIRE_VERSION, since=5, before=4)
    session_id: int = wire_field(Int(0, U64))
    edge: str = wire_field(Text(32))
    software: str = wire_field(Text(32))
    """Version of HVT on the edge."""
    started_ns: int = wire_field(_TIME)
    source_size: tuple[int, int] = wire_field(ListOf(_SIDE, 2, 2))
    """(width, height) in pixels."""
    base_size: tuple[int, int] = wire_field(ListOf(_SIDE, 2, 2))
    view_scale: float = wire_field(Real(1e-4, 1e4))
    view_offset_px: tuple[float, float] = wire_field(ListOf(Real(-32767, 32767), 2, 2))
    """base = source x scale + offset, in base pixels."""
    fps: float = wire_field(Real(0.01, 1000))
    codec: str = wire_field(Text(24))
    pace: str = wire_field(OneOf(("realtime", "lockstep")))
    method: str = wire_field(Text(48))
    budget_bps: int = wire_field(_BPS)
    base_bps: int = wire_field(_BPS)
    """The part of the budget that the base stream may use."""
    window_ns: int = wire_field(Int(1, MOST_WINDOW_NS))
    """Length of the rolling window that the budget holds over."""
    class_names: tuple[str, ...] = wire_field(ListOf(Text(_CLASS_NAME_BYTES), _CLASS_NAMES))
    """Class names of the edge's detector."""
    received_ns: int = wire_field(_TIME)
    """When the edge received the question, its clock (t1)."""
    answered_ns: int = wire_field(_TIME)
    """When it answered (t2)."""
    still_codecs: tuple[str, ...] = wire_field(ListOf(Text(24), 8), default=())
    """Codecs of the stills that it sends now; empty where an earlier edge does not say."""
    channels: tuple[str, ...] = wire_field(ListOf(Text(16), 16), default=())
    """On which it sends; empty where an earlier edge does not say."""

    @property
    def view(self) -> View:
        return View(self.source_size, self.base_size, self.view_scale, self.view_offset_px)


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """The health of the edge; counts are since its start."""

    frames_captured: int = wire_field(_COUNT)
    frames_encoded: int = wire_field(_COUNT)
    frames_dropped: int = wire_field(_COUNT)
    """Dropped before encoding."""
    keyframes: int = wire_field(_COUNT)
    tracks: int = wire_field(_COUNT)
    """Distinct tracks seen."""
    base_queue: int = wire_field(Int(0, U32))
    """Access units that wait to be sent."""
    still_queue: int = wire_field(Int(0, U32))
    encode_ms: float = wire_field(Scaled(0, 60_000, 10))
    """Means since the start, at most a minute."""
    detect_ms: float = wire_field(Scaled(0, 60_000, 10))
    feedback_age_ms: int = wire_field(Int(-1, U32))
    """Since the last feedback from any ground; -1 for none yet."""
    frames_dropped_cpu: int = wire_field(_COUNT)
    """The part of `frames_dropped` for which the machine was too slow; `Status.frames` has the others."""
    frames_unanalyzed: int = wire_field(_COUNT)
    """Skipped by perception for want of time."""
    cores_needed: float = wire_field(_CORES)
    """Processor cores that encoder and detector need for every frame; 0 where it is not measured."""
    cores_free: float = wire_field(_CORES)
    """Cores that other processes leave."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedPart:
    """A part of the edge that has failed since its start."""

    part: str = wire_field(Text(24))
    reason: str = wire_field(Text(160))
    """A sentence on the newest failure."""
    failures: int = wire_field(Int(1, U32))
    failed_ns: int = wire_field(_TIME)
    """When it failed last, the edge's clock."""
    working: bool = wire_field(Flag())


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Message):
    """Payload of ``status``: the ledger's totals since the start, the outcomes of candidates, and health."""

    MAX_BYTES: ClassVar[int] = 6144

    session_id: int = wire_field(Int(0, U64))
    sequence: int = wire_field(Int(0, U32))
    state: str = wire_field(OneOf(("running", "ended")))
    send_ns: int = wire_field(_TIME)
    media_ns: int = wire_field(_TIME)
    """Length of the stream so far: frames of the source rate, dropped ones included, in nanoseconds."""
    last_base_sequence: int = wire_field(_LAST)
    """Sequence number of the last access unit sent before this message; -1 for none."""
    last_still_sequence: int = wire_field(_LAST)
    base_bytes: int = wire_field(_COUNT)
    roi_bytes: int = wire_field(_COUNT)
    backlog_bytes: int = wire_field(_COUNT)
    """Chunks of store-and-forward."""
    meta_bytes: int = wire_field(_COUNT)
    overhead_bytes: int = wire_field(_COUNT)
    base_messages: int = wire_field(_COUNT)
    roi_messages: int = wire_field(_COUNT)
    backlog_messages: int = wire_field(_COUNT)
    meta_messages: int = wire_field(_COUNT)
    worst_window_bps: tuple[int, int, int] = wire_field(ListOf(_BPS, 3, 3))
    """Base, roi, total: the fullest rolling window of the run."""
    sent: Mapping[str, int] = wire_field(_REASONS)
    """Stills sent, by reason."""
    deferred: Mapping[str, int] = wire_field(_REASONS)
    dropped: Mapping[str, int] = wire_field(_REASONS)
    health: Health = wire_field(Nested(Health))  # noqa: RUF009 - a dataclass field, not a default
    failed: tuple[FailedPart, ...] = wire_field(ListOf(Nested(FailedPart), MOST_FAILED_PARTS))
    decisions: str = wire_field(Text(120))
    """The decisions of ``auto`` with their reasons, one line for people; empty where settings alone decide."""
    frames: tuple[int, ...] = wire_field(ListOf(_COUNT, 32), default=())
    """How many source frames are in each group of `FRAME_GROUPS`, in its order, zeros at the end left out."""
    coded_fps: float = wire_field(Scaled(0, 1000, 100), default=0.0)
    """Frames a second that the frame rate leaves now; 0 where an earlier edge does not say."""
    auto_fps: bool = wire_field(Flag(), default=False)
    """``--fps auto`` chose it."""

    @property
    def frame_account(self) -> FrameAccount:
        return FrameAccount.of_counts(self.frames, coded_fps=self.coded_fps, auto_fps=self.auto_fps)

    @property
    def outcomes(self) -> Mapping[str, int]:
        """Why candidates have no still: how many were deferred or dropped for each reason."""
        return Counter(self.deferred) + Counter(self.dropped)
