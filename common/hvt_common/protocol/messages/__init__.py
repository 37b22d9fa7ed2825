"""Every message of HVT as bytes, and back. docs/wire.md is the same for people of other languages.

Who makes vectors of them reaches into `envelope`, `fields`, `bits`, `range_coder` and `track_boxes`.
"""

from hvt_common.protocol.channels import MAX_PAYLOAD_BYTES
from hvt_common.protocol.messages.backlog import (
    MAX_ACKNOWLEDGED_RANGES,
    MAX_BACKLOG_BYTES,
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    BacklogStill,
    BacklogUnit,
    ObjectKey,
    pack_backlog_still,
    pack_backlog_units,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.protocol.messages.dialogue import (
    BASE_CODEC,
    MAX_MISSING_BASE,
    MAX_MISSING_STILLS,
    MAX_STILL_CODECS,
    MAX_STILL_RESULTS,
    MAX_TRACKS_NOW,
    Command,
    ControlAnswer,
    ControlRequest,
    Feedback,
    InfoRequest,
    StillResult,
    TrackNow,
)
from hvt_common.protocol.messages.envelope import (
    MOST_UNKNOWN_FIELDS,
    READ_VERSIONS,
    SPOKEN_VERSIONS,
    WIRE_VERSION,
    CorruptError,
    Message,
    PackedMessage,
    UnknownVersionError,
    kinds,
)
from hvt_common.protocol.messages.fields import WireError, fitted_text
from hvt_common.protocol.messages.pose_report import PoseDecoder, PoseEncoder, PoseReport
from hvt_common.protocol.messages.reports import (
    MOST_FAILED_PARTS,
    FailedPart,
    Health,
    Info,
    Status,
    fitted_class_names,
)
from hvt_common.protocol.messages.stream import (
    MAX_ALSO,
    AlsoShown,
    BaseHeader,
    CaptureTimes,
    Flags,
    RoiHeader,
    StillWire,
)
from hvt_common.protocol.messages.track_step import TrackStep, TrackStepDecoder, TrackStepEncoder
