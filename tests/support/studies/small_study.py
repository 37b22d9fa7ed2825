"""A real study that takes seconds: coloured squares in VisDrone's layout, and ``hvt-study`` as a process."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hvt_study.report.data.table_file import read_results
from media.onnx_models import colour_detector
from programs.processes import eventually

SIZE = (160, 96)
REGIME = "80kbps"
"""So much that the share that DDS spends of it is still what this picture needs at the least."""
_MAIN = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler);"  # a shell's background job ignores it
    "from hvt_study.cli import main; raise SystemExit(main())"
)
_HELD = """
import os, time
from hvt_study.cache.results import ResultCache
put = ResultCache.put
def put_and_hold(cache, key, result):
    put(cache, key, result)
    if "flights" in cache._folder.parts and len(list(cache._folder.rglob("*.json"))) >= KEPT:
        time.sleep(300)
        os._exit(1)  # of a test that has failed
ResultCache.put = put_and_hold
"""
FRAMES = 30
_CLOCKS = frozenset({"wall_s", "edge_cpu_ms"})
"""Columns that a second flight on another day fills in otherwise."""


def write_scene(root: Path, *names: str, count: int = FRAMES, size: tuple[int, int] = SIZE) -> str:
    """Sequences at 15 images a second, a seed each, and the network that sees what is in them; the URI."""
    for seed, name in enumerate(names):
        _write_sequence(root, name, seed, count, size)
    names_of_colours = {"names": "{0: 'truck', 1: 'bus', 2: 'car'}"}
    colour_detector(root / "red.onnx", "yolox", size=size, metadata=names_of_colours)
    return f"visdrone:{root}?fps=15"


def arguments(uri: str, out: Path, *more: str) -> list[str]:
    """Of ``hvt-study run`` and its like, small."""
    own = "--detector" not in more and Path(detector(uri)).is_file()
    network = ["--detector", detector(uri)] if own else []
    return [uri, "--out", str(out), "--size", f"{SIZE[0]}x{SIZE[1]}", *network, *more]


def detector(uri: str) -> str:
    """The network of `write_scene`."""
    return str(Path(uri.removeprefix("visdrone:").removesuffix("?fps=15")) / "red.onnx")


def study(command: str, *words: str, folder: Path, held: bool = False, **named: Any) -> subprocess.Popen[str]:
    """``hvt-study`` as a process of a group of its own; what it says is in study.out and study.err there."""
    environment = holding(folder, kept=2) if held else dict(os.environ)
    with (folder / "study.out").open("w") as out, (folder / "study.err").open("w") as err:
        return subprocess.Popen(
            [sys.executable, "-c", _MAIN, command, *words],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            text=True,
            start_new_session=True,
            env=environment | {"COLUMNS": "200"},
            **named,
        )


def holding(folder: Path, *, kept: int) -> dict[str, str]:
    """Environment of who stands still once so many flights are kept, for longer than a test may take."""
    (folder / "held").mkdir()
    (folder / "held" / "sitecustomize.py").write_text(_HELD.replace("KEPT", str(kept)))
    return {**os.environ, "PYTHONPATH": str(folder / "held")}


def table(out: Path) -> list[dict[str, Any]]:
    """The rows of a study, without what a clock says."""
    return [_timeless(row) for row in read_results(out / "results.parquet")]


def entries(cache: Path) -> Mapping[Path, tuple[int, bytes]]:
    """All that is remembered: when it was written, and what it is."""
    files = (path for path in sorted(cache.rglob("*")) if path.is_file() and path.suffix != ".lock")
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def flights(cache: Path) -> list[Path]:
    return sorted((cache / "flights").rglob("*.json"))


def said(folder: Path) -> str:
    """Standard error of `study`."""
    return (folder / "study.err").read_text()


def until(process: subprocess.Popen[str], true: Callable[[], object]) -> None:
    eventually(lambda: true() or process.poll() is not None, what="a result is kept")
    assert process.poll() is None, "it ended before"


def _timeless(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in _CLOCKS}


def _write_sequence(root: Path, name: str, seed: int, count: int, size: tuple[int, int]) -> None:
    """Red squares on dark ground, a large one and two small and darker ones: cars, of which stills tell more."""
    folder = root / "sequences" / name
    folder.mkdir(parents=True)
    ground = cv2.resize(np.random.default_rng(seed).integers(20, 70, (12, 20, 3), np.uint8), size)
    lines: list[str] = []
    for index in range(count):
        picture = np.array(ground)
        for number, (side, red, top, speed) in enumerate(
            ((32, 230, 8, 3), (16, 150, 48, 2), (16, 190, 72, -2))
        ):
            left = (20 * number + 5 + speed * index + 9 * seed) % (size[0] - side)
            picture[top : top + side, left : left + side] = (30, 40, red)
            picture[top + 4 : top + side - 4 : 3, left + 4 : left + side - 4] = (30, 40, red // 2 + 60)
            lines.append(f"{index + 1},{number + 1},{left},{top},{side},{side},1,4,0,0")
        assert cv2.imwrite(str(folder / f"{index + 1:07d}.png"), picture)
    (root / "annotations").mkdir(exist_ok=True)
    (root / "annotations" / f"{name}.txt").write_text("\n".join(lines) + "\n")
