"""What an edge says of a run at its end."""

from __future__ import annotations

from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failure
from hvt_edge.loop.cpu import Cores
from hvt_edge.summary import summary, table


def test_the_table_tells_apart_why_frames_are_missing_and_names_what_failed():
    """Who flies would not know whether to buy a processor, a modem or a card."""
    failure = Failure(
        "local copy", "card.mkv is full", 3, 1_790_000_000 * 10**9, 1_790_000_000 * 10**9, working=True
    )
    content = summary(
        Ledger(),
        edge="uav-1",
        session="0",
        method="M6",
        levers="no tracks: 0 objects the base does not show; stills changed 2 of 3",
        frames=9,
        frames_captured=80,
        frames_dropped=70,
        frames_dropped_cpu=66,
        frames_unanalyzed=8,
        clip_paused_s=14.2,
        cores=Cores(needed=1.63, free=1.1),
        duration_s=5.3,
        budget_bps=800_000,
        budget_base_bps=650_000,
        keyframes=1,
        keyframe_requests=0,
        tracks=0,
        encode_ms=20.0,
        perception_ms=50.0,
        unusable_messages=0,
        store=None,
        failed=(failure,),
    )
    said = [text for _, text in table(content)]
    assert said[0] == "auto, M6: no tracks: 0 objects the base does not show; stills changed 2 of 3"
    assert "66 of 80 frames dropped: encoder and detector need 1.6 cores, 1.1 were free" in said
    assert "4 of 80 frames dropped: the link had no room" in said
    assert "the clip took 14 s longer than it is: this machine is too slow for it" in said
    assert "8 of 80 frames not analyzed" in said
    assert said[-1] == "local copy at 2026-09-21T14:13:20+00:00, 3 times: card.mkv is full; works again"
