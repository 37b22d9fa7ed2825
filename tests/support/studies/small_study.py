"""A real study that takes seconds: the demo scene, small, in VisDrone's layout, and ``hvt-study`` as a process."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_scene import Scene
from hvt_study.report.data.table_file import read_results
from programs.processes import eventually

__all__ = [
    "FRAMES",
    "PATIENT_S",
    "SIZE",
    "arguments",
    "entries",
    "flights",
    "said",
    "study",
    "table",
    "until",
    "write_scene",
]

PATIENT_S = 200.0
"""How long a study may take on a busy machine."""
SIZE = (480, 270)
_MAIN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"  # a shell's background job ignores it
    "from hvt_study.cli import main; raise SystemExit(main())"
)
FRAMES = 30
_CATEGORIES = {"car": 4, "van": 5, "truck": 6, "bus": 9, "motor": 10, "pedestrian": 1}
_CLOCKS = frozenset({"wall_s", "edge_cpu_ms"})
"""Columns that a second flight on another day fills in otherwise."""


def write_scene(root: Path, *names: str, count: int = FRAMES) -> str:
    """Sequences of the demo scene at 15 images a second, a seed each; the URI."""
    for seed, name in enumerate(names):
        _write_sequence(root, name, Scene(seed), count)
    return f"visdrone:{root}?fps=15"


def arguments(uri: str, out: Path, *more: str) -> list[str]:
    """Of ``hvt-study run`` and its like, small."""
    return [uri, "--out", str(out), "--size", f"{SIZE[0]}x{SIZE[1]}", *more]


def study(command: str, *words: str, folder: Path, **named: Any) -> subprocess.Popen[str]:
    """``hvt-study`` as a process of a group of its own; what it says is in study.out and study.err there."""
    with (folder / "study.out").open("w") as out, (folder / "study.err").open("w") as err:
        return subprocess.Popen(
            [sys.executable, "-c", _MAIN, command, *words],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            text=True,
            start_new_session=True,
            env={**os.environ, "COLUMNS": "200"},
            **named,
        )


def table(out: Path) -> list[dict[str, Any]]:
    """The rows of a study, without what a clock says."""
    return [_timeless(row) for row in read_results(out / "results.parquet")]


def entries(cache: Path) -> Mapping[Path, tuple[int, bytes]]:
    """All that is remembered: when it was written, and what it is."""
    files = (path for path in sorted(cache.rglob("*")) if path.is_file() and path.suffix != ".lock")
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def flights(cache: Path) -> list[Path]:
    """Results of flights, and of weighings, that are remembered."""
    return sorted((cache / "flights").rglob("*.json"))


def said(folder: Path) -> str:
    """Standard error of `study`."""
    return (folder / "study.err").read_text()


def until(process: subprocess.Popen[str], true: Callable[[], object]) -> None:
    """Wait for something that happens while the process runs."""
    eventually(lambda: true() or process.poll() is not None, within_s=PATIENT_S, what="a result is kept")
    assert process.poll() is None, "it ended before"


def _timeless(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in _CLOCKS}


def _write_sequence(root: Path, name: str, scene: Scene, count: int) -> None:
    folder = root / "sequences" / name
    folder.mkdir(parents=True)
    lines: list[str] = []
    for index in range(count):
        picture = scene.image(index / 15)
        small = cv2.resize(picture, (640, 360), interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(folder / f"{index + 1:07d}.png"), small)
        lines += _lines(scene, index, scale=640 / picture.shape[1])
    (root / "annotations").mkdir(exist_ok=True)
    (root / "annotations" / f"{name}.txt").write_text("\n".join(lines) + "\n")


def _lines(scene: Scene, index: int, *, scale: float) -> list[str]:
    """VisDrone's annotations; what is hardly to be seen is an object that does not count."""
    truth = scene.truth(index / 15)
    lines = []
    rows = zip(truth.boxes_source_px * scale, truth.ids, truth.class_ids, truth.visible, strict=True)
    for box, track_id, kind, visible in rows:
        x1, y1, x2, y2 = np.round(box).astype(int).tolist()
        category = _CATEGORIES.get(scene.class_names[kind], 11)
        lines.append(
            f"{index + 1},{track_id},{x1},{y1},{x2 - x1},{y2 - y1},{int(visible >= 0.5)},{category},0,0"
        )
    return lines
