"""The once-a-second report."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import Status
from hvt_common.runtime.failures import Failures
from hvt_edge.report.state import SystemReading, boxes_age_s, read_system
from hvt_edge.report.status import StatusReporter

DAY_S = 86_400
S = 1_000_000_000


@pytest.mark.parametrize(
    ("newest_ns", "resumed_ns", "silent", "found"),
    [
        (11 * S, 0, False, (1.0, False)),
        (13 * S, 0, False, (3.0, True)),
        (13 * S, 0, True, (None, False)),
        (50 * S, 49 * S, False, (40.0, False)),
        (52 * S, 49 * S, False, (42.0, True)),
        (None, 0, False, (None, False)),
    ],
)
def test_a_camera_that_was_away_makes_no_boxes_new_and_no_detector_slow(newest_ns, resumed_ns, silent, found):
    """Half a minute without a picture read "boxes 0.0 s old", and the first one after it "detection is too slow"."""
    times = {"newest_ns": newest_ns, "resumed_ns": resumed_ns, "silent": silent, "usual_s": 2.0}
    assert boxes_age_s(10 * S, **times) == found


def test_what_a_report_cannot_say_ends_no_flight():
    """A camera that no ground has heard for 50 days would end, or one with a part whose name is not ASCII."""
    sent: list[bytes] = []
    state: Any = SimpleNamespace(
        state="running",
        duration_s=60.0 * DAY_S,
        lockstep=False,
        decisions=SimpleNamespace(tracks=True, stills=True, says=""),
        link=SimpleNamespace(reported_s=50.0 * DAY_S),
        frames=SimpleNamespace(
            account=FrameAccount.of_counts((), coded_fps=0.0, auto_fps=False), encoded=1, unanalyzed=0
        ),
        keyframes=1,
        tracks=0,
        stills_pending=0,
        encode_ms=70_000.0,
        perception_ms=70_000.0,
        cores_needed=5000.0,
        cores_free=1.0,
    )
    heartbeat: Any = SimpleNamespace(
        beat=lambda _phase: state,
        operating=SimpleNamespace(now=SimpleNamespace(started_ns=0)),
        transmitter=SimpleNamespace(
            base_sequence=0,
            still_sequence=-1,
            metadata=lambda _channel, make, **_: sent.append(make(10**18)) is None,
        ),
        session_id=7,
        ledger=Ledger(window_ns=10**9),
        failures=Failures(lambda: 0),
        loop_clock=lambda: 0,
    )
    heartbeat.failures.failed("камера на крыле", "gone")
    StatusReporter(heartbeat).send("running")
    assert Status.parse(sent[0]).failed[0].part == "камера на кры"
    health = Status.parse(sent[0]).health
    assert (health.encode_ms, health.detect_ms, health.feedback_age_ms) == (60_000, 60_000, 2**32 - 1)


WIRELESS = """\
Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE
 face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22
 wlan0: 0000   54.  -56.  -256        0      0      0      0     25        0
"""


def written(root: Path, *, zones: tuple[str, ...], wireless: str) -> Path:
    for number, text in enumerate(zones):
        zone = root / f"sys/class/thermal/thermal_zone{number}"
        zone.mkdir(parents=True)
        (zone / "temp").write_text(text)
    (root / "proc/net").mkdir(parents=True)
    (root / "proc/net/wireless").write_text(wireless)
    return root


def test_the_hottest_zone_and_the_wireless_link_are_read(tmp_path):
    """A board would throttle, or fly out of range, and nobody be told."""
    root = written(tmp_path, zones=("48250\n", "71000\n", "asleep\n"), wireless=WIRELESS)
    (root / "sys/class/thermal/thermal_zone2/temp").chmod(0)
    assert read_system(root) == SystemReading(temperature_c=71.0, wireless_quality=54.0, wireless_dbm=-56.0)


def test_what_the_system_does_not_tell_is_unknown(tmp_path):
    """A machine without sensors would be at 0 degrees, and its link at 0 dBm, which is superb."""
    assert read_system(tmp_path) == SystemReading()
    head = "".join(WIRELESS.splitlines(keepends=True)[:2])
    assert read_system(written(tmp_path, zones=(), wireless=head)) == SystemReading()
