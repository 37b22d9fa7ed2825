"""One flight over TLS: stills on demand through its ground, what those without the right are told, the account."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest

from hvt_ground.cli import main
from programs.fleet_keys import Fleet
from programs.processes import Link, Running, agree, eventually, free_ports

pytestmark = pytest.mark.integration


@dataclass(frozen=True)
class Flight:
    """An edge and a ground with keys, and the fleet that they belong to."""

    fleet: Fleet
    endpoint: str
    edge: Running
    ground: Running

    def asked(self, command: str, *words: str, file: Path) -> int:
        """``hvt-ground COMMAND`` with this configuration; the exit code."""
        return main([command, "--connect", self.endpoint, "--zenoh-config", str(file), *words])


@pytest.fixture(scope="module")
def flight(fleet: Fleet, long_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flight]:
    """Edge ``uav-1`` flies to ground ``base``; ``ops`` may command, ``guest`` watches, nobody knows ``stranger``."""
    folder = tmp_path_factory.mktemp("flight")
    endpoint = f"tls/127.0.0.1:{free_ports(1)[0]}"
    with Link(folder, name="keys") as link:

        def start(module: str, name: str, *arguments: str) -> Running:
            common = ["--zenoh-config", str(fleet.file(name)), "--detector", "motion", *arguments]
            return link.start(module, common, name=name)

        ground = start("hvt_ground.cli", "base", "--listen", endpoint, "--classifier", "none", "--once")
        ground.until("listening on")
        edge = start(
            *("hvt_edge.cli", "uav-1", "--connect", endpoint, "--edge-id", "uav-1", "--wait", "60s"),
            *("--source", str(long_scene), "--source-fps", "5", "--fps", "5", "--size", "640x360"),
            "--send-tracks",
            *("--preset", "ultrafast", "--budget", "500kbps", "--video-share", "0.6", "--cooldown", "0s"),
            *("--method", "M5"),
        )
        eventually(lambda: "stills" in ground.said, what="the ground sees pictures")
        yield Flight(fleet, endpoint, edge, ground)
        edge.stop()
        # A rule too strict for one channel would lose that channel only, and nobody would know.
        sent, received = edge.finish(), ground.finish()
        agree(sent, received)
        assert received["stills"]["received"] > 0
        for count in ("meta_bytes", "overhead_bytes"):  # on a busy machine Zenoh drops track steps
            assert sent[count] / 2 <= received[count] <= sent[count], count
        assert sent["unusable_messages"] == received["unusable_messages"] == 0
        assert "is linked, but" not in edge.said + ground.said
        assert "does not answer on control" not in edge.said + ground.said


@pytest.mark.parametrize("who", ["ops", "base"])
def test_who_may_command_gets_the_still(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str], who: str
) -> None:
    """The operator's second screen could not look closer, once keys are in use."""
    out = tmp_path / "crop.png"
    words = ("--edge", "uav-1", "--box", "100,100,64,48", "--out", str(out))
    assert flight.asked("still", *words, file=flight.fleet.file(who)) == 0, capsys.readouterr().err
    picture = cv2.imread(str(out))
    assert picture.shape == (48, 64, 3)
    assert picture.std() > 0


def test_who_only_watches_is_told_by_its_own_file(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """'Does not answer' would send the guest looking for a fault of the link."""
    file, out = flight.fleet.file("guest"), tmp_path / "crop.png"
    assert flight.asked("edges", file=file) == 0
    assert capsys.readouterr().out == "uav-1\n"
    assert flight.asked("still", "--out", str(out), file=file) == 2
    assert capsys.readouterr().err == (
        f"hvt-ground: {file} lets us watch uav-1, not command it: a key that hvt-ground keys add-ground makes "
        "without --watch-only may\n"
    )
    assert not out.exists()


def test_who_gives_itself_the_right_is_refused_there_and_told(
    flight: Flight, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file is text: who writes more rights into it must not have them; an honest mistake needs its reason."""
    out, bold = tmp_path / "crop.png", flight.fleet.bold("ops")
    assert flight.asked("still", "--edge", "uav-1", "--out", str(out), file=bold) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        "hvt-ground: uav-1 does not answer on control: this key may lack the right to command"
    )
    assert "hvt-ground keys list shows who has it" in said
    assert said.count("\n") == 1
    assert not out.exists()


def test_a_key_that_the_ground_does_not_know_is_told(
    flight: Flight, capsys: pytest.CaptureFixture[str]
) -> None:
    """A new key and an old file on the ground: an edge that is there would be called absent, and nothing more."""
    file = flight.fleet.file("stranger")
    assert flight.asked("keyframe", "--edge", "uav-1", file=file) == 2
    said = capsys.readouterr().err
    assert re.fullmatch(
        r"hvt-ground: edge 'uav-1' does not answer: is it flying, and does this link reach it\?; base, to which we "
        r"are linked, .* \(hvt-ground keys list; a base.json5 from before our key was made does not name it\)\n",
        said,
    ), said
    assert flight.asked("edges", file=file) == 0
    assert capsys.readouterr().out.startswith("no edge is there; base, to which we are linked, ")


def test_an_edge_that_our_own_file_does_not_name_is_not_asked_for(
    flight: Flight, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file from before the edge was added drops the question on our own machine."""
    file = flight.fleet.file("ops")
    assert flight.asked("keyframe", "--edge", "uav-7", file=file) == 2
    assert f"{file} does not name uav-7: hvt-ground keys list shows" in capsys.readouterr().err
