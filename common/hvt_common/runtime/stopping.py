"""How a program is told to end: Ctrl-C, a service manager, a terminal that closes."""

from __future__ import annotations

import signal
import threading

__all__ = ["STOP_SIGNALS", "stop_on_signals"]

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def stop_on_signals() -> threading.Event:
    """Return an event that these signals set from now on, so that the run ends with its summary and files whole.

    ``nohup`` has SIGHUP ignored, and so it stays.
    """
    stop = threading.Event()
    for one in STOP_SIGNALS:
        if one is not signal.SIGHUP or signal.getsignal(one) is not signal.SIG_IGN:
            signal.signal(one, lambda *_: stop.set())
    return stop
