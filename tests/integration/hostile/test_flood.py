"""A second publisher that says valid things as fast as the link takes them, and a second asker at the edge.

It speaks in the edge's own session, or in the ground's own name: no checksum and no number gives it away. Nothing can
be shown while somebody else counts on in the edge's name; it has to come back, and nothing may grow.
"""

import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import psutil
import pytest

from hvt_common.protocol.messages import BaseHeader, ControlAnswer, ControlRequest, Feedback
from hvt_edge.operating import KeyframeSettings
from programs.outsider import Tap, answer, joined
from programs.processes import Link, Running, eventually

pytestmark = [pytest.mark.integration, pytest.mark.nightly]

_FLOODER = Path(__file__).with_name("flooder.py")
_SECONDS = 2.5
_GROWTH_MB, _GROWTH_SHARE = 60.0, 0.1
"""So much may either process grow over all floods, and by so much of what they said: most of it would be a leak."""
_EDGE = shlex.split(
    "--source-fps 10 --fps 10 --size 640x360 --preset ultrafast --budget 300kbps --edge-id uav-1 --method M1"
    " --detector motion --send-tracks --no-adapt --keyframe-interval 60s"
)


class Growth:
    """How far a process's memory has risen since it was first asked for."""

    def __init__(self, running: Running) -> None:
        self._process = psutil.Process(running.process.pid)
        self._first = self._process.memory_info().rss

    def __call__(self) -> float:
        return (self._process.memory_info().rss - self._first) / 2**20


