"""What every wrong input must come to: one sentence, exit code 2, and nothing left behind."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

import hvt_edge.cli
import hvt_ground.cli
from programs.refusal import checked, snapshot

Refused = Callable[..., str]

_PROGRAMS = {"hvt-edge": hvt_edge.cli.main, "hvt-ground": hvt_ground.cli.main}


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(here, capfd):
    """Run a program in this process with wrong settings; return the sentence it refuses them with."""

    def refused(program, *settings, code=2):
        before = snapshot(here)
        assert _PROGRAMS[program]([*settings, "--quiet"]) == code
        out, err = capfd.readouterr()
        assert out == ""
        return checked(err, program=program, left=snapshot(here) - before)

    return refused


@pytest.fixture
def pictures(here):
    """A folder that is a good source: two small pictures."""
    folder = here / "pictures"
    folder.mkdir()
    for index in range(2):
        cv2.imwrite(str(folder / f"{index}.png"), np.full((64, 96, 3), 40 * index, np.uint8))
    return "pictures"
