"""Memory and threads, whatever is installed: an edge on the demo with a ground, one of video alone and one at its
defaults; then a ground of one edge and of eight.

The eight are played from this process: access units of 640x360 at 5 fps, coded once, over eight Zenoh sessions.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

import cv2

from bench.bars import measured
from bench.fleet.played import SIZE, coded, played
from bench.support.material import clip, frames
from bench.support.processes import Peaks, free_endpoint, running

_FPS = 5.0
_EDGES = 8
_PLAYED_S = 25.0


def rows() -> list[dict[str, object]]:
    edge_mb, ground_mb = _demo()
    clip_mb, clip_threads = _clip("--method", "M0")
    auto_mb, auto_threads = _clip()
    (one_mb, one_threads), (all_mb, all_threads) = _played(1), _played(_EDGES)
    return [
        measured("edge at its defaults on the 1080p demo, peak MB", edge_mb),
        measured("ground of that edge, peak MB", ground_mb),
        measured("M0 on a 720p clip, peak MB of the edge", clip_mb),
        measured("M0 on a 720p clip, threads of the edge", clip_threads),
        measured("defaults on a 720p clip, peak MB of the edge", auto_mb),
        measured("defaults on a 720p clip, threads of the edge", auto_threads),
        measured("each further edge at the ground, MB", (all_mb - one_mb) / (_EDGES - 1)),
        measured("each further edge at the ground, threads", (all_threads - one_threads) / (_EDGES - 1)),
        measured("ground of one edge of 640x360, peak MB", one_mb),
        measured("ground of one edge of 640x360, threads", one_threads),
    ]


def _demo() -> tuple[float, float]:
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "bench.rrd"
        with (
            running(
                "hvt_ground.cli", "--listen", endpoint, "--once", "--quiet", "--record", record
            ) as ground,
            running("hvt_edge.cli", "--source", "demo", "--connect", endpoint, "--quiet") as edge,
        ):
            peaks = Peaks([edge, ground])
            peaks.until_ended(edge, patience_s=180)
            peaks.until_ended(ground, patience_s=60)
    return peaks.mb[0], peaks.mb[1]


def _clip(*settings: str) -> tuple[float, int]:
    """Peak MB and most threads of an edge to which nobody listens."""
    nobody = ("--wait", "0s", "--connect", free_endpoint(), "--quiet")
    with running("hvt_edge.cli", "--source", clip(), *nobody, *settings) as edge:
        peaks = Peaks([edge])
        peaks.until_ended(edge, patience_s=180)
    return peaks.mb[0], peaks.threads[0]


def _played(count: int) -> tuple[float, int]:
    """Peak MB and threads of a ground that so many edges send to."""
    endpoint = free_endpoint()
    # Two seconds.
    units = coded(
        [cv2.resize(one.base_bgr, SIZE, interpolation=cv2.INTER_AREA) for one in frames(30)[::3]], fps=_FPS
    )
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        ground = stack.enter_context(
            running("hvt_ground.cli", "--listen", endpoint, "--quiet", "--record", folder)
        )
        peaks = Peaks([ground])
        played(stack, count, endpoint, units, fps=_FPS, lasts_s=_PLAYED_S, on_round=peaks.sample)
    return peaks.mb[0], peaks.threads[0]


if __name__ == "__main__":
    for one in rows():
        print(one)
