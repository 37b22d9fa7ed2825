"""The same as processes of their own: what a shell and a service manager see."""

import subprocess
import sys

import pytest

from hvt_common import __version__
from programs.refusal import checked, snapshot

pytestmark = pytest.mark.integration


def started(folder, module, *words):
    """Run a program to its end: its exit code, and what it says."""
    command = [sys.executable, "-m", module, *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


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
    code, out, err = started(here, module, *words)
    assert (code, out) == (2, "")
    program = "hvt-" + module.removeprefix("hvt_").removesuffix(".cli")
    assert told in checked(err, program=program, left=snapshot(here) - before)


@pytest.mark.parametrize(
    ("module", "asked", "said"),
    [
        *((one, "--version", f" {__version__}\n") for one in ("hvt_models.command", "hvt_study.cli")),
        ("hvt_ground.cli", "--help", "--summary"),
    ],
)
def test_version_and_help_are_no_error(here, module, asked, said):
    """Who reports a fault would be told that a command is required, and who asks for help be told off."""
    code, out, err = started(here, module, asked)
    assert (code, err) == (0, "")
    assert said in out
