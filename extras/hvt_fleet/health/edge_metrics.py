"""An edge's state for Prometheus. A metric that a ground has too has the same name and value."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from prometheus_client.core import Metric

from hvt_common.protocol.edge_words import FRAME_GROUPS
from hvt_common.units import SECOND_NS
from hvt_edge.report.state import BacklogState, EdgeState
from hvt_fleet.health import server
from hvt_fleet.health.prometheus import Counter, Gauge, Table, exposition, of_table, seconds

_ZONES = "sys/class/thermal/thermal_zone*/temp"
_WIRELESS = "proc/net/wireless"
_HEAD_LINES = 2


@dataclass(frozen=True, slots=True)
class SystemReading:
    """The machine's temperature and the quality of its wireless link; None where the system gives none."""

    temperature_c: float | None = None
    wireless_quality: float | None = None
    """The driver's count, of 70 with most drivers."""
    wireless_dbm: float | None = None


def read_system(root: Path = Path("/")) -> SystemReading:
    """Read the present values; ``root`` is the folder of ``sys`` and ``proc``."""
    quality, level = _wireless(root / _WIRELESS)
    return SystemReading(_hottest_c(root), quality, level)


def _hottest_c(root: Path) -> float | None:
    hottest: float | None = None
    for zone in root.glob(_ZONES):
        with contextlib.suppress(OSError, ValueError):  # a sensor that is switched off answers with an error
            here = int(zone.read_text(encoding="ascii")) / 1000
            hottest = here if hottest is None else max(hottest, here)
    return hottest


def _wireless(path: Path) -> tuple[float | None, float | None]:
    # Quality and level of the first interface (proc(5)): ``wlan0: 0000 54. -56. -256 …``.
    with contextlib.suppress(OSError, ValueError, IndexError):
        _, _, rest = path.read_text(encoding="ascii").splitlines()[_HEAD_LINES].partition(":")
        _, quality, level = (float(one) for one in rest.split()[:3])
        return quality, level if level < 0 else None  # above, an old driver counts in units of its own
    return None, None


