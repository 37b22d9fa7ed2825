"""What an edge says of a run at its end."""

from types import SimpleNamespace
from typing import Any

import pytest

from hvt_common.protocol.edge_words import FrameAccount
from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failure
from hvt_edge.backlog.worker import StoreNumbers
from hvt_edge.loop.counts import Cores
from hvt_edge.report.status import in_vain, summary, table, title
from programs.summary_page import unexplained

NINE_SENT = FrameAccount({"sent": 9})


def summary_of(
    *,
    frames: FrameAccount = NINE_SENT,
    unanalyzed: int = 0,
    clip_paused_s: float = 0.0,
    store: StoreNumbers | None = None,
    failed: tuple[Failure, ...] = (),
    unreached: str = "",
) -> dict[str, Any]:
    says = "no tracks: the video hides 0 objects; stills: they name 2 of 3 otherwise"
    now = SimpleNamespace(
        method="M6",
        decisions=SimpleNamespace(says=says),
        preset="superfast",
        preset_says="preset superfast: veryfast would take 0.5 of a core",
        highest_budget_bps=800_000,
        base_bps=650_000,
    )
    counts = SimpleNamespace(
        duration_s=lambda _fps: 5.3,
        unanalyzed=unanalyzed,
        slow_ns=clip_paused_s * 10**9,
        cpu=SimpleNamespace(short=Cores(needed=1.63, free=1.1)),
        encode_ms=20.0,
    )
    heartbeat: Any = SimpleNamespace(
        config=SimpleNamespace(edge_id="uav-1", nominal_fps=15),
        session_id=0,
        operating=SimpleNamespace(now=now),
        counts=counts,
        frames=frames,
        ledger=Ledger(),
        stills=SimpleNamespace(
            keyframes=SimpleNamespace(sent=1, served=0), analyzer=SimpleNamespace(tracks=0, mean_ms=50.0)
        ),
        link=SimpleNamespace(unusable=0),
        backlog=None if store is None else SimpleNamespace(worker=SimpleNamespace(numbers=store)),
        failures=SimpleNamespace(parts=failed),
    )
    return summary(heartbeat, unreached=unreached)


def test_the_table_tells_apart_why_frames_are_missing_and_names_what_failed():
    """Who flies would not know whether to buy a processor, a modem or a card."""
    failure = Failure(
        "local copy", "card.mkv is full", 3, 1_790_000_000 * 10**9, 1_790_000_000 * 10**9, working=True
    )
    content = summary_of(
        frames=FrameAccount({"sent": 9, "frame_rate": 1, "link": 1, "budget": 3, "processor": 66}, 7.5, True),
        unanalyzed=8,
        clip_paused_s=14.2,
        failed=(failure,),
    )
    said = [text for _, text in table(content)]
    assert said[0] == "auto, M6: no tracks: the video hides 0 objects; stills: they name 2 of 3 otherwise"
    assert said[1] == (
        "80 frames came: 9 sent, 1 left out by auto's 7.5 a second, 3 had no room in the budget, "
        "1 the link did not carry, 66 the processor had no time for; 5.3 s"
    )
    assert "preset superfast: veryfast would take 0.5 of a core" in said
    assert "encoder and detector need 1.6 cores, 1.1 were free" in said
    assert "the clip took 14 s longer than it is: this machine is too slow for it" in said
    assert "8 of 80 frames not analyzed" in said
    assert said[-1] == "local copy at 2026-09-21T14:13:20+00:00, 3 times: card.mkv is full; works again"


def test_a_flight_that_nobody_received_claims_no_bytes():
    """Who flies would read 800 kbps under NOT SENT and look for the fault at the ground."""
    content = summary_of(
        frames=FrameAccount({"nobody_listened": 150}), unreached="nobody subscribed to its video"
    )
    assert in_vain(content)
    assert title(content) == "uav-1: NOT SENT (nobody subscribed to its video): 0 bytes received"
    rows = dict(table(content))
    assert rows["frames"] == "150 frames came: 150 coded while nobody listened; 5.3 s"
    assert rows["total"].startswith("0 bytes received")
    assert not {"base", "stills", "stills sent"} & rows.keys()


@pytest.mark.parametrize(
    ("groups", "says"),
    [
        ({"stored": 150}, "stored for later (nobody subscribed to its video)"),
        ({}, "NOT SENT (nobody subscribed to its video): it ended before its first picture"),
    ],
)
def test_what_is_stored_for_later_is_no_flight_in_vain(groups, says):
    """A recorder that works as meant would be called failed by systemd."""
    content = summary_of(frames=FrameAccount(groups), unreached="nobody subscribed to its video")
    assert not in_vain(content)
    assert title(content) == f"uav-1: {says}"


def test_every_key_stands_on_the_page_of_the_summary():
    """Who reads the JSON would look `given_up` up in the source."""
    failure = Failure("source", "gone", 1, 10**18, 10**18)
    content = summary_of(store=StoreNumbers(), failed=(failure,))
    assert unexplained(content) == set()
