"""Six edges and three grounds behind a router, each in a network of its own: router, ground and link go in turn."""

import json
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from lab.link.carriers.sides import UnavailableError
from lab.link.carriers.star import Star
from programs.processes import Running, eventually
from programs.rrd import Recording

pytestmark = [pytest.mark.integration, pytest.mark.realtime]

ROUTER = Path(__file__).resolve().parents[3] / "deploy" / "router.py"
EDGES = [f"uav-{number}" for number in range(1, 7)]
GROUNDS = ["base-1", "base-2", "base-3"]
MOVED_S = 30
"""Far beyond the five seconds in which an edge moves: this machine may be busy."""
_STATE = "import sys, urllib.request as r; sys.stdout.buffer.write(r.urlopen('http://127.0.0.1:9464/state.json').read())"


@pytest.fixture(autouse=True)
def pictures(long_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "pictures").symlink_to(long_scene)


@pytest.fixture
def star() -> Iterator[Star]:
    try:
        with Star(["edges", *GROUNDS]) as made:
            yield made
    except UnavailableError as error:
        pytest.skip(str(error))


class Fleet:
    """Router, grounds and edges as processes."""

    def __init__(self, star: Star, folder: Path) -> None:
        self.star, self.folder = star, folder
        self.endpoint = f"tcp/{star.address['router']}:7447"
        self.router = self._routed()
        connect = ("--connect", self.endpoint, "--detector", "motion")
        self.grounds = {
            name: self._run("hvt_ground.cli", name, name, *connect, *self._ground(name)) for name in GROUNDS
        }
        self.edges = {
            name: self._run("hvt_edge.cli", "edges", name, *connect, "--edge-id", name, *self._edge())
            for name in EDGES
        }

    def _ground(self, name: str) -> list[str]:
        options = ["--group", "north", "--record", f"{name}/", "--classifier", "none"]
        probes = ["--metrics", "127.0.0.1:9464", "--web", f"{self.star.address[name]}:8080"]
        return [*options, *probes, "--patience", "4s"]

    def _edge(self) -> list[str]:
        video = ["--size", "320x180", "--fps", "5", "--budget", "150kbps", "--preset", "ultrafast"]
        return [*("--source", "pictures", "--method", "M0", "--store", "0", "--wait", "60s"), *video]

    def _run(self, module: str, host: str, name: str, *words: str) -> Running:
        return Running(module, list(words), folder=self.folder, name=name, within=self.star.within(host))

    def _routed(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, str(ROUTER), "--listen", self.endpoint, "--insecure"]
        return subprocess.Popen([*self.star.within("router"), *command], stdout=subprocess.DEVNULL)

    def restart_router(self) -> None:
        """As kill -9 and a supervisor do."""
        self.router.kill()
        self.router.wait(60)
        self.router = self._routed()

    def state(self, ground: str) -> dict[str, Any]:
        """What the ground says of itself; empty where it says nothing; fails where it is no more."""
        assert self.grounds[ground].alive, self.grounds[ground].said
        command = [*self.star.within(ground), sys.executable, "-I", "-S", "-c", _STATE]
        answer = subprocess.run(command, check=False, capture_output=True, text=True)
        with suppress(ValueError):
            return json.loads(answer.stdout)
        return {}

    def served(self, *grounds: str) -> dict[str, str]:
        """By edge, the ground that shows its picture now; fails where two do."""
        found = [
            (one["edge"], ground)
            for ground in grounds
            for one in self.state(ground).get("edges", ())
            if one["session"] is not None and one["link"] in ("up", "thin")
        ]
        twice = [edge for edge, count in Counter(edge for edge, _ in found).items() if count > 1]
        assert not twice, f"{twice} are served twice: {found}"
        return dict(found)

    def all_served(self, *grounds: str) -> float:
        """Wait until each edge is served by one of these; return how long that took."""
        began_s = time.monotonic()
        eventually(lambda: self.served(*grounds).keys() == set(EDGES), what=f"all at {grounds}")
        return time.monotonic() - began_s

    def close(self) -> None:
        for one in (*self.edges.values(), *self.grounds.values()):
            if one.alive:
                one.kill()
        self.router.kill()
        self.router.wait(60)


def test_a_fleet_outlives_its_router_a_ground_and_a_link(star, tmp_path, monkeypatch):
    """One part that goes would take others with it, or leave edges that nobody sees."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    fleet = Fleet(star, tmp_path)
    try:
        fleet.all_served(*GROUNDS)
        took_s = {}
        first = fleet.served(*GROUNDS)
        others = {edge: ground for edge, ground in first.items() if ground != GROUNDS[0]}
        mine = first.keys() - others.keys()
        assert fleet.state(GROUNDS[0])["elsewhere"].keys() | mine == set(EDGES)
        pages = {edge: f"http://{star.address[ground]}:8080/" for edge, ground in others.items()}

        def known() -> dict[str, str]:
            return {edge: one["page"] for edge, one in fleet.state(GROUNDS[0])["elsewhere"].items()}

        eventually(lambda: pages == known(), what="the pages of the others are known")
        fleet.restart_router()
        time.sleep(3)
        took_s["router"] = fleet.all_served(*GROUNDS)
        victim = min(fleet.served(*GROUNDS).values())
        rest = [one for one in GROUNDS if one != victim]
        fleet.grounds[victim].kill()
        took_s["ground"] = fleet.all_served(*rest)
        cut = min(fleet.served(*rest).values())
        last = [one for one in rest if one != cut]
        star.set_link(cut, down=True)
        took_s["link"] = fleet.all_served(*last)
        star.set_link(cut, down=False)
        eventually(
            lambda: all(fleet.state(name) for name in rest) and fleet.state(last[0])["elsewhere"],
            what="the other takes part again",
        )
        took_s["link back"] = fleet.all_served(*rest)
        assert max(took_s.values()) < MOVED_S
        print({name: round(took, 1) for name, took in took_s.items()})  # with pytest -s
        assert [one for one in EDGES if not fleet.edges[one].alive] == []
        for name in rest:
            assert fleet.grounds[name].alive, fleet.grounds[name].said
            assert "Traceback" not in fleet.grounds[name].said
        for one in (*fleet.edges.values(), *(fleet.grounds[name] for name in rest)):
            one.stop()
        for one in fleet.edges.values():
            assert one.process.returncode == 0, one.said
        recorded = Counter(
            (path.name.split("-2", 1)[0], frame)
            for name in rest
            for path in (tmp_path / name).glob("hvt-*.rrd")
            for frame in {number for number, *_ in Recording(path).video()}
        )
        twice = sum(count > 1 for count in recorded.values())
        assert len(recorded) > 100
        assert twice <= 0.02 * len(recorded), "but for the moment in which a link comes back"
    finally:
        fleet.close()
