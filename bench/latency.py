"""Real time on loopback: capture to overlay against encode + decode + detect, and the memory of both processes."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from bench.material import FPS, SIZE, clip, frames, nano
from hvt_common.inference.detect import open_detector
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.video.encoder_settings import encoder_settings
from hvt_edge.video.x265 import BaseEncoder


def rows() -> list[dict[str, object]]:
    floor_ms = _floor_ms()
    latency, memory = _run()
    ratio = latency["p95"] / floor_ms
    return [
        {
            "measure": "loopback, capture to overlay p95 over encode + decode + detect p95",
            "value": ratio,
            "bar": "<= 1.3",
            "holds": ratio <= 1.3,
        },
        {"measure": "that floor, ms", "value": floor_ms, "bar": None, "holds": None},
        {"measure": "edge, peak resident MB", "value": memory["edge"], "bar": None, "holds": None},
        {"measure": "ground, peak resident MB", "value": memory["ground"], "bar": None, "holds": None},
    ]


def _floor_ms() -> float:
    """The 95th percentile of one frame's encode, decode and detector call, one after the other."""
    encoder = BaseEncoder(
        encoder_settings(
            size=SIZE, fps=FPS, preset="veryfast", total_bps=800_000, base_bps=650_000, edge_id="edge-1"
        )
    )
    decoder, detector = BaseDecoder(), open_detector(str(nano()), provider="auto")
    took = []
    for frame in frames(150):
        began = time.perf_counter()
        detector.detect(decoder.decode(encoder.encode(frame).data))
        took.append((time.perf_counter() - began) * 1e3)
    return float(np.percentile(took[5:], 95))


def _run() -> tuple[dict[str, float], dict[str, float]]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with tempfile.TemporaryDirectory() as folder:
        summary = Path(folder) / "ground.json"
        common = [sys.executable, "-m"]
        ground = subprocess.Popen(
            [*common, "hvt_ground.cli", "--listen", endpoint, "--once", "--quiet", "--detector", nano(),
             "--record", Path(folder) / "bench.rrd", "--summary", summary], stdout=subprocess.DEVNULL,
        )  # fmt: skip
        edge = subprocess.Popen(
            [
                *common,
                "hvt_edge.cli",
                "--source",
                clip(),
                "--connect",
                endpoint,
                "--quiet",
                "--detector",
                nano(),
            ],
            stdout=subprocess.DEVNULL,
        )
        memory = _peaks_mb({"edge": edge, "ground": ground})
        return json.loads(summary.read_text())["latency_ms"], memory


def _peaks_mb(processes: dict[str, subprocess.Popen]) -> dict[str, float]:
    """Most resident memory of each until it ends. (A child's ru_maxrss would begin with this process's own.)"""
    peaks = dict.fromkeys(processes, 0.0)
    while any(process.poll() is None for process in processes.values()):
        for name, process in processes.items():
            with contextlib.suppress(psutil.Error):
                peaks[name] = max(peaks[name], psutil.Process(process.pid).memory_info().rss / 2**20)
        time.sleep(0.1)
    return peaks


if __name__ == "__main__":
    for one in rows():
        print(one)