_GAUGES: Table[EdgeState] = {
    "hvt_budget_bits_per_second": ("The edge's budget.", lambda one: one.operating.budget_bps),
    "hvt_edge_allowed_bits_per_second": ("What may be sent now.", lambda one: one.operating.allowed_bps),
    "hvt_edge_budget_used_ratio": ("Of what may be sent.", lambda one: one.budget_share),
    "hvt_edge_ground_listens": ("1 while a ground does.", lambda one: one.link.ground),
    "hvt_edge_link_rate_bits_per_second": ("As measured.", lambda one: one.link.rate_bps),
    "hvt_edge_round_trip_seconds": ("Of the link.", lambda one: seconds(one.link.round_trip_ms)),
    "hvt_edge_source_silent_seconds": ("Since its last frame.", lambda one: one.source_silent_s),
    "hvt_edge_encode_seconds": ("A picture at the edge.", lambda one: seconds(one.encode_ms)),
    "hvt_edge_detect_seconds": ("A detection at the edge.", lambda one: seconds(one.perception_ms)),
    "hvt_edge_boxes_age_seconds": ("Behind the newest picture.", lambda one: one.boxes_age_s),
    "hvt_edge_stills_pending": ("Stills in the edge's queue.", lambda one: one.stills_pending),
    "hvt_edge_stills_in_flight": ("Sent, not reported.", lambda one: one.stills_in_flight),
    "hvt_edge_tracks": ("Distinct tracks of the session.", lambda one: one.tracks),
    "hvt_edge_cores_needed": ("Cores for every frame.", lambda one: one.cores_needed),
    "hvt_edge_cores_free": ("Cores that others leave.", lambda one: one.cores_free),
}
_MACHINE: Table[SystemReading] = {
    "hvt_edge_temperature_celsius": ("Of the hottest zone.", lambda one: one.temperature_c),
    "hvt_edge_wireless_quality": ("As the driver counts.", lambda one: one.wireless_quality),
    "hvt_edge_wireless_dbm": ("Level of the signal.", lambda one: one.wireless_dbm),
}
_COUNTERS: Table[EdgeState] = {
    "hvt_edge_frames_captured": ("Of the source.", lambda one: one.frames.account.came),
    "hvt_edge_frames_encoded": ("Pictures.", lambda one: one.frames.encoded),
    "hvt_edge_frames_dropped": ("Before encoding.", lambda one: one.frames.account.dropped),
    "hvt_edge_frames_dropped_cpu": (
        "Of these, for want of CPU.",
        lambda one: one.frames.account.groups.get("processor", 0),
    ),
    "hvt_edge_frames_unanalyzed": ("Skipped by perception.", lambda one: one.frames.unanalyzed),
    "hvt_edge_keyframes": ("Keyframes.", lambda one: one.keyframes),
    "hvt_edge_keyframe_requests": ("Of grounds, served.", lambda one: one.keyframe_requests),
    "hvt_edge_stills_sent": ("Stills.", lambda one: one.stills_sent),
    "hvt_edge_messages_unusable": ("Damaged or foreign.", lambda one: one.link.unusable_messages),
}
_STORE_GAUGES: Table[BacklogState] = {
    "hvt_edge_offline": ("1 while frames are stored.", lambda one: one.offline),
    "hvt_edge_store_bytes": ("Stored.", lambda one: one.disk_bytes),
    "hvt_edge_store_limit_bytes": ("--store.", lambda one: one.limit_bytes),
    "hvt_edge_store_disk_free_bytes": ("Of its disk.", lambda one: one.disk_free_bytes),
    "hvt_edge_store_stills": ("Stored stills.", lambda one: one.stills),
    "hvt_edge_store_video_seconds": ("Stored video.", lambda one: one.video_s),
}
_STORE_COUNTERS: Table[BacklogState] = {
    "hvt_edge_store_sent_stills": ("Stored stills that arrived.", lambda one: one.sent_stills),
    "hvt_edge_store_evicted_stills": ("Given up for want of space.", lambda one: one.evicted_stills),
}


def metrics_text(state: EdgeState) -> bytes:
    """The text format. Counters are of this run."""
    return exposition(_metrics(state))


serve = partial(server.serve, metrics_text, beside=lambda: {"system": asdict(read_system())})


def _metrics(state: EdgeState) -> Iterator[Metric]:
    edge = state.edge
    yield Gauge("hvt_state_timestamp_seconds", "Of this state.", state.at_ns / SECOND_NS)
    sent = Gauge("hvt_edge_sent_bits_per_second", "Over the budget's window.", labels=("edge", "channel"))
    channels = {
        "base": state.base_bps,
        "roi": state.roi_bps,
        "backlog": state.backlog_bps,
        "meta": state.meta_bps,
    }
    for channel, bps in channels.items():
        if bps is not None:
            sent.add_metric((edge, channel), bps)
    failed = Gauge("hvt_part_failed", "1: does not work now.", labels=("part", "edge"))
    for part in state.failed:
        failed.add_metric((part.part, edge), 1)
    not_sent = Counter("hvt_stills_not_sent", "Candidates without a still.", labels=("edge", "reason"))
    for reason, count in state.stills_not_sent.items():
        not_sent.add_metric((edge, reason), count)
    groups = Counter("hvt_edge_frames", "Source frames: what became of them.", labels=("edge", "group"))
    for group in FRAME_GROUPS:
        groups.add_metric((edge, group), state.frames.account.groups.get(group, 0))
    yield from (sent, failed, not_sent, groups)
    yield from of_table(_GAUGES, Gauge, [(edge, state)])
    yield from of_table(_MACHINE, Gauge, [(edge, read_system())])
    yield from of_table(_COUNTERS, Counter, [(edge, state)])
    stores = [] if state.backlog is None else [(edge, state.backlog)]
    yield from of_table(_STORE_GAUGES, Gauge, stores)
    yield from of_table(_STORE_COUNTERS, Counter, stores)
