"""Real time: grounds and edges that come late, leave, die and come back, while the others go on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import pytest

from hvt_common.protocol.messages import BaseHeader, Command, ControlAnswer, ControlRequest
from lab.link.measures.timing import read_timing
from programs.outsider import Tap, answer, joined
from programs.processes import Link, eventually
from programs.rrd import Recording

pytestmark = pytest.mark.integration

LONG = 3000
"""Pictures: minutes, on a slow machine too."""

CHEAP = (
    *("--size", "320x192", "--fps", "10", "--preset", "ultrafast", "--budget", "300kbps"),
    *("--detector", "motion"),
)
ANALYSES = ("--detector", "motion", "--classifier", "none")
"""What a ground does at little cost."""


def arguments(scene: Path, edge_id: str, *more: str) -> list[str]:
    """Settings of an edge that plays the scene in real time at little cost."""
    return ["--source", str(scene), "--source-fps", "10", "--edge-id", edge_id, *CHEAP, *more]


def count_frames(file: Path) -> int:
    with av.open(str(file)) as container:
        return sum(1 for _ in container.decode(container.streams.video[0]))


def whole(recording: Recording, summary: dict[str, Any]) -> None:
    """The recording holds what was decoded and ends with the end of the session."""
    assert len(recording.video()) == summary["frames_decoded"] > 0
    assert recording.events()[-1][2] in ("the flight has ended", "this session has ended")


@dataclass
class Late:
    """What was seen of an edge that played on while grounds came and went."""

    keyframe_answer: ControlAnswer
    keyframes: int
    """That came to the third party after its request."""
    first: dict[str, Any]
    second: dict[str, Any]
    edge: dict[str, Any]
    folder: Path


@pytest.fixture(scope="module")
def late(long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Late:
    """The edge plays from the start; a bare subscriber, a ground and then another ground join it.

    Keyframes are on no schedule, and the rate stays: each that comes after the first was asked for.
    """
    folder = tmp_path_factory.mktemp("late")
    with Link(folder, name="late") as link:
        edge = link.edge(
            *arguments(long_scene, "uav-1", "--wait", "0s", "--keyframe-interval", "0s", "--no-adapt"),
            *("--record-base", "base.mkv"),
            listens=True,
        )
        edge.until("no ground yet")
        with joined(link.edge_endpoint) as third:
            eventually(lambda: answer(third, "hvt/uav-1/info"), what="the edge answers info")
            tap = Tap(third, "hvt/uav-1/base")
            eventually(lambda: any(one.frame_index > 10 for one in seen(tap)), what="it plays")
            newest = seen(tap)[-1].frame_index
            request = ControlRequest(session_id=0, command=Command.KEYFRAME, arguments={})
            reply = ControlAnswer.parse(answer(third, "hvt/uav-1/control", request.pack()) or b"")
            eventually(lambda: keyframes(tap, after=newest), what="a keyframe comes")
        records = ("--record", "first.rrd", "--timing", "first.csv")
        first = link.ground(*ANALYSES, *records, name="first", connects=True)
        eventually(lambda: shown(folder / "first.csv") >= 30, what="the first ground's picture")
        first.stop()
        records = ("--record", "second.rrd", "--timing", "second.csv", "--once")
        second = link.ground(*ANALYSES, *records, name="second")
        eventually(lambda: shown(folder / "second.csv") >= 30, what="the second ground's picture")
        edge.stop()
        seen_of, seen_again, sent = (one.finish() for one in (first, second, edge))
        return Late(reply, len(keyframes(tap, after=newest)), seen_of, seen_again, sent, folder)


def seen(tap: Tap) -> list[BaseHeader]:
    return [BaseHeader.parse(one.attachment, one.payload) for one in tap.messages]


def keyframes(tap: Tap, *, after: int) -> list[BaseHeader]:
    return [header for header in seen(tap) if header.keyframe and header.frame_index > after]


def shown(timing: Path) -> int:
    return sum(one.kind == "base" and bool(one.shown) for one in read_timing(timing))


def test_a_keyframe_comes_of_asking(late):
    """Whoever joins by himself, with docs/wire.md in hand, would wait for the next scheduled keyframe, 10 s."""
    assert late.keyframe_answer.accepted
    assert late.keyframes == 1


def test_the_edge_counts_what_it_answered(late):
    """Bytes would leave the edge that its account does not know."""
    assert late.edge["replies"] >= 4  # info, and the keyframe; info of two grounds
    assert late.edge["reply_bytes"] >= late.edge["replies"] * (36 + 52 + len(late.keyframe_answer.pack()))


def test_a_late_ground_asks_for_its_picture(late):
    """An operator who opens the ground in mid-flight would look at nothing, up to the next scheduled keyframe."""
    recording = Recording(late.folder / "first.rrd")
    assert recording.video()[0][0] > 10, "it did join late"
    assert late.first["keyframe_requests"] >= 1
    assert late.edge["keyframe_requests"] >= 2
    assert late.edge["keyframes"] >= 3, "the flight's own, and one for each who asked"


def test_a_restarted_ground_goes_on(late):
    """After a crash of the ground's machine the drone would have to be started again, in the air."""
    assert late.first["session"] == late.second["session"] == late.edge["session"]
    assert late.second["frames_decoded"] >= 15
    whole(Recording(late.folder / "second.rrd"), late.second)


def test_ctrl_c_ends_a_ground_with_a_whole_recording(late):
    """The flight so far would be lost, or the terminal hang."""
    assert late.first["frames_decoded"] >= 15
    whole(Recording(late.folder / "first.rrd"), late.first)


def test_ctrl_c_ends_an_edge_with_a_summary_and_its_ground_with_it(late):
    """Landing would need a kill -9, and the account of the flight be lost."""
    assert 0 < late.edge["frames"] < LONG
    assert late.edge["worst_window_bps"]["total"] <= 300_000
    assert count_frames(late.folder / "base.mkv") == late.edge["frames"] + late.edge["frames_stored"]


@pytest.mark.nightly
def test_a_lockstep_edge_plays_on_without_a_ground_that_died(link, long_scene):
    """A long run of a study would hang on a ground that crashed; tests/edge/loop/test_lockstep.py says how long."""
    ground = link.ground(*ANALYSES, "--record", "recordings")
    lockstep = ("--wait", "60s", "--pace", "lockstep", "--max-frames", "300")
    edge = link.edge(*arguments(long_scene, "uav-1", *lockstep))
    ground.until("uav-1: ")
    ground.kill()
    assert edge.finish()["frames"] == 300
