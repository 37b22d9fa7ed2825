"""Edge and ground as processes of their own: pinned where wanted, with their peaks of memory and threads."""

import contextlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
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
    """Most memory of each process so far, and its most threads.

    ``mb`` is its own: the system has to end it for that. ``resident_mb`` is that with the pages of files, libraries
    mostly, which the system takes back when it is short, and of which a fresh installation shows 65 MB more.
    """

    def __init__(self, processes: Sequence[subprocess.Popen]) -> None:
        self._processes = processes
        self.mb = [0.0] * len(processes)
        self.resident_mb = [0.0] * len(processes)
        self.threads = [0] * len(processes)

    def sample(self) -> None:
        for index, process in enumerate(self._processes):
            with contextlib.suppress(OSError, KeyError):  # it has ended
                self._take(index, Path(f"/proc/{process.pid}/status").read_text(encoding="ascii"))

    def _take(self, index: int, status: str) -> None:
        now = {name: int(value) for name, value in re.findall(r"^(\w+):\s+(\d+)", status, re.MULTILINE)}
        # Not ru_maxrss of a child, which begins with this process's own. Pages of files grow in number alone, so
        # that no short peak between two samples is lost.
        resident_mb, file_mb = now["VmHWM"] / 1024, now["RssFile"] / 1024
        self.resident_mb[index] = resident_mb
        self.mb[index] = max(self.mb[index], resident_mb - file_mb)
        self.threads[index] = max(self.threads[index], now["Threads"])

    def until_ended(self, process: subprocess.Popen, *, patience_s: float) -> None:
        until_s = time.monotonic() + patience_s
        while process.poll() is None:
            if time.monotonic() > until_s:
                raise RuntimeError(f"{process.args!r} has not ended within {patience_s:.0f} s")
            self.sample()
            time.sleep(0.1)


def cpu_s(process: subprocess.Popen) -> float:
    """User and system time so far."""
    words = Path(f"/proc/{process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def pin_to(cores: set[int]) -> set[int]:
    """Pin this process, and the threads that it starts from now on; return the cores that it could use before."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    return before


def ms(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return (time.perf_counter() - start) * 1e3
