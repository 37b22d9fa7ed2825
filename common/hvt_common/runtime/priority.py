"""Who may wait when the processor is short: seeing, never the base stream."""

from __future__ import annotations

import contextlib
import os
import sys
import threading

__all__ = ["lower_priority"]

_NICENESS = 10


def lower_priority() -> None:
    """Let other threads go before the calling one, and before those that it starts; on Linux only.

    Encoding and decoding are what the operator sees move; detection and stills may come a little later.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
