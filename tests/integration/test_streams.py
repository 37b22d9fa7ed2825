"""What becomes of a run whose output nobody reads: a closed terminal, a dead pipe, a full disk."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration


def dead_pipe() -> int:
    """A file descriptor on which every write fails, as to a program that has ended."""
    reading, writing = os.pipe()
    os.close(reading)
    return writing


def full_disk() -> int:
    """A file descriptor on which every write fails for want of room."""
    return os.open("/dev/full", os.O_WRONLY)


def play(module: str, *words: str, folder: Path, output: int, code: int = 0) -> object:
    """Run a program with both outputs going there, to its end with ``code``; return the summary."""
    command = [sys.executable, "-m", module, *words, "--summary", "s.json"]
    with os.fdopen(output, "wb") as file:
        done = subprocess.run(command, cwd=folder, stdout=file, stderr=file, check=False)
    assert done.returncode == code
    return json.loads((folder / "s.json").read_text())


@pytest.mark.parametrize("output", [pytest.param(dead_pipe, marks=pytest.mark.nightly), full_disk])
def test_an_edge_flies_on_when_nobody_reads_its_status(scene, tmp_path, free_port, output):
    """The video would end with the terminal, or the log's disk, from which the drone was started."""
    edge = ("--source", str(scene), "--size", "320x180", "--preset", "ultrafast", "--max-frames", "20")
    link = ("--connect", f"tcp/127.0.0.1:{free_port}", "--wait", "0s")
    link += ("--pace", "lockstep", "--detector", "motion")
    summary = play("hvt_edge.cli", *edge, *link, folder=tmp_path, output=output(), code=1)
    assert summary["frame_account"]["nobody_listened"] == summary["frames"] == 20


def test_a_ground_serves_on_when_nobody_reads_its_status(tmp_path, free_port):
    """The recording would end with the terminal."""
    listen = ("--listen", f"tcp/127.0.0.1:{free_port}", "--once", "--wait", "1500ms")
    assert play("hvt_ground.cli", *listen, folder=tmp_path, output=dead_pipe()) == []
