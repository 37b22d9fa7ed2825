"""Two edges of one id, clocks that are set, a camera that comes back.

That a router goes is in fleet/test_group.py; that two edges of one id meet later in tests/ground/session.
"""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

from hvt_common.protocol.messages import BaseHeader, Feedback, Flags, Status
from lab.link.measures.timing import Arrival, read_timing
from programs.outsider import Tap, joined
from programs.processes import Link, Running, eventually
from programs.rtsp_camera import RtspCamera

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


# A camera that comes back


@pytest.mark.nightly
def test_a_camera_that_comes_back_begins_with_a_keyframe(link: Link, free_port: int):
    """The operator would look at smear after each loose contact, or never learn why the picture stands.

    Nor is the flight stored for somebody who listens and reports nothing, as a plain Zenoh program does.
    """
    with RtspCamera(free_port) as camera:
        edge = link.edge(
            *(
                "--source",
                camera.url,
                *PLAYS[2:],
                "--wait",
                "0s",
                "--store",
                "20MB",
                "--store-folder",
                "store",
            ),
            listens=True,
        )
        with joined(link.edge_endpoint) as session:
            base, status = (Tap(session, f"hvt/uav-1/{row}") for row in ("base", "status"))

            def units() -> list[BaseHeader]:
                return [BaseHeader.parse(one.attachment, one.payload) for one in base.messages]

            def source_works() -> bool | None:
                parts = Status.parse(status.messages[-1].payload).failed if status.messages else ()
                return next((one.working for one in parts if one.part == "source"), None)

            eventually(lambda: len(units()) > 5, what="video comes")
            camera.close()
            eventually(lambda: source_works() is False, what="status says so, without a frame")
            count = len(units())
            with RtspCamera(free_port):
                eventually(lambda: len(units()) > count + 5, what="video comes back")
                eventually(source_works, what="status says so")
                edge.stop()
            first, again = units()[0], units()[count]
    assert again.flags & Flags.KEYFRAME
    summary = edge.summary()
    assert summary["failed"][0]["part"] == "source"
    assert summary["frames_stored"] <= first.frame_index + 1, "but what came before anybody watched"
    assert summary["total_bps"] <= 300_000
