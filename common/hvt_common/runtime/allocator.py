"""One place for the frames: a process that runs for weeks keeps the size that it had after some minutes."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys

__all__ = ["limit_malloc_arenas"]

# Numbers of glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8

_HEAPS = 2
_LARGEST_BYTES = 32 << 20
"""Also the largest threshold that glibc takes on 64 bits."""
_KEPT_BYTES = 64 << 20


def limit_malloc_arenas() -> None:
    """Have all threads allocate from two heaps, which keep what is freed for the next frame; only with glibc.

    By itself glibc gives each thread a heap of its own (up to eight for each processor), and its idea of how large is
    large moves with what is freed. A frame that one thread takes and another one lets go leaves its hole where nobody
    looks for it, and the process grows in steps for hours without holding more. To map each frame on its own cures
    that too, and costs the pages of each frame: a sixth of the edge's time. Call it before threads are started.

    What ``MALLOC_*`` in the environment says is left alone.
    """
    if not sys.platform.startswith("linux") or any(name.startswith("MALLOC_") for name in os.environ):
        return
    with contextlib.suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_ARENA_MAX, _HEAPS)
        mallopt(_M_MMAP_THRESHOLD, _LARGEST_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
