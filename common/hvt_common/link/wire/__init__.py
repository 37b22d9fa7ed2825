"""Every message of HVT as bytes, and back. docs/wire.md is the same for people of other languages."""

from __future__ import annotations

from hvt_common.link.wire.dialogue import (
    MAX_STILL_RESULTS,
    MAX_TRACKS_NOW,
    Command,
    ControlAnswer,
    ControlRequest,
    Feedback,
    StillResult,
    TrackNow,
)
from hvt_common.link.wire.fields import WireError, fitted_text
from hvt_common.link.wire.reports import Health, Info, Status, fitted_class_names
from hvt_common.link.wire.sealed import (
    MAX_PAYLOAD_BYTES,
    WIRE_VERSION,
    CorruptError,
    Message,
    UnknownVersionError,
    kinds,
)
from hvt_common.link.wire.stream import MAX_ALSO, AlsoShown, BaseHeader, Flags, RoiHeader
from hvt_common.link.wire.track_step import TrackStep, TrackStepDecoder, TrackStepEncoder

__all__ = [
    "MAX_ALSO",
    "MAX_PAYLOAD_BYTES",
    "MAX_STILL_RESULTS",
    "MAX_TRACKS_NOW",
    "WIRE_VERSION",
    "AlsoShown",
    "BaseHeader",
    "Command",
    "ControlAnswer",
    "ControlRequest",
    "CorruptError",
    "Feedback",
    "Flags",
    "Health",
    "Info",
    "Message",
    "RoiHeader",
    "Status",
    "StillResult",
    "TrackNow",
    "TrackStep",
    "TrackStepDecoder",
    "TrackStepEncoder",
    "UnknownVersionError",
    "WireError",
    "fitted_class_names",
    "fitted_text",
    "kinds",
]
