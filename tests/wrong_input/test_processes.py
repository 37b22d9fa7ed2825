"""The same as processes of their own: what a shell and a service manager see."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hvt_common import __version__
from programs.refusal import checked, snapshot

pytestmark = pytest.mark.integration


def started(module: str, *words: str, folder) -> subprocess.CompletedProcess[str]:
    """Run a program to its end."""
    command = [sys.executable, "-m", module, *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("module", "words", "told"),
    [
        ("hvt_edge.cli", ("--source", "nope.mp4", "--summary", "s.json"), "'nope.mp4' does not exist"),
        ("hvt_ground.cli", ("--record", "new", "--classifier", "nope.onnx"), "classifier nope.onnx"),
    ],
)
def test_one_sentence_and_exit_code_2(here, module, words, told):
    """A script could not tell a mistake in its settings from a crash."""
    before = snapshot(here)
    done = started(module, *words, folder=here)
    assert done.returncode == 2
    assert done.stdout == ""
    program = "hvt-" + module.removeprefix("hvt_").removesuffix(".cli")
    assert told in checked(done.stderr, program=program, left=snapshot(here) - before)


@pytest.mark.parametrize("module", ["hvt_models.command", "hvt_study.cli"])
def test_every_program_says_its_version(here, module):
    """Who reports a fault would be told that a command is required."""
    assert started(module, "--version", folder=here).stdout.endswith(f" {__version__}\n")


def test_help_is_not_an_error(here):
    """Who asks for help would be told off."""
    done = started("hvt_ground.cli", "--help", folder=here)
    assert done.returncode == 0
    assert done.stderr == ""
    assert "--summary" in done.stdout
