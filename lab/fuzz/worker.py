"""One target under atheris, in a process of its own: libFuzzer ends the process when it is done.

    PYTHONPATH=.:tests/support python -m lab.fuzz.worker TARGET --runs N --folder build/fuzz

Leaves ``TARGET.json`` in the folder: inputs so far, memory over time, the slowest input; and the finding, if any.
The input that broke it lies in ``found/``.
"""

import argparse
import contextlib
import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import atheris

_ROOMS = ("common", "edge", "ground", "extras")
FLIES = [one.name for side in _ROOMS for one in (Path(__file__).parents[2] / side).glob("hvt_*")]

with atheris.instrument_imports(include=FLIES):
    from lab.fuzz.contract import Target, checked_seeds
    from lab.fuzz.table import TARGETS

_WARM_UP = 200
"""Inputs in which tables are filled and libraries loaded; memory is judged afterwards."""
_WRITE_EVERY_S = 1.0
_SEED = 5
_FROM_SEED = 0.25
"""So many inputs are made of a seed anew: a decoder in C shows no coverage, and libFuzzer keeps the smallest only."""


@dataclass
class _Progress:
    """The record of the run."""

    target: str
    inputs: int = 0
    seconds: float = 0.0
    """Seconds of processor, as in ``slowest_ms``: the machine may have other work."""
    slowest_ms: float = 0.0
    rss_kb: list[tuple[int, int]] = field(default_factory=list)
    """(inputs so far, resident memory)."""
    broke: str = ""


def _peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class Watched:
    """Runs inputs, measures each, and writes the progress now and then.

    ``peak_kb``: the most memory that the process has had. It rises between two inputs too, for those who make them.
    """

    def __init__(
        self, target: Target, *, runs: int, path: Path, peak_kb: Callable[[], int] = _peak_kb
    ) -> None:
        self._target, self._runs, self._path, self._peak_kb = target, runs, path, peak_kb
        self._progress = _Progress(target.name)
        self._began_s, self._written_s = time.process_time(), time.monotonic()

    def __call__(self, data: bytes) -> None:
        """One input; raises its finding, or MemoryError where it takes too much."""
        progress, began_s = self._progress, time.process_time()
        progress.inputs += 1
        try:
            self._run(data)
        except BaseException as error:
            progress.broke = f"{type(error).__name__}: {error}"[:300]
            self.write()
            raise
        progress.slowest_ms = max(progress.slowest_ms, 1000 * (time.process_time() - began_s))
        if progress.inputs >= self._runs or time.monotonic() - self._written_s > _WRITE_EVERY_S:
            self.write()

    def _run(self, data: bytes) -> None:
        before_kb = self._peak_kb()
        self._target.run(data)
        risen_mb = (self._peak_kb() - before_kb) // 1024
        if self._progress.inputs > _WARM_UP and risen_mb > self._target.most_growth_mb:
            raise MemoryError(f"one input took {risen_mb} MB")

    def write(self) -> None:
        progress = self._progress
        self._written_s = time.monotonic()
        progress.seconds = time.process_time() - self._began_s
        progress.rss_kb.append((progress.inputs, _resident_kb()))
        self._path.write_text(json.dumps(asdict(progress)) + "\n", encoding="utf-8")


def _resident_kb() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


def _prepared(target: Target, folder: Path, seeds: list[bytes]) -> list[str]:
    """The folders of libFuzzer: it stores interesting inputs in the first."""
    corpus, first = folder / "corpus" / target.name, folder / "seeds" / target.name
    for one in (corpus, first, folder / "found"):
        one.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds):
        (first / f"{number:02}").write_bytes(seed)
    return [str(corpus), str(first)]


def main() -> None:
    """Never returns: libFuzzer leaves."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--runs", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=_SEED)
    arguments = parser.parse_args()
    target = TARGETS[arguments.target]
    seeds = checked_seeds(target)
    folders = _prepared(target, arguments.folder, seeds)
    watched = Watched(target, runs=arguments.runs, path=arguments.folder / f"{target.name}.json")

    def mutator(data: bytes, max_size: int, seed: int) -> bytes:
        rng = Random(seed)
        if rng.random() < _FROM_SEED:
            data = rng.choice(seeds)
        changed = target.mutate(data, rng, lambda part: atheris.Mutate(part, max(64, 2 * len(part))))
        return changed[:max_size]

    flags = [
        f"-runs={arguments.runs}",
        f"-seed={arguments.seed}",
        f"-max_len={target.most_bytes}",
        "-timeout=30",
        "-rss_limit_mb=2048",
        "-len_control=0",
        "-print_final_stats=1",
        f"-artifact_prefix={arguments.folder / 'found' / target.name}-",
    ]
    _quieten()
    atheris.Setup([sys.argv[0], *flags, *folders], watched, custom_mutator=mutator)
    atheris.Fuzz()


def _quieten() -> None:
    """OpenCV writes a line for each picture that it cannot decode."""
    with contextlib.suppress(ImportError, AttributeError):
        import cv2

        level: Any = cv2.utils.logging
        level.setLogLevel(level.LOG_LEVEL_SILENT)


if __name__ == "__main__":
    main()
