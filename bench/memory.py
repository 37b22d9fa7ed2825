"""Memory and threads, whatever is installed: an edge on the demo with a ground, one of video alone and one at its
defaults; then a ground of one edge and of eight.

The eight are played from this process: access units of 640x360 at 5 fps, coded once, over eight Zenoh sessions.
"""

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import cv2

from bench.bars import measured
from bench.fleet.played import SIZE, coded, played
from bench.support.material import clip, frames
from bench.support.processes import Peaks, free_endpoint, running

_FPS = 5.0
_EDGES = 8
_PLAYED_S = 25.0


def rows() -> list[dict[str, object]]:
    edge, ground = _demo()
    video, default = _clip("--method", "M0"), _clip()
    one, all_of = _played(1), _played(_EDGES)
    further = _Peak(*((many - few) / (_EDGES - 1) for few, many in zip(one, all_of, strict=True)))
    return [
        *_memory("edge at its defaults on the 1080p demo, peak MB", edge),
        *_memory("ground of that edge, peak MB", ground),
        *_memory("M0 on a 720p clip, peak MB of the edge", video),
        measured("M0 on a 720p clip, threads of the edge", video.threads),
        *_memory("defaults on a 720p clip, peak MB of the edge", default),
        measured("defaults on a 720p clip, threads of the edge", default.threads),
        *_memory("each further edge at the ground, MB", further),
        measured("each further edge at the ground, threads", further.threads),
        *_memory("ground of one edge of 640x360, peak MB", one),
        measured("ground of one edge of 640x360, threads", one.threads),
    ]


class _Peak(NamedTuple):
    mb: float
    resident_mb: float
    threads: float


def _memory(measure: str, peak: _Peak) -> list[dict[str, object]]:
    # Its own, which has the bar, and with pages of files.
    return [measured(measure, peak.mb), measured(f"{measure}, with pages of files", peak.resident_mb)]


def _peaks_of(peaks: Peaks) -> list[_Peak]:
    return [_Peak(*one) for one in zip(peaks.mb, peaks.resident_mb, peaks.threads, strict=True)]


def _demo() -> list[_Peak]:
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
    return _peaks_of(peaks)


def _clip(*settings: str) -> _Peak:
    """The peak of an edge to which nobody listens."""
    nobody = ("--wait", "0s", "--connect", free_endpoint(), "--quiet")
    with running("hvt_edge.cli", "--source", clip(), *nobody, *settings) as edge:
        peaks = Peaks([edge])
        peaks.until_ended(edge, patience_s=180)
    return _peaks_of(peaks)[0]


def _played(count: int) -> _Peak:
    """The peak of a ground that ``count`` edges send to."""
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
    return _peaks_of(peaks)[0]
