"""Frames that many threads take and let go do not make the process larger and larger."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is about glibc's heaps")

PROGRAM = """
import threading
import numpy as np, psutil
from hvt_common.runtime.process import limit_malloc_arenas
if {asked}:
    limit_malloc_arenas()
np.ones(1 << 22, np.uint8)  # the first that is freed teaches glibc that frames are common
go_on, kept = threading.Event(), []

def stage(done):
    frames = []
    for _ in range(20):
        frames.append(np.ones(3 << 19, np.uint8))
        kept.append(np.ones(1 << 12, np.uint8))  # what a still, a track or a message leaves
    frames.clear()
    done.set()
    go_on.wait()

threads = []
for _ in range(10):  # one after the other: 30 MB are held at a time
    done = threading.Event()
    threads.append(threading.Thread(target=stage, args=(done,)))
    threads[-1].start()
    done.wait()
print(psutil.Process().memory_info().rss >> 20)
go_on.set()
"""


def resident_mb(*, asked: bool, **more: str) -> int:
    """Of a process in which ten threads have held 30 MB each, in turn."""
    around = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")} | more
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(asked=asked)],
        env=around,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return int(done.stdout)


def test_threads_share_the_room_of_frames():
    """The edge would grow in steps for hours, and its system would end it in the air."""
    few, many = resident_mb(asked=True), resident_mb(asked=False, MALLOC_ARENA_MAX="16")
    assert few < many - 100


def test_who_has_asked_for_another_allocation_keeps_it():
    """An operator who has tuned the allocator would be overruled in silence."""
    assert resident_mb(asked=True, MALLOC_ARENA_MAX="16") > resident_mb(asked=True) + 100
