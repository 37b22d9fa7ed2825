"""``hvt-ground recordings``: the flight with the truck is found, and what cannot be is said in one sentence."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import hvt_ground.cli
from hvt_archive.index.database import INDEX, Index, read_index
from hvt_common.units import SECOND_NS
from hvt_ground.recordings.row import RecordingRow

NOON_NS = 1_591_012_800 * SECOND_NS
"""2020-06-01T12:00:00Z."""


def row(file: str, edge: str, begin_ns: int, classes: dict[str, int], **changes: object) -> RecordingRow:
    """An hour."""
    end_ns = begin_ns + 3600 * SECOND_NS
    values: dict[str, Any] = {"size_bytes": 135_000_000, "frames": 54_000, "stills": 31, "whole": True}
    values |= {"written_ns": end_ns, "session": "00ff", "classes": classes}
    return RecordingRow(file=file, edge=edge, begin_ns=begin_ns, end_ns=end_ns, **(values | changes))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    index = Index(tmp_path)
    index.put(row("b.rrd", "uav-1", NOON_NS, {"car": 12, "truck": 1}))
    index.put(row("a.rrd", "uav-1", NOON_NS + 86_400 * SECOND_NS, {"car": 3}, video=False))
    now_ns = time.time_ns()
    index.put(row("c.rrd", "uav-2", now_ns - 3000 * SECOND_NS, {"truck\x1b[2J": 1}, whole=False))
    index.close()
    return tmp_path


def found(capsys: pytest.CaptureFixture[str], *words: object) -> list[str]:
    assert hvt_ground.cli.main(["recordings", *map(str, words)]) == 0
    return [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]]


def test_the_table_has_them_in_the_order_of_their_time(folder, capsys):
    """One would have to know the names of the files by heart."""
    assert hvt_ground.cli.main(["recordings", "list", str(folder)]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split()[:3] == ["file", "edge", "begin"]
    assert [" ".join(line.split()) for line in lines[:2]] == [
        "b.rrd uav-1 2020-06-01T12:00:00Z 1:00:00 135.0 54000 31 12 car, 1 truck",
        "a.rrd uav-1 2020-06-02T12:00:00Z 1:00:00 135.0 54000 31 3 car (video removed)",
    ]
    assert "truck?[2J (being written" in lines[2], "a name from the wire would move the cursor"


@pytest.mark.parametrize(
    ("words", "files"),
    [
        ((), ["b.rrd", "a.rrd", "c.rrd"]),
        (("--class", "truck"), ["b.rrd"]),
        (("--class", "zebra"), []),
        (("--edge", "uav-2"), ["c.rrd"]),
        (("--since", "10min"), ["c.rrd"]),
        (("--since", "3660days"), ["b.rrd", "a.rrd", "c.rrd"]),
        (("--since", "2020-06-02"), ["a.rrd", "c.rrd"]),
        (("--since", "2020-06-01T12:30", "--until", "2020-06-01T12:40+00:00"), ["b.rrd"]),
        (("--until", "2020-06-02T13:30+02:00"), ["b.rrd"]),
        (("--class", "car", "--since", "2020-06-02", "--edge", "uav-1"), ["a.rrd"]),
    ],
)
def test_find(folder, capsys, words, files):
    """The hour that matters would be searched among hundreds."""
    assert found(capsys, "find", folder, *words) == files


def test_what_was_not_read_yet_is_said_to_be_so(folder, capsys):
    """It had 0 frames and no class, and a table without it said that there was no truck.

    Nor is all known of `c.rrd`, which a killed ground left. Those of another edge are not in question.
    """
    index = Index(folder)
    index.put(row("e.rrd", "uav-2", NOON_NS, {}, session="", whole=False))
    index.close()
    for words, count in {(): 2, ("--edge", "uav-2"): 2, ("--edge", "uav-1"): 0}.items():
        assert hvt_ground.cli.main(["recordings", "find", str(folder), "--class", "truck", *words]) == 0
        said = (
            "hvt-ground recordings: files that are being written or are not read yet, and that may be of them"
        )
        assert capsys.readouterr().err == (f"{said}: {count}\n" if count else "")
    hvt_ground.cli.main(["recordings", "list", str(folder), "--json"])
    (unread,) = (one for one in json.loads(capsys.readouterr().out) if one["file"] == "e.rrd")
    assert (unread["frames"], unread["classes"]) == (None, None)
    hvt_ground.cli.main(["recordings", "find", str(folder), "--edge", "uav-2"])
    out, err = capsys.readouterr()
    assert (
        " ".join(next(one for one in out.splitlines() if "e.rrd" in one).split()[-4:])
        == "135.0 (not read yet)"
    )
    assert err == ""


def test_what_a_ground_wrote_before_it_was_killed_is_not_said_to_be_nothing(folder, capsys):
    """Its file has pictures, of which the index counts none yet: with 0 frames it would be thrown away."""
    index = Index(folder)
    began = row("d.rrd", "uav-3", NOON_NS, {}, frames=0, stills=0, whole=False)
    index.put(replace(began, begin_ns=None, end_ns=None, size_bytes=300_000))
    index.close()
    hvt_ground.cli.main(["recordings", "list", str(folder)])
    line = next(one for one in capsys.readouterr().out.splitlines() if "d.rrd" in one)
    assert line.split() == [
        "d.rrd",
        "uav-3",
        "0.3",
        "(being",
        "written,",
        "or",
        "its",
        "ground",
        "was",
        "killed)",
    ]
    hvt_ground.cli.main(["recordings", "find", str(folder), "--edge", "uav-3", "--json"])
    (one,) = json.loads(capsys.readouterr().out)
    assert (one["session"], one["frames"], one["stills"], one["classes"]) == ("00ff", None, None, None)


def test_as_json(folder, capsys):
    """A program would have to read a table."""
    assert hvt_ground.cli.main(["recordings", "find", str(folder), "--class", "truck", "--json"]) == 0
    (one,) = json.loads(capsys.readouterr().out)
    assert one["path"] == str(folder / "b.rrd")
    assert (one["begin_ns"], one["classes"], one["end"]) == (
        NOON_NS,
        {"car": 12, "truck": 1},
        "2020-06-01T13:00:00Z",
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("list", "{here}/empty"), "has no index of recordings"),
        (("find", "{here}/missing"), "has no index of recordings"),
        (("list", "{here}/damaged"), "cannot be read"),
        (("find", "{here}", "--since", "lately"), "--since 'lately' is no time: write 12h"),
        (("find", "{here}", "--until", "-2h"), "--until '-2h' is no time"),
        (("find", "{here}", "--since", "5GB"), "'5GB' is no time"),
        (("find", "{here}", "--class"), "expected one argument"),
        (("list", "{here}", "--class", "car"), "unrecognized arguments"),
        (("list",), "FOLDER"),
        (("burn", "{here}"), "burn"),
        ((), "COMMAND"),
    ],
)
def test_what_cannot_be_is_one_sentence(folder, capsys, words, said):
    """A traceback, or an empty table, which says that there was no truck."""
    (folder / "empty").mkdir()
    (folder / "damaged").mkdir()
    (folder / "damaged" / INDEX).write_text("no database " * 100)
    assert hvt_ground.cli.main(["recordings", *(one.format(here=folder) for one in words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert said in err


def test_a_folder_that_nobody_may_write_is_read(folder):
    """An archive on a card that is locked could not be searched."""
    with tempfile.TemporaryDirectory() as archive:
        shutil.copy(folder / INDEX, archive)
        Path(archive, INDEX).chmod(0o444)
        Path(archive).chmod(0o555)
        user = os.geteuid()
        if user == 0:  # who may write everywhere
            os.seteuid(65534)
        try:
            rows = read_index(Path(archive))
        finally:
            os.seteuid(user)
            Path(archive).chmod(0o755)
    assert [one.file for one in rows] == ["b.rrd", "a.rrd", "c.rrd"]


def test_it_needs_no_rerun(folder):
    """To look something up would take a second, and the viewer's package."""
    program = (
        "import sys; from hvt_ground.cli import main;"
        f"main(['recordings', 'list', {str(folder)!r}]); print('rerun' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "False"
