"""The programs of docs/library.md, as a reader copies them."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from media.recorded_feed import coded, drawn_frames
from programs.processes import free_ports

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """What OpenCV opens as it would a camera; HEVC as it is coded."""
    clip = tmp_path / "clip.hevc"
    clip.write_bytes(b"".join(unit for unit, _ in coded(drawn_frames(300, (320, 192)), kbps=400)))
    return clip


def test_both_programs_run_as_they_are_printed(camera, tmp_path):
    """The first thing a reader tries would fail."""
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    edge, ground = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert max(len(one.splitlines()) for one in (edge, ground)) <= 20
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    # A camera gives its pictures in their time, a clip at once.
    paced = edge.replace("        edge.push(", "        __import__('time').sleep(0.05)\n        edge.push(")
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", program, *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
        )
        for program, words in ((ground, [endpoint]), (paced, [str(camera), endpoint]))
    ]
    (heard, ground_errors), (sent, edge_errors) = [one.communicate(timeout=120) for one in processes]
    assert [one.returncode for one in processes] == [0, 0], ground_errors + edge_errors
    assert re.fullmatch(r"\d+ bit/s sent\n", sent)
    assert "rover-1 picture" in heard
    assert "(192, 320, 3)" in heard or "(360, 640, 3)" in heard
    assert "rover-1 tracks {" in heard
