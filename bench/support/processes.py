"""Edge and ground as processes of their own: pinned where wanted, with their peaks of memory and threads."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@contextlib.contextmanager
def running(module: str, *arguments: object, core: int | None = None) -> Iterator[subprocess.Popen]:
    """``core``: the only one that it may use."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    if core is not None:
        command = ["taskset", "--cpu-list", str(core), *command]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


class Peaks:
    """Most resident memory of each process so far, and its most threads."""

    def __init__(self, processes: Sequence[subprocess.Popen]) -> None:
        self._processes = processes
        self.mb = [0.0] * len(processes)
        self.threads = [0] * len(processes)

    def sample(self) -> None:
        # Not ru_maxrss of a child, which begins with this process's own.
        for index, process in enumerate(self._processes):
            with contextlib.suppress(OSError, TypeError):  # it has ended
                text = Path(f"/proc/{process.pid}/status").read_text(encoding="ascii")
                self.mb[index] = int(re.search(r"VmHWM:\s+(\d+)", text)[1]) / 1024
                threads = int(re.search(r"Threads:\s+(\d+)", text)[1])
                self.threads[index] = max(self.threads[index], threads)

    def until_ended(self, process: subprocess.Popen, *, patience_s: float) -> None:
        until_s = time.monotonic() + patience_s
        while process.poll() is None:
            if time.monotonic() > until_s:
                raise RuntimeError(f"{process.args!r} has not ended within {patience_s:.0f} s")
            self.sample()
            time.sleep(0.1)


def pin_to(cores: set[int]) -> set[int]:
    """Pin this process, and the threads that it starts from now on; return what it could use before."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    return before
