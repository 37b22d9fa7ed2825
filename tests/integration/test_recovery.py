"""Two edges of one id, stills that are lost, clocks that are set.

That a router goes is in fleet/test_group.py; that two edges of one id meet later in tests/ground/session.
"""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from hvt_common.protocol.messages import Feedback
from lab.link.carriers.relay import Relay
from lab.link.measures.timing import Arrival, read_timing
from lab.link.timeline import LinkState, Phase, Script
from programs.outsider import Tap, joined
from programs.processes import Link, Running, eventually
from programs.rrd import Recording

pytestmark = pytest.mark.integration

TESTS = Path(__file__).resolve().parents[2] / "tests" / "support"

PLAYS = (
    *("--source", "scene", "--size", "320x180", "--fps", "10", "--preset", "ultrafast"),
    *("--budget", "300kbps"),
    *("--detector", "motion", "--edge-id", "uav-1", "--wait", "60s", "--method", "M5"),
)
SEES = ("--detector", "motion", "--classifier", "none")


@pytest.fixture(autouse=True)
def pictures(long_scene: Path, tmp_path: Path) -> None:
    """What the edges of a test play, from where they run."""
    (tmp_path / "scene").symlink_to(long_scene)


def shown(folder: Path, *, name: str = "timing.csv") -> list[Arrival]:
    """The frames that a ground has decoded so far."""
    return [one for one in read_timing(folder / name) if one.kind == "base" and one.shown]


def more_is_shown(folder: Path, *, than: int, name: str = "timing.csv") -> None:
    """Wait until the picture has gone on for a second."""
    eventually(lambda: len(shown(folder, name=name)) >= than + 10, what="the picture goes on")


def as_list(summaries: Any) -> list[dict[str, Any]]:
    """A summary file holds one session, or a list of them."""
    return summaries if isinstance(summaries, list) else [summaries]


# Two edges of one id


@pytest.mark.nightly
def test_an_edge_whose_id_is_taken_does_not_start(link: Link):
    """Two drones would fight for one screen; a fleet's copy-and-paste mistake would be found out in the air."""
    ground = link.ground(*SEES, "--record", "flights", "--timing", "timing.csv")
    first = link.edge(*PLAYS, name="first")
    more_is_shown(link.folder, than=0)
    second = link.edge(*PLAYS, "--record-base", "second.mkv", name="second")
    assert second.wait() == 2
    lines = [line for line in second.said.splitlines() if "runs on" not in line]
    assert len(lines) == 1
    assert lines[0].startswith("hvt-edge: edge id 'uav-1' is in use: an edge of that id (session ")
    assert not (link.folder / "second.mkv").exists()
    # The first hangs for good: its token is still there, but nobody answers any more.
    os.kill(first.process.pid, signal.SIGSTOP)
    third = link.edge(*PLAYS, name="third")
    more_is_shown(link.folder, than=len(shown(link.folder)))
    third.stop()
    ground.stop()
    assert third.finish()["session"] in {one["session"] for one in as_list(ground.finish())}


# Stills that are lost


@pytest.mark.nightly
def test_a_lost_still_comes_the_second_time_and_is_shown_once(link: Link):
    """On a radio that loses datagrams the sharp pictures would have holes; or the gallery show some twice."""
    state = LinkState(4_000_000, delay_s=0.01, loss=0.12)
    lossy = Script((Phase(0.0, state),), lasts_s=60.0, queue_bytes=100_000)
    records = (*SEES, "--record", "flight.rrd", "--timing", "timing.csv")
    ground = link.start("hvt_ground.cli", ["--listen", f"udp/127.0.0.1:{link.port}", *records], name="ground")
    ground.until("listening on")
    with Relay(lossy, protocol="udp", target_port=link.port, seed=3) as relay:
        settings = (
            "--connect",
            f"udp/127.0.0.1:{relay.port}",
            *PLAYS,
            "--still-codec",
            "jpeg",
            "--cooldown",
            "0s",
        )
        many = ("--method", "M1", "--tune", "every_frames=20", "--min-gain", "1", "--gate", "60")
        edge = link.start("hvt_edge.cli", [*settings, *many, "--video-share", "0.6"], name="edge")
        more_is_shown(link.folder, than=0)
        relay.begin()

        def stills() -> list[int]:
            return [one.sequence for one in read_timing(link.folder / "timing.csv") if one.kind == "roi"]

        def came_late() -> bool:
            return any(number < max(stills()[:place]) for place, number in enumerate(stills()) if place)

        eventually(came_late, what="a still that was lost comes after later ones")
        edge.stop()
        ground.stop()
    sent = edge.finish()["stills"]["reasons"]["sent"]
    (seen,) = as_list(ground.finish())
    arrived = stills()
    assert sent["again"] >= 1
    # Others may have come from the edge's store.
    assert len(arrived) == len(set(arrived)) <= seen["stills"]["received"]
    assert seen["stills"]["received"] <= sum(sent.values()) - sent["again"]
    shown_stills = [value for _, value in Recording(link.folder / "flight.rrd").stills()]
    assert len(shown_stills) == len(set(shown_stills))


# Clocks that are set


@pytest.mark.nightly
def test_clocks_that_are_set_leave_no_trace(link: Link, monkeypatch: pytest.MonkeyPatch):
    """For hours the picture would be an hour old by the ground's account, or reports and keyframes cease.

    The ground's clock is set back by an hour and the edge's forward, in one flight. The other cases need no flight:
    see tests/common/protocol/test_clock_offset.py.
    """
    (link.folder / "stepped.py").write_text((TESTS / "programs" / "stepped.py").read_text())

    def stepped(program: str, step_s: int, *arguments: str, name: str) -> Running:
        monkeypatch.setenv("HVT_STEPPED", f"{program} {step_s}")
        return link.start("stepped", [*arguments], name=name)

    ground = stepped(
        *("hvt_ground.cli", -3600, "--listen", link.ground_endpoint, *SEES),
        *("--record", "flight.rrd", "--timing", "timing.csv"),
        name="ground",
    )
    ground.until("listening on")
    edge = stepped("hvt_edge.cli", 3600, "--connect", link.ground_endpoint, *PLAYS, name="edge")
    with joined(link.ground_endpoint) as third:
        tap = Tap(third, "hvt/uav-1/feedback")
        more_is_shown(link.folder, than=0)
        (link.folder / "step").touch()
        since = len(tap.messages)
        more_is_shown(link.folder, than=len(shown(link.folder)) + 20)
        eventually(lambda: len(tap.messages) >= since + 5, what="reports go on")
    edge.stop()
    ground.stop()
    (seen,) = as_list(ground.finish())
    assert edge.finish()["session"] == seen["session"]
    assert seen["latency_ms"]["max"] < 60_000
    assert seen["receive_latency_ms"]["max"] < 60_000
    reports = [Feedback.parse(message.payload) for message in tap.messages]
    sent_s = [one.send_ns / 1e9 for one in reports]
    assert max(sent_s) - min(sent_s) < 300
    assert all(one.delay_p50_ms < 60_000 and abs(one.clock_offset_ns) < 60e9 for one in reports)
    captured_s = [one.capture_s for one in shown(link.folder)]
    assert max(captured_s) - min(captured_s) < 300
