"""The processor time of an edge beyond the necessary: at its start, with video alone, by default."""

import resource
import subprocess
import sys
import time

from bench.bars import measured
from bench.support.material import SIZE, clip, encoder, frames

_FRAMES = 100
_FIRST = 20
_ROUNDS, _IMPORTS = 2, 5
"""The least of them counts: other work on the machine only ever adds."""


def rows() -> list[dict[str, object]]:
    numpy_s = _import_s("numpy")
    starts = [
        measured(
            f"hvt-{side} imported, processor time over numpy alone", _import_s(f"hvt_{side}.cli") / numpy_s
        )
        for side in ("edge", "ground")
    ]
    bare_s = min(_bare_s() for _ in range(_ROUNDS))
    video_s, default_s = (_frame_s(*settings) for settings in (("--method", "M0"), ()))
    return [
        *starts,
        measured("M0, processor time of the edge over decode and x265 bare", video_s / bare_s),
        measured("defaults, processor time of the edge over decode and x265 bare", default_s / bare_s),
        measured("that floor, ms a frame", bare_s * 1e3),
    ]


def _import_s(module: str) -> float:
    return min(_spent_s("-c", f"import {module}") for _ in range(_IMPORTS))


def _bare_s() -> float:
    """Processor time of one frame, in this process: reading the clip, then x265."""
    began_s = time.process_time()
    taken = frames(_FRAMES)
    read_s = time.process_time() - began_s
    coder = encoder(base_bps=800_000)
    began_s = time.process_time()
    for frame in taken:
        coder.encode(frame)
    return (read_s + time.process_time() - began_s) / len(taken)


def _frame_s(*settings: str) -> float:
    """Processor time of one frame of such a flight, without its start."""
    start_s, all_s = (
        min(_edge_s(count, *settings) for _ in range(_ROUNDS)) for count in (_FIRST, _FIRST + _FRAMES)
    )
    return (all_s - start_s) / _FRAMES


def _edge_s(count: int, *settings: str) -> float:
    """Processor time of a flight of ``count`` frames in lockstep."""
    return _spent_s(
        *("-m", "hvt_edge.cli", "--source", str(clip()), "--pace", "lockstep", "--quiet", *settings),
        *("--size", "{}x{}".format(*SIZE), "--wait", "0s", "--max-frames", str(count)),
        *("--connect", "tcp/127.0.0.1:9"),
    )


def _spent_s(*arguments: str) -> float:
    """Processor seconds of this Python with these arguments."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *arguments], check=False, stdout=subprocess.DEVNULL, timeout=300)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
