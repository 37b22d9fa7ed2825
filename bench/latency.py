"""Real time on loopback: capture to overlay against encode + decode + detect.

Once with a core for each side, as two machines would have, and once with all cores for both, where the detections of
both sides collide.
"""

import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.bars import measured
from bench.support.material import clip, encoder, frames, nano
from bench.support.processes import Peaks, free_endpoint, pin_to, running
from hvt_common.inference.detect import open_detector
from hvt_common.video.hevc import BaseDecoder


def rows() -> list[dict[str, object]]:
    cores = sorted(os.sched_getaffinity(0))
    result = []
    for name, pinned in (("a core each", True), ("unpinned", False)):
        if pinned and len(cores) < 2:
            result.append(measured(f"capture to overlay p95 over its floor, {name}", None))
            continue
        before = pin_to({cores[0]}) if pinned else None
        try:
            floor_ms = _floor_ms()
        finally:
            if before is not None:
                pin_to(before)
        p95_ms = _p95_ms((cores[0], cores[1]) if pinned else (None, None))
        result.append(measured(f"capture to overlay p95 over its floor, {name}", p95_ms / floor_ms))
        result.append(measured(f"that floor, {name}, ms", floor_ms))
    return result


def _floor_ms() -> float:
    """The 95th percentile of one frame's encode, decode and detector call, one after the other."""
    coder, decoder, detector = encoder(), BaseDecoder(), open_detector(str(nano()), provider="auto")
    took = []
    for frame in frames(150):
        began = time.perf_counter()
        detector.detect(decoder.decode(coder.encode(frame).data))
        took.append((time.perf_counter() - began) * 1e3)
    return float(np.percentile(took[5:], 95))


def _p95_ms(cores: tuple[int | None, int | None]) -> float:
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        summary, record = Path(folder) / "ground.json", Path(folder) / "bench.rrd"
        with (
            running(
                "hvt_ground.cli", "--listen", endpoint, "--once", "--quiet", "--detector", nano(),
                "--record", record, "--summary", summary, core=cores[0],
            ) as ground,
            running(
                "hvt_edge.cli", "--source", clip(), "--connect", endpoint, "--quiet", "--detector", nano(),
                "--method", "M5", "--preset", "veryfast", core=cores[1],
            ) as edge,
        ):  # fmt: skip
            peaks = Peaks([edge, ground])
            peaks.until_ended(edge, patience_s=120)
            peaks.until_ended(ground, patience_s=60)
        return float(json.loads(summary.read_text())["latency_ms"]["p95"])
