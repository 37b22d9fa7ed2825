"""Samples memory, descriptors and threads of running processes."""

import csv
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import psutil

_EVERY_S = 0.25
_MOST_SAMPLES = 20_000
WARM_UP = 0.4
"""Share of the run that the slope leaves out."""
_END = 0.8
_POINTS = 200
_LEAST_SAMPLES = 20


@dataclass(frozen=True, slots=True)
class Sample:
    """One process at one moment."""

    at_s: float
    """Unix time."""
    resident_mb: float
    descriptors: int
    threads: int


class ResourceSampler:
    """A context manager; `samples` by the name of the process, at most 20 000 each (every second one is dropped)."""

    def __init__(self, pids: Mapping[str, int]) -> None:
        self.samples: dict[str, list[Sample]] = {name: [] for name in pids}
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self._every_s = _EVERY_S
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link-watch")

    def save(self, path: Path) -> None:
        with path.open("w", newline="", encoding="ascii") as file:
            table = csv.writer(file)
            table.writerow(("process", "unix_s", "resident_mb", "descriptors", "threads"))
            for name, samples in self.samples.items():
                for one in samples:
                    numbers = (f"{one.at_s:.2f}", f"{one.resident_mb:.2f}", one.descriptors, one.threads)
                    table.writerow((name, *numbers))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stop.set()
        self._thread.join(10)

    def _run(self) -> None:
        while not self._stop.wait(self._every_s):
            for name, process in self._processes.items():
                try:
                    with process.oneshot():
                        sample = Sample(
                            at_s=time.time(),
                            resident_mb=process.memory_info().rss / 2**20,
                            descriptors=process.num_fds(),
                            threads=process.num_threads(),
                        )
                except psutil.Error:
                    continue  # it has ended
                self.samples[name].append(sample)
            if any(len(samples) > _MOST_SAMPLES for samples in self.samples.values()):
                self.samples = {name: samples[::2] for name, samples in self.samples.items()}
                self._every_s *= 2


def slope_mb_per_hour(samples: list[Sample]) -> float | None:
    """Slope of resident memory after the warm-up, by Theil and Sen; None for too few samples.

    The median of the slopes between all pairs of points: memory taken for a moment (a recording that is
    compacted) or once (a library that loads late) does not bend it. Points are medians of equal parts of the time.
    """
    late = samples[int(WARM_UP * len(samples)) :]
    if len(late) < 8:
        return None
    parts = np.array_split(np.array([(one.at_s, one.resident_mb) for one in late]), min(_POINTS, len(late)))
    at_s, resident_mb = np.array([np.median(part, axis=0) for part in parts]).T
    first, second = np.triu_indices(len(parts), k=1)
    slopes = (resident_mb[second] - resident_mb[first]) / (at_s[second] - at_s[first])
    return 3600 * float(np.median(slopes))


def more_at_the_end(samples: list[Sample], of: Callable[[Sample], float]) -> float | None:
    """The growth of a run from warm to its end; None of too few samples.

    Medians of twentieths of the run: the most of those in its first 40 %, and the median of those from 80 % on. So
    a file that is open for a moment counts for nothing, nor do files open for the time of an outage, nor the socket
    that it has taken away: a leak stays.
    """
    if len(samples) < _LEAST_SAMPLES:
        return None
    parts = np.array_split(np.array([of(one) for one in samples]), 20)
    levels = [float(np.median(part)) for part in parts]
    warm, end = int(WARM_UP * len(levels)), int(_END * len(levels))
    return float(np.median(levels[end:-1])) - max(levels[:warm])  # the very last is the ending
