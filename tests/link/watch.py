"""Samples memory, descriptors and threads of running processes."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
import psutil

__all__ = ["Sample", "Watch", "slope_mb_per_hour"]

_EVERY_S = 0.25
_MOST_SAMPLES = 20_000
_WARM_UP = 0.4
"""Share of the run that the slope leaves out."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One process at one moment."""

    at_s: float
    """Unix time."""
    resident_mb: float
    descriptors: int
    threads: int


class Watch:
    """A context manager; `samples` by the name of the process, at most 20 000 each (every second one is dropped)."""

    def __init__(self, pids: Mapping[str, int]) -> None:
        self.samples: dict[str, list[Sample]] = {name: [] for name in pids}
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self._every_s = _EVERY_S
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="link-watch")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
    """Of resident memory after the warm-up, by least squares; None of too few samples."""
    late = samples[int(_WARM_UP * len(samples)) :]
    if len(late) < 8:
        return None
    at_h = np.array([sample.at_s - late[0].at_s for sample in late]) / 3600
    return float(np.polyfit(at_h, [sample.resident_mb for sample in late], 1)[0])
