"""One example of every message of the wire: a new field is filled in here, and nowhere else."""

from dataclasses import dataclass, replace
from typing import Any

from hvt_common.protocol.messages import (
    AcknowledgedRange,
    AlsoShown,
    BacklogHeader,
    BaseHeader,
    ControlAnswer,
    ControlRequest,
    FailedPart,
    Feedback,
    Flags,
    Health,
    Info,
    InfoRequest,
    Message,
    PoseReport,
    RoiHeader,
    Status,
    StillResult,
    TrackNow,
    TrackStep,
)
from hvt_common.protocol.messages.fields import I63, U32, U64
from hvt_edge.link.feedback import Report
from hvt_edge.link.stills import Still


@dataclass(frozen=True)
class UnitHeader:
    """The fields of a base header that the ground's reassembler looks at."""

    session_id: int
    sequence: int
    frame_index: int
    keyframe: bool
    flags: int = 0


BASE = BaseHeader(
    session_id=0x1234567890ABCDEF,
    sequence=9_000,
    frame_index=9_100,
    capture_ns=1_790_000_000_123_456_789,
    send_delay_ns=31_000_000,
    flags=Flags.KEYFRAME | Flags.PARAMETER_SETS,
)
ROI = RoiHeader(
    session_id=0x1234567890ABCDEF,
    sequence=311,
    frame_index=9_100,
    capture_ns=1_790_000_000_123_456_789,
    send_delay_ns=-5,
    flags=0,
    track_id=57,
    box_source_px=(-3.125, 10.0, 90.875, 64.5),
    crop_source_px=(0, 2, 105, 73),
    class_name="van",
    confidence=0.613,
    reason="small",
    codec="jpeg",
    quality_pct=65,
    parameters={"base": 9_099, "gain": 1.5, "how": "residual"},
    also=(AlsoShown(track_id=60, box_source_px=(40.0, 2.5, 104.875, 70.0)),),
)
PLAIN = replace(
    ROI,
    session_id=0,
    sequence=0,
    send_delay_ns=0,
    box_source_px=(0.0, 0.0, 10.0, 10.0),
    crop_source_px=(0, 0, 10, 10),
    parameters={},
    also=(),
)
"""A still's header before it goes out."""


def still_of(data: bytes = b"", *, media_type: str = "image/jpeg", **header: Any) -> Still:
    return Still(replace(PLAIN, **header), media_type, data=data)


STEP = TrackStep(
    session_id=0x1234567890ABCDEF,
    sequence=1_800,
    frame_index=9_100,
    capture_ns=1_790_000_000_123_456_789,
    send_delay_ns=44_000_000,
    reference=1_799,
    boxes=bytes(range(120)),
)
POSE = PoseReport(session=0x90ABCDEF, send_ns=1_790_000_000_123_456_789, coded=bytes.fromhex("2ff8a4d1c0"))
HEALTH = Health(
    frames_captured=9_101,
    frames_encoded=9_001,
    frames_dropped=100,
    keyframes=61,
    tracks=204,
    base_queue=1,
    still_queue=3,
    encode_ms=36.4,
    detect_ms=57.1,
    feedback_age_ms=412,
    frames_dropped_cpu=66,
    frames_unanalyzed=14,
    cores_needed=1.6,
    cores_free=1.1,
)
STATUS = Status(
    session_id=0x1234567890ABCDEF,
    sequence=600,
    state="running",
    send_ns=1_790_000_600_000_000_000,
    media_ns=606_000_000_000,
    last_base_sequence=9_000,
    last_still_sequence=311,
    base_bytes=49_000_000,
    roi_bytes=9_000_000,
    backlog_bytes=0,
    meta_bytes=500_000,
    overhead_bytes=2_300_000,
    base_messages=9_001,
    roi_messages=312,
    backlog_messages=0,
    meta_messages=602,
    worst_window_bps=(712_000, 148_000, 800_000),
    sent={"small": 200, "uncertain": 112},
    deferred={"budget": 1_900},
    dropped={"stale": 44, "border": 3, "queue full": 2},
    health=HEALTH,
    failed=(
        FailedPart(
            part="local copy",
            reason="flight.mkv cannot be written (No space left on device)",
            failures=3,
            failed_ns=1_790_000_500_000_000_000,
            working=False,
        ),
    ),
    decisions="tracks: the video hides 31 objects",
)
INFO = Info(
    session_id=7,
    edge="uav-1",
    software="0.1.0",
    started_ns=1,
    source_size=(3840, 2160),
    base_size=(1280, 720),
    view_scale=1 / 3,
    view_offset_px=(0.0, 0.0),
    fps=15.0,
    codec="h265",
    pace="realtime",
    method="M5",
    budget_bps=800_000,
    base_bps=650_000,
    window_ns=1_000_000_000,
    class_names=("pedestrian", "people", "bicycle", "Straßenbahn"),
    received_ns=2,
    answered_ns=3,
    still_codecs=("residual", "h264-intra"),
    channels=("base", "roi", "tracks", "status"),
)
_COUNTED: Any = dict.fromkeys(
    ("base_messages", "base_bytes", "roi_messages", "roi_bytes", "lost", "corrupt", "base_held_us"), 0
)
_NONE_YET: Any = dict.fromkeys(("last_frame_index", "base_sequence", "still_sequence", "clock_error_ns"), -1)
_NOTHING: Any = dict.fromkeys(("missing_stills", "stills", "backlog"), ())
_BEGUN: Any = {"session_id": 7, "receiver_id": 1, "sequence": 0, "send_ns": 1}
_SILENT = Feedback(**_BEGUN, **_COUNTED, **_NONE_YET, **_NOTHING, delay_p50_ms=-1.0, clock_offset_ns=0)
RESULT = StillResult(
    still_sequence=4,
    track_id=57,
    class_name="minivan",
    confidence=0.9,
    entropy_nats=0.25,
    ground_track_id=12,
    again=False,
)
FEEDBACK = replace(
    _SILENT,
    receiver_id=U64,
    sequence=1,
    send_ns=5,
    base_sequence=U32,
    base_held_us=66_000,
    missing_stills=(3, 7),
    missing_base=(9_001,),
    clock_offset_ns=-I63,
    stills=(RESULT,),
    backlog=(AcknowledgedRange(session_id=U64, kind="base", number=450, acknowledged_bytes=12_000),),
    objects_detected=214,
)
BACKLOG = BacklogHeader(session_id=7, kind="still", number=31, offset=1400, total_bytes=5_000, send_ns=I63)
INFO_REQUEST = InfoRequest(requester_id=U64, still_codecs=("jpeg", "residual"))
REQUEST = ControlRequest(session_id=0, command="keyframe", arguments={})
ANSWER = ControlAnswer(
    session_id=7,
    accepted=True,
    reason="",
    still_request=3,
    frame_index=9_100,
    tracks=(TrackNow(track_id=57, class_id=3, confidence=0.613, box_source_px=(-3.125, 10.0, 90.875, 64.5)),),
)
EXAMPLES: tuple[Message, ...] = (
    BASE,
    ROI,
    STEP,
    POSE,
    INFO,
    STATUS,
    INFO_REQUEST,
    REQUEST,
    ANSWER,
    FEEDBACK,
    BACKLOG,
)


def feedback(**changes: Any) -> Feedback:
    """A receiver report that says nothing, but for ``changes``."""
    return replace(_SILENT, **changes)


def counted(report: Feedback, *, now_ns: int, first: bool = False) -> Report:
    """The same as the edge hands it on, where it counts."""
    return Report(report, now_ns, primary=True, first=first)
