"""A ground's state as Prometheus reads it: names in base units, one series an edge."""

from __future__ import annotations

from collections import Counter as Counts
from collections.abc import Iterator
from functools import partial

from prometheus_client.core import Metric

from hvt_common.protocol.edge_words import PART_WORDS, STILL_WORDS
from hvt_common.units import SECOND_NS
from hvt_fleet.health import server
from hvt_fleet.health.prometheus import Counter, Gauge, Table, exposition, of_table, seconds
from hvt_ground.report.state import GroundState, SessionState

_LINKS = ("waiting", "up", "thin", "lost", "ended")
_OTHER = "other"
"""A word of the edge's that is none of these: each new one would be a series for ever."""
_REASONS = frozenset(STILL_WORDS)
_EDGE_PARTS = frozenset(PART_WORDS)

_GAUGES: Table[SessionState] = {
    "hvt_budget_bits_per_second": ("The edge's budget.", lambda one: one.budget_bps),
    "hvt_received_bits_per_second": ("Over the budget's window, all channels.", lambda one: one.total_bps),
    "hvt_received_base_bits_per_second": ("Likewise, the base stream.", lambda one: one.base_bps),
    "hvt_received_still_bits_per_second": ("Likewise, stills.", lambda one: one.roi_bps),
    "hvt_overlay_delay_p50_seconds": ("Capture to overlay.", lambda one: seconds(one.delay_p50_ms)),
    "hvt_overlay_delay_p95_seconds": ("Capture to overlay.", lambda one: seconds(one.delay_p95_ms)),
    "hvt_picture_age_seconds": ("Since the newest picture was captured.", lambda one: one.picture_age_s),
    "hvt_pose_latitude_degrees": ("Of the camera.", lambda one: one.pose.latitude_deg if one.pose else None),
    "hvt_pose_longitude_degrees": (
        "Of the camera.",
        lambda one: one.pose.longitude_deg if one.pose else None,
    ),
    "hvt_pose_age_seconds": ("Of that place.", lambda one: one.pose.age_s if one.pose else None),
    "hvt_tracks": ("Distinct tracks of the session.", lambda one: one.tracks),
    "hvt_tracks_refined": ("Of these, refined by a still.", lambda one: one.tracks_refined),
    "hvt_tracks_doubted": ("Shown, and doubted.", lambda one: one.tracks_doubted),
    "hvt_view_trust_ratio": (
        "Trust of the ground's detector in the view, 0 to 1.",
        lambda one: one.view_trust,
    ),
    "hvt_view_unlike": (
        "1: the view is unlike what the ground's detector knows.",
        lambda one: None if one.view_trust is None else int(one.view_unlike),
    ),
    "hvt_stills_pending": ("To be read.", lambda one: one.stills_pending),
    "hvt_budget_used_ratio": ("Of the edge's budget.", lambda one: one.budget_share),
    "hvt_backlog_objects_working": ("Stored objects in hand.", lambda one: one.backlog_working),
    "hvt_edge_detect_seconds": ("A detection at the edge.", lambda one: seconds(one.edge_detect_ms)),
    "hvt_edge_encode_seconds": ("A picture at the edge.", lambda one: seconds(one.edge_encode_ms)),
    "hvt_edge_stills_pending": ("Stills in the edge's queue.", lambda one: one.edge_still_queue),
}
_COUNTERS: Table[SessionState] = {
    "hvt_frames_received": ("Access units.", lambda one: one.frames_received),
    "hvt_frames_decoded": ("Pictures.", lambda one: one.frames_decoded),
    "hvt_frames_untracked": ("Passed over by perception.", lambda one: one.frames_untracked),
    "hvt_messages_lost": ("By sequence number.", lambda one: one.lost),
    "hvt_messages_corrupt": ("By checksum.", lambda one: one.corrupt),
    "hvt_keyframe_requests": ("To the edge.", lambda one: one.keyframe_requests),
    "hvt_detections": ("Detector runs.", lambda one: one.detections),
    "hvt_stills_received": ("Stills.", lambda one: one.stills_received),
    "hvt_class_changes": ("By stills.", lambda one: one.class_changes),
    "hvt_edge_frames_dropped": ("Before encoding.", lambda one: one.edge_frames_dropped),
    "hvt_edge_frames_dropped_cpu": ("Of these, for want of CPU.", lambda one: one.edge_frames_dropped_cpu),
}


def metrics_text(state: GroundState) -> bytes:
    """The text format. Counters are of the open session, and begin anew with the next."""
    return exposition(_metrics(state))


serve = partial(server.serve, metrics_text)


def _metrics(state: GroundState) -> Iterator[Metric]:
    yield Gauge("hvt_state_timestamp_seconds", "Of this state.", state.at_ns / SECOND_NS)
    link = Gauge("hvt_link", "1 for what the link is.", labels=("edge", "link"))
    since = Gauge("hvt_link_since_timestamp_seconds", "Since when.", labels=("edge",))
    unusable = Counter("hvt_messages_unusable", "Damaged or foreign.", labels=("edge",))
    ended = Counter("hvt_sessions_ended", "Sessions.", labels=("edge",))
    failed = Gauge("hvt_part_failed", "1: does not work now.", labels=("part", "edge"))
    not_sent = Counter("hvt_stills_not_sent", "Candidates without a still.", labels=("edge", "reason"))
    for part in state.failed:
        failed.add_metric((part.part, ""), 1)
    for one in state.edges:
        for name in _LINKS:
            link.add_metric((one.edge, name), name == one.link)
        since.add_metric((one.edge,), one.link_since_ns / SECOND_NS)
        unusable.add_metric((one.edge,), one.unusable_messages)
        ended.add_metric((one.edge,), one.sessions_ended)
        session = one.session
        at_edge = () if session is None else session.edge_failed
        for name in {part.part for part in one.failed} | {_known(part.part, _EDGE_PARTS) for part in at_edge}:
            failed.add_metric((name, one.edge), 1)
        reasons = Counts[str]()
        for reason, count in ({} if session is None else session.stills_not_sent).items():
            reasons[_known(reason, _REASONS)] += count
        for reason, count in reasons.items():
            not_sent.add_metric((one.edge, reason), count)
    yield from (link, since, unusable, ended, failed, not_sent)
    sessions = [(one.edge, one.session) for one in state.edges if one.session is not None]
    yield from of_table(_GAUGES, Gauge, sessions)
    yield from of_table(_COUNTERS, Counter, sessions)


def _known(word: str, known: frozenset[str]) -> str:
    return word if word in known else _OTHER
