"""A board on paper: ``make bench-board``. An edge with a quarter of two cores flies 640x360 at 10 fps for a minute.

A control group holds the edge to that, or ``cpulimit`` where none can be made here. Other limits of a
board, memory and heat, are not tried. Ends with code 1 where a bar is missed: no frame is lost for want of
processor time, no box is older than a second and a half, and the doctor's forecast is right within a fifth.
"""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import chain, cycle, islice
from pathlib import Path
from urllib.request import urlopen

import av
import cv2

from bench.bars import measured
from bench.support.material import frames
from bench.support.processes import cpu_s, free_endpoint, running

_SHARE, _CORES = 0.25, 2
_PERIOD_US = 100_000
_LASTS_S, _FPS, _SIZE = 60, 10, (640, 360)
_QUOTA_US = round(_SHARE * _CORES * _PERIOD_US)
_GROUPS = (
    (Path("/sys/fs/cgroup"), "cgroup.controllers", "cpu.max", f"{_QUOTA_US} {_PERIOD_US}"),
    (Path("/sys/fs/cgroup/cpu"), "cpu.cfs_quota_us", "cpu.cfs_quota_us", f"{_QUOTA_US}"),
)
"""Cgroups of version 2 and 1: where they are, a file that is there, and which text goes into which file."""


Hold = Callable[[str], object]
"""Holds the process of this id to its share, from now on."""


def main() -> int:
    """Fly, print the measures, and say whether they hold."""
    with contextlib.ExitStack() as stack:
        hold = _by_group(stack) or _by_cpulimit(stack)
        if hold is None:
            print("bench-board: left out: no control group can be made here, and cpulimit is not installed")
            return 0
        rows = _rows(Path(stack.enter_context(tempfile.TemporaryDirectory())), hold)
    for row in rows:
        print(f"{row['measure']}: {row['value']:.2f}, bar {row['bar']}")
    return 1 if any(row["holds"] is False for row in rows) else 0


def _rows(folder: Path, hold: Hold) -> list[dict[str, object]]:
    endpoint, address = free_endpoint(), free_endpoint().removeprefix("tcp/")
    summary, source = folder / "edge.json", _film(folder / "board.mp4")
    settings = ("--source", source, "--size", f"{_SIZE[0]}x{_SIZE[1]}", "--fps", _FPS, "--connect", endpoint)
    forecast = _forecast(settings, hold)
    with (
        running("hvt_ground.cli", "--listen", endpoint, "--once", "--quiet", "--record", folder),
        running(
            "hvt_edge.cli", *settings, "--quiet", "--wait", "60s", "--summary", summary, "--metrics", address
        ) as edge,
    ):
        hold(str(edge.pid))
        ages, spent = [0.0], (0.0, 0.0)
        began = None
        while edge.poll() is None:
            time.sleep(1.0)
            with contextlib.suppress(OSError, ValueError, TypeError, KeyError):
                state = json.loads(urlopen(f"http://{address}/state.json", timeout=5).read())
                if state["state"] == "running" and state["boxes_age_s"] is not None:
                    ages.append(state["boxes_age_s"])
                    spent = (time.monotonic(), cpu_s(edge))
                    began = began or spent
    content = json.loads(summary.read_text())
    needed = (spent[1] - began[1]) / (spent[0] - began[0])
    return [
        measured("board: frames lost for want of processor time", content["frames_dropped_cpu"]),
        measured("board: oldest boxes, s", max(ages)),
        measured("board: what the doctor's forecast is off by", abs(forecast / needed - 1)),
    ]


def _film(path: Path) -> Path:
    """Pictures of a car park, forth and back."""
    taken = [cv2.resize(one.source_bgr, _SIZE, interpolation=cv2.INTER_AREA) for one in frames(200)]
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=_FPS, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height = _SIZE
        for picture in islice(cycle(chain(taken, taken[::-1])), _LASTS_S * _FPS):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        film.mux(stream.encode(None))
    return path


def _forecast(settings: tuple[object, ...], hold: Hold) -> float:
    """The processors that the doctor says a flight takes."""
    command = [sys.executable, "-m", "hvt_edge.cli", "doctor", "--json", *map(str, settings)]
    doctor = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    hold(str(doctor.pid))
    findings = {one["check"]: one for one in json.loads(doctor.communicate(timeout=300)[0])}
    found = re.search(r"about ([\d.]+) cores", findings["processor"]["found"])
    assert found is not None, findings
    return float(found[1])


def _by_group(stack: contextlib.ExitStack) -> Hold | None:
    for root, sign, bound, text in _GROUPS:
        group = root / f"hvt-bench-{os.getpid()}"
        if not (root / sign).exists():
            continue
        with contextlib.suppress(OSError):
            group.mkdir()
            stack.callback(group.rmdir)
            (group / bound).write_text(text)
            return (group / "cgroup.procs").write_text
    return None


def _by_cpulimit(stack: contextlib.ExitStack) -> Hold | None:
    program = shutil.which("cpulimit")
    if program is None:
        return None

    def hold(pid: str) -> None:
        limit = f"{round(100 * _SHARE * _CORES)}"
        held = subprocess.Popen([program, "-l", limit, "-p", pid], stdout=subprocess.DEVNULL)
        stack.callback(held.wait)

    return hold


if __name__ == "__main__":
    sys.exit(main())
