"""The once-a-second report."""

from types import SimpleNamespace
from typing import Any

import pytest

from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.ledger import Ledger
from hvt_common.protocol.messages import Status
from hvt_common.runtime.failures import Failures
from hvt_edge.report.state import boxes_age_s
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
