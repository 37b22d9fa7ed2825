"""How far a frame and a still walk through the code, over a real link."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.nightly
@pytest.mark.integration
def test_no_walk_is_longer_than_its_bound():
    """Who follows a frame or a still by reading would get lost."""
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "lab.walks"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
