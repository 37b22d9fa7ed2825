"""``hvt-ground --log`` and ``replay``: a flight is received again, the same or with other models."""

from __future__ import annotations

import csv
import time
from pathlib import Path

import pytest

import hvt_ground.cli
from hvt_common.units import SECOND_NS
from hvt_ground.sinks.message_log import read_log
from programs.processes import Link

pytestmark = pytest.mark.integration

SETTINGS = ("--provider", "cpu", "--quiet")
NAMES = ("frame", "id", "x", "y", "w", "h", "class", "refined", "origin")


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Five seconds of the drawn scene in lockstep, with stills and tracks; and the ground's summary."""
    folder = tmp_path_factory.mktemp("flight")
    with Link(folder) as link:
        ground = link.ground(
            *("--once", "--provider", "cpu", "--record", "flight.rrd"),
            *("--tracks", "flight.csv", "--log", "flight.hvtlog"),
        )
        edge = link.edge(
            *("--source", "demo", "--max-frames", "75", "--pace", "lockstep", "--size", "640x360"),
            *("--budget", "400kbps", "--profile", "thin", "--preset", "ultrafast", "--edge-id", "uav-1"),
        )
        edge.finish()
        return folder, ground.finish(within_s=60)


def replay(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """Run the command; it must be content."""
    assert hvt_ground.cli.main(["replay", *map(str, words)]) == 0
    return capsys.readouterr().out


def lines(table: Path) -> list[tuple[str, ...]]:
    """What of it does not hang on the clock."""
    rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    return [tuple(row[name] for name in NAMES) for row in rows]


def test_the_same_models_see_the_same(flight, tmp_path, capsys):
    """Whoever compares models would compare runs."""
    folder, summary = flight
    outcome = replay(
        capsys, folder / "flight.hvtlog", "--tracks", tmp_path / "again.csv", "--record", tmp_path, *SETTINGS
    )
    assert summary["frames"] == 75
    assert summary["stills"]["received"] > 3
    assert lines(tmp_path / "again.csv") == lines(folder / "flight.csv")
    assert f"stills    │ {summary['stills']['received']}," in outcome
    assert len(list(tmp_path.glob("hvt-uav-1-*.rrd"))) == 1


def test_another_detector_sees_something_else(flight, tmp_path, capsys):
    """A flight would have to be flown again for each model."""
    folder, _ = flight
    words = ("--detector", "motion", "--classifier", "none", "--tracks", tmp_path / "motion.csv")
    replay(capsys, folder / "flight.hvtlog", *words, "--record", tmp_path, *SETTINGS)
    base = [row for row in lines(tmp_path / "motion.csv") if row[-1] == "base"]
    assert base != [row for row in lines(folder / "flight.csv") if row[-1] == "base"]
    assert {row[6] for row in base} == {"moving"}


def test_edges_and_folders_are_as_in_flight(flight, tmp_path, capsys):
    """A new folder would stay empty, and an edge that nobody wants would be shown."""
    folder, _ = flight
    words = ("--detector", "motion", "--classifier", "none", *SETTINGS)
    assert "no session" in replay(
        capsys, folder / "flight.hvtlog", "--edges", "other", *words, "--record", tmp_path
    )
    replay(capsys, folder / "flight.hvtlog", *words, "--record", tmp_path / "new")
    assert len(list((tmp_path / "new").glob("*.rrd"))) == 1


def test_its_speed_can_be_that_of_the_flight(flight, tmp_path, capsys):
    """A viewer would see minutes in a moment."""
    folder, _ = flight
    times = [one.received_ns for one in read_log(folder / "flight.hvtlog")]
    span_s = (times[-1] - times[0]) / SECOND_NS
    words = ("--detector", "motion", "--classifier", "none", "--record", tmp_path)
    began_s = time.monotonic()
    replay(capsys, folder / "flight.hvtlog", "--speed", span_s / 4, *words, *SETTINGS)
    assert time.monotonic() - began_s > 3.5, "four seconds were asked for"


def test_what_cannot_be_is_said_in_one_sentence(flight, tmp_path, capsys):
    """A traceback, or a ground that waits for ever."""
    folder, _ = flight
    log = str(folder / "flight.hvtlog")
    for words, said in (
        (["replay"], "give the file first"),
        (["replay", str(folder / "flight.rrd")], "is no message log"),
        (["replay", str(tmp_path / "absent.hvtlog")], "No such file"),
        (["replay", log, "--listen", "tcp/127.0.0.1:1"], "--listen is not accepted: a replay has no link"),
        (["replay", log, "--speed", "0"], "--speed 0 is not accepted"),
        (["replay", log, "--detector", str(tmp_path / "absent.onnx")], "absent.onnx"),
        (["replay", log, "--edges", "UAV"], "edge pattern 'UAV' is not usable"),
        (["replay", log, "--tracks", str(tmp_path / "absent" / "t.csv")], "--tracks"),
    ):
        assert hvt_ground.cli.main(words) == 2, words
        error = capsys.readouterr().err
        assert said in error
        assert len(error.splitlines()) == 1, error
