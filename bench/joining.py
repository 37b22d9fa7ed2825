"""A ground that comes late, on loopback: how soon it has a picture, and how long each side takes to end."""

import csv
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from bench.bars import measured
from bench.support.material import FPS, clip, nano
from bench.support.processes import free_endpoint, running

_GROUNDS = 5
_PATIENCE_S = 60.0


def rows() -> list[dict[str, object]]:
    pictures_s, grounds_s, edge_s = _joined()
    return [
        measured(
            "a late ground's first picture, in frames", FPS * max(pictures_s), of=f"worst of {_GROUNDS}"
        ),
        measured("a ground ends after Ctrl-C, worst, s", max(grounds_s)),
        measured("the edge ends after Ctrl-C, s", edge_s),
    ]


def _joined() -> tuple[list[float], list[float], float]:
    """Seconds from first message to first picture and from Ctrl-C to the end of each ground, and of the edge."""
    endpoint = free_endpoint()
    pictures_s, grounds_s = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = ("--source", _long_clip(folder), "--listen", endpoint, "--wait", "0s", "--quiet")
        # No keyframe but those that are asked for.
        rare = ("--detector", nano(), "--keyframe-interval", "0s")
        with running("hvt_edge.cli", *words, *rare) as edge:
            for number in range(_GROUNDS):
                timing = folder / f"{number}.csv"
                with running(
                    *("hvt_ground.cli", "--connect", endpoint, "--quiet", "--detector", nano()),
                    *("--record", folder / f"{number}.rrd", "--timing", timing),
                ) as ground:
                    pictures_s.append(_first_picture_s(timing))
                    grounds_s.append(_end_s(ground))
            return pictures_s, grounds_s, _end_s(edge)


def _long_clip(folder: Path) -> Path:
    """The clip forty times over: a list for FFmpeg, which takes only plain names beside it."""
    (folder / "once.mp4").symlink_to(clip().resolve())
    long = folder / "long.ffconcat"
    long.write_text("ffconcat version 1.0\n" + "file once.mp4\n" * 40, encoding="ascii")
    return long


def _first_picture_s(timing: Path) -> float:
    until_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < until_s:
        text = timing.read_text(encoding="ascii") if timing.exists() else ""
        rows = list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
        shown_ns = [int(row["shown_ns"]) for row in rows if row["kind"] == "base" and int(row["shown_ns"])]
        if shown_ns:
            return (shown_ns[0] - min(int(row["received_ns"]) for row in rows)) / 1e9
        time.sleep(0.05)
    raise RuntimeError(f"no picture within {_PATIENCE_S:.0f} s")


def _end_s(process: subprocess.Popen) -> float:
    began_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(_PATIENCE_S)
    return time.monotonic() - began_s
