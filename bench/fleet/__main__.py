"""A ground with 1, 2, 4, 8 and 16 edges: ``make bench-fleet``, or ``python -m bench.fleet [COUNT …]``.

Each edge sends 640x360 at 15 fps of the drawn scene, played from this process (`bench.fleet.played`). The ground
detects on every third frame and tracks all it has time for. Shown are the frames that it tracked a second, the cores
that it took, their ratio, the share of frames passed over for lack of time at the best and the worst served edge
(fair where they are alike), capture to overlay at the worst one, and peak memory.
"""

import argparse
import json
import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.progress import track
from rich.table import Table

from bench.fleet.played import SIZE, coded, played
from bench.support.processes import Peaks, cpu_s, free_endpoint, running
from hvt_edge.source.opening import open_source

COUNTS = (1, 2, 4, 8, 16)
_FPS = 15.0
_SCENE_S = 4
_PLAYED_S = 20.0


class Served(NamedTuple):
    """The work of a ground for so many edges."""

    edges: int
    tracked_fps: float
    """Frames of all edges together that are tracked in a second."""
    cores: float
    passed_over: tuple[float, float]
    """Share of frames, at the best and the worst served edge."""
    delay_p95_ms: float
    """At the worst one."""
    peak_mb: float


def main(arguments: list[str]) -> int:
    """Print the table; it is also written to build/fleet.json."""
    parser = argparse.ArgumentParser(prog="python -m bench.fleet", description=__doc__)
    parser.add_argument("edges", nargs="*", type=int, default=COUNTS, help="fleets of so many edges")
    counts = parser.parse_args(arguments).edges
    with open_source("demo", size=SIZE, fps=_FPS, max_frames=round(_SCENE_S * _FPS)) as source:
        units = coded([one.base_bgr for one in source.frames(start_ns=0)], fps=_FPS)
    console = Console(highlight=False)
    rows = [_served(count, units) for count in track(counts, "flying", console=console, transient=True)]
    table = Table(title=f"one ground, {os.cpu_count()} cores", title_justify="left")
    for name in ("edges", "tracked fps", "cores", "fps a core", "passed over", "delay p95 ms", "peak MB"):
        table.add_column(name, justify="right")
    for row in rows:
        least, most = row.passed_over
        table.add_row(
            str(row.edges), f"{row.tracked_fps:.1f}", f"{row.cores:.2f}", f"{row.tracked_fps / row.cores:.1f}",
            f"{least:.0%} … {most:.0%}", f"{row.delay_p95_ms:.0f}", f"{row.peak_mb:.0f}",
        )  # fmt: skip
    console.print(table)
    out = Path("build/fleet.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps([row._asdict() for row in rows], indent=2) + "\n", encoding="utf-8")
    return 0


def _served(count: int, units: list) -> Served:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        words = (
            "--listen",
            endpoint,
            "--once",
            "--quiet",
            "--record",
            folder,
            "--summary",
            folder / "s.json",
        )
        words += ("--provider", "cpu", "--detect-every", "3", "--patience", "2s")
        ground = stack.enter_context(running("hvt_ground.cli", *words))
        peaks, spent = Peaks([ground]), []

        def on_round() -> None:
            peaks.sample()
            spent.append(cpu_s(ground))

        with ExitStack() as edges:
            played(edges, count, endpoint, units, fps=_FPS, lasts_s=_PLAYED_S, on_round=on_round)
        ground.wait(timeout=120)
        said = json.loads((folder / "s.json").read_text())
    said = said if isinstance(said, list) else [said]
    passed_over = [one["frames_untracked"] / max(1, one["frames_decoded"]) for one in said]
    tracked = sum(one["frames_decoded"] - one["frames_untracked"] for one in said)
    return Served(
        edges=count,
        tracked_fps=tracked / _PLAYED_S,
        cores=(spent[-1] - spent[0]) / _PLAYED_S,
        passed_over=(min(passed_over), max(passed_over)),
        delay_p95_ms=max(one["latency_ms"]["p95"] or 0.0 for one in said),
        peak_mb=peaks.mb[0],
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