class Flight:
    """A ground and an edge that fly, with somebody who listens to both."""

    def __init__(
        self, link: Link, scene: Path, listens: Tap, reports: Tap, ground: Running, edge: Running
    ) -> None:
        self.link, self.scene, self.base, self.reports = link, scene, listens, reports
        self.ground, self.edge = ground, edge
        self.growth = {"ground": Growth(ground), "edge": Growth(edge)}
        self.most_mb = dict.fromkeys(self.growth, 0.0)
        self.said: dict[str, dict[str, Any]] = {}

    @property
    def growth_mb(self) -> float:
        return _GROWTH_MB + _GROWTH_SHARE * sum(one.get("bytes", 0) for one in self.said.values()) / 2**20

    def flooded(self, kind: str) -> Self:
        """With this flood over, whoever of the tests is the first to need it."""
        if kind not in self.said:
            self._flood(kind)
        return self

    def _flood(self, kind: str) -> None:
        """Let the second publisher speak; both processes are looked at all the while."""
        to_edge = kind in ("reports", "questions")
        say = self.link.edge_endpoint if to_edge else self.link.ground_endpoint
        hear = self.link.ground_endpoint if kind == "reports" else self.link.edge_endpoint
        command = [sys.executable, str(_FLOODER), kind, hear, say, str(_SECONDS)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flooder:
            try:
                while flooder.poll() is None:
                    self.look()
                    time.sleep(0.1)
                self.said[kind] = json.loads(flooder.stdout.read())
            finally:
                flooder.kill()
        assert flooder.returncode == 0, kind
        time.sleep(0.5)
        self.look()

    def look(self) -> None:
        """Note the memory of both; either must still be there."""
        for name, running in (("ground", self.ground), ("edge", self.edge)):
            assert running.alive, running.said
            self.most_mb[name] = max(self.most_mb[name], self.growth[name]())

    @property
    def newest_frame(self) -> int:
        message = self.base.messages[-1]
        return BaseHeader.parse(message.attachment, message.payload).frame_index

    def shown(self) -> Callable[[], bool]:
        """Whether the ground has drawn a frame that the edge sends from now on, and none that it has not sent."""
        now = self.newest_frame

        def is_shown() -> bool:
            last = Feedback.parse(self.reports.messages[-1].payload).last_frame_index
            return now < last <= self.newest_frame

        return is_shown

    def warned(self, running: Running) -> int:
        return len(re.findall(r"more than \d+ messages a second", running.said))


@pytest.fixture(scope="module")
def flight(long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    folder = tmp_path_factory.mktemp("flood")
    with Link(folder) as link:
        ground = link.ground("--record", "flight.rrd", "--detector", "motion", "--classifier", "none")
        edge = link.edge("--source", str(long_scene), *_EDGE, listens=True)
        with joined(link.edge_endpoint) as to_edge, joined(link.ground_endpoint) as to_ground:
            base, reports = Tap(to_edge, "hvt/uav-1/base"), Tap(to_ground, "hvt/uav-1/feedback")
            eventually(lambda: len(base.messages) > 20 and reports.messages, what="it flies")
            flight = Flight(link, long_scene, base, reports, ground, edge)
            eventually(flight.shown(), what="the picture is shown")
            time.sleep(3)  # what grows at the start has grown
            flight.growth = {"ground": Growth(ground), "edge": Growth(edge)}
            yield flight


_TO_GROUND = ("copies", "statuses", "backlog", "ahead")


@pytest.fixture(scope="module")
def flooded(flight: Flight) -> Flight:
    """All that is said to the ground, each flood after the picture was back from the one before."""
    for kind in _TO_GROUND:
        flight.flooded(kind)
        _is_back(flight, kind)
    return flight


@pytest.fixture(scope="module")
def asked(flight: Flight) -> tuple[Flight, int]:
    """Questions and reports are over; with the newest frame before them."""
    before = flight.newest_frame
    for kind in ("questions", "reports"):
        flight.flooded(kind)
        _is_back(flight, kind)
    return flight, before


def _is_back(flight: Flight, kind: str) -> None:
    eventually(flight.shown(), what=f"the picture is back after {kind}; it said\n{flight.ground.said}")


@pytest.mark.parametrize("kind", _TO_GROUND)
def test_the_picture_comes_back_after_a_flood(flight, kind):
    """One program with an old recording could blind the operator for the rest of the flight, or fill the machine."""
    flight.flooded(kind)
    assert flight.said[kind]["said"] > 200, "it was a flood"
    _is_back(flight, kind)
    assert flight.most_mb["ground"] < flight.growth_mb, flight.said
    assert "Traceback" not in flight.ground.said


def test_the_flood_is_told_of_once(flooded):
    """Nobody would look for the second publisher; or the one line that matters would scroll away."""
    assert sum("message" in line for line in flooded.ground.said.splitlines()) < 30
    most = max(flooded.said[kind]["said"] for kind in _TO_GROUND if kind != "backlog")
    if most / _SECONDS < 10_000:
        pytest.skip("this machine is too busy for a flood that is worth a word")
    assert flooded.warned(flooded.ground) == 1


def test_questions_and_reports_leave_the_frame_loop_alone(asked):
    """Anybody who may ask could stop the drone's video with questions that all make sense."""
    flight, before = asked
    assert flight.said["questions"]["said"] > 100
    assert flight.said["questions"]["answered"] > 0
    assert flight.newest_frame > before, "the edge goes on; that the picture is back was seen"
    assert flight.most_mb["edge"] < flight.growth_mb, flight.said
    assert flight.warned(flight.edge) <= 1
    with joined(flight.link.edge_endpoint) as session:
        request = ControlRequest(session_id=0, command="tracks", arguments={}).pack()
        eventually(
            lambda: (
                (heard := answer(session, "hvt/uav-1/control", request)) is not None
                and ControlAnswer.parse(heard).accepted
            ),
            what="the edge answers again",
        )


def test_the_stream_did_not_become_all_keyframes(asked):
    """Whoever may command could push pictures and stills aside with keyframes, for as long as it asks."""
    flight, _ = asked
    messages = flight.base.messages
    headers = [BaseHeader.parse(one.attachment, one.payload) for one in messages]
    settings, lasted_s = KeyframeSettings(), messages[-1].received_s - messages[0].received_s
    most = 2 + settings.burst + lasted_s * 1e9 / settings.refill_ns
    assert 2 <= sum(header.keyframe for header in headers) <= most
    assert any(not header.keyframe for header in headers)
