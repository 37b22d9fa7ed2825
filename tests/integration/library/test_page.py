"""The programs of docs/library.md, as a reader copies them."""

import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from media.recorded_feed import coded, drawn_frames
from programs.processes import eventually, free_ports

pytestmark = [pytest.mark.nightly, pytest.mark.integration]

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """What OpenCV opens as it would a camera; HEVC as it is coded, longer than a busy machine takes to start."""
    clip = tmp_path / "clip.hevc"
    clip.write_bytes(6 * b"".join(unit for unit, _ in coded(drawn_frames(300, (320, 192)), kbps=400)))
    return clip


def test_both_programs_run_as_they_are_printed(camera, tmp_path):
    """The first thing a reader tries would fail."""
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    edge, ground = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert max(len(one.splitlines()) for one in (edge, ground)) <= 20
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    # A camera gives its pictures in their time, a clip at once; this one goes until the ground has seen enough.
    paced = edge.replace("        edge.push(", "        __import__('time').sleep(0.05)\n        edge.push(")
    paced = paced.replace("if not there:", "if not there or __import__('os').path.exists('enough'):")
    with ExitStack() as stack:
        processes = []
        for name, program, words in (
            ("ground", ground, [endpoint]),
            ("edge", paced, [str(camera), endpoint]),
        ):
            out, errors = (
                stack.enter_context((tmp_path / f"{name}.{end}").open("wb")) for end in ("out", "err")
            )
            command = [sys.executable, "-u", "-c", program, *words]
            process = subprocess.Popen(command, stdout=out, stderr=errors, cwd=tmp_path)
            stack.callback(process.wait)
            stack.callback(process.kill)
            processes.append(process)

        def said(name: str) -> str:
            return (tmp_path / name).read_text(encoding="utf-8")

        eventually(lambda: "rover-1 tracks {" in said("ground.out"), what="the ground sees")
        (tmp_path / "enough").touch()
        codes = [one.wait(60) for one in processes]
    assert codes == [0, 0], said("ground.err") + said("edge.err")
    heard, sent = said("ground.out"), said("edge.out")
    assert re.fullmatch(r"\d+ bit/s sent\n", sent)
    assert "rover-1 picture" in heard
    assert "(192, 320, 3)" in heard or "(360, 640, 3)" in heard
