"""The set-up of a process: the signals that stop it, its threads' priority, its memory allocator.

Priorities, as Linux's niceness: 0 for moving pictures, 11 for perception with its networks.

Also the messages to systemd.
"""

import atexit
import contextlib
import ctypes
import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import NoReturn, TypeVar

T = TypeVar("T")

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LITTLE, _NICENESS = 5, 11
"""x265 sets its own workers to 10 (threadpool.cpp); far below them a network stands still beside other programs."""
_SWITCH_S = 0.0005
_CHECK_EVERY_S = 0.1
_SECOND_SIGNAL_S = 1.0
_END_WITHIN_S = 9.0
"""Docker, where it is not told otherwise, kills it after 10 s."""
_END_SLOWLY_WITHIN_S = 30.0
"""For a run of which no part hangs: the disk of its files may be slow. Those of deploy/ kill it after 40 s."""
_WORK_WITHIN_S = 20.0

# Parameters of mallopt, glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_THRESHOLD = -3
_M_ARENA_MAX = -8

_ARENAS = 2
_MMAP_THRESHOLD_BYTES = 4 << 20
"""A 1080p frame is mapped on its own and given back at once; a 720p frame is not, which would cost a tenth of the
edge's time."""
_TRIM_THRESHOLD_BYTES = 16 << 20
allocator_set = threading.Event()
"""Set once the allocator is as a program of this project wants it."""


def stop_on_signals() -> threading.Event:
    """Return an event that these signals set from now on, so that the run ends with its summary and files whole.

    A second one ends the process at once, with the code of a shell; not one that comes with the first, as from a
    terminal and ``timeout``, nor a terminal that is closed meanwhile. ``nohup`` has SIGHUP ignored, and so it stays.
    """
    stop = threading.Event()
    began_s = math.inf

    def heed(number: int, _frame: object) -> None:
        nonlocal began_s
        if began_s == math.inf:
            began_s = time.monotonic()
            stop.set()  # once: the first signal may be within it when the second comes
        elif number != signal.SIGHUP and time.monotonic() - began_s > _SECOND_SIGNAL_S:
            os._exit(128 + number)

    for one in STOP_SIGNALS:
        if one is not signal.SIGHUP or signal.getsignal(one) is not signal.SIG_IGN:
            signal.signal(one, heed)
    return stop


def ended_in_time(
    run: Callable[[], T],
    stop: threading.Event,
    *,
    in_hand: Callable[[], frozenset[tuple[str, int]]],
    otherwise: Callable[[], Exception],
) -> T:
    """Run it in a thread, and return its result; raise ``otherwise()`` where something hangs after ``stop`` is set.

    ``in_hand()`` has the turns of parts that have begun and not ended: one that is there 9 s later hangs. The main
    thread is left to signals: one that is in a native library heeds none.
    """
    done = in_thread(run, name="hvt-run", lowered=False)
    while not wait([done], timeout=_CHECK_EVERY_S).done and not stop.is_set():
        pass
    before = in_hand()
    if not wait([done], timeout=_END_WITHIN_S).done and not before & in_hand():
        wait([done], timeout=_END_SLOWLY_WITHIN_S - _END_WITHIN_S)
    if not done.done():
        raise otherwise()
    return done.result()


def joined(*threads: threading.Thread, left: Callable[[], int], within_s: float) -> bool:
    """Wait for their end; False once ``left()``, their items, has not changed for ``within_s``, or after 20 s.

    On a busy machine a thread gets on slowly. One that hangs takes no item any more, even where it polls.
    """
    began_s = moved_s = now_s = time.monotonic()
    before = -1
    while alive := [one for one in threads if one.is_alive()]:
        if (items := left()) != before:
            before, moved_s = items, now_s
        if (until_s := min(moved_s + within_s, began_s + max(within_s, _WORK_WITHIN_S))) <= now_s:
            return False
        alive[0].join(min(until_s - now_s, _CHECK_EVERY_S))
        now_s = time.monotonic()
    return True


def interrupt_on_signals() -> None:
    """Have SIGTERM and SIGHUP end a command as Ctrl-C does: it says so, and leaves nothing half done behind."""

    def interrupt(number: int, _frame: object) -> None:
        raise KeyboardInterrupt(number)

    for one in STOP_SIGNALS:
        if signal.getsignal(one) is signal.SIG_DFL:  # ``nohup`` has SIGHUP ignored
            signal.signal(one, interrupt)


def notify_systemd(state: str) -> None:
    """Send ``READY=1`` or ``WATCHDOG=1`` to systemd, where it started this process with ``Type=notify``.

    The protocol is that of sd_notify(3): one datagram to the socket that ``NOTIFY_SOCKET`` names. A socket that is
    gone or full is no reason to stop: systemd draws its own conclusion.
    """
    name = os.environ.get("NOTIFY_SOCKET", "")
    if not name:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as to:
        to.setblocking(False)  # the loop that says it is alive must not stand still here
        to.sendto(state.encode(), "\0" + name[1:] if name.startswith("@") else name)


def leave(code: int) -> NoReturn:
    """End the process with this exit code, also while a thread is in a native library: a long detection, a dead link.

    As it finalizes, Python ends such a thread where its call returns, through frames of C++ that do not allow it: the
    process would abort after all was done. Nothing is finalized here.
    """
    atexit._run_exitfuncs()  # noqa: SLF001 - `os._exit` leaves them out
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):  # its reader is gone
            stream.flush()
    os._exit(code)


def lower_priority(*, little: bool = False) -> None:
    """Let other threads go before the calling one, and before those that it starts; on Linux only.

    ``little``: it still goes before those that are lowered whole, and before x265's.
    The operator sees encoding and decoding move; detection and stills may come a little later.
    """
    if sys.platform == "linux":
        thread = threading.get_native_id()
        own = os.getpriority(os.PRIO_PROCESS, thread)
        with contextlib.suppress(OSError):  # under ``nice -n 19`` root would raise it
            os.setpriority(os.PRIO_PROCESS, thread, max(own, _LITTLE if little else _NICENESS))


def put_video_first() -> None:
    """Have nothing in this process hold up a frame on its way: not the interpreter, not OpenCV's workers.

    A frame comes back from native code a dozen times, and waits each time for threads that track or read messages:
    half a millisecond at most from now on, instead of five. OpenCV works in the thread that calls it; its own workers
    would have the priority of its first caller.
    """
    import cv2  # noqa: PLC0415 - programs that handle no picture set themselves up here too

    sys.setswitchinterval(_SWITCH_S)
    cv2.setNumThreads(1)


def in_thread(call: Callable[[], T], *, name: str, lowered: bool = True) -> Future[T]:
    """Run it in a thread of lower priority; threads that it starts, such as a network's, have that too."""
    done: Future[T] = Future()

    def run() -> None:
        if lowered:
            lower_priority()
        try:
            done.set_result(call())
        except BaseException as error:  # noqa: BLE001 - raised where it is waited for
            done.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return done


def with_lower_priority(call: Callable[[], T], *, stop: threading.Event) -> T | None:
    """Wait for it, `in_thread`.

    None where ``stop`` is set before it is done: a runtime may compile for minutes, and nobody can interrupt it.
    """
    done = in_thread(call, name="hvt-opening")
    while not wait([done], timeout=_CHECK_EVERY_S).done:
        if stop.is_set():
            return None
    return done.result()


def share_zenoh_threads() -> None:
    """Have Zenoh take two threads in place of five: one empties the link's queues, one does all else.

    Who fills a queue may have to wait until it is emptied, so that these two stay apart. Call it before a session is
    opened; a value in the environment wins.
    """
    os.environ.setdefault(
        "ZENOH_RUNTIME", "(rx: (handover: app), net: (handover: app), acc: (handover: app))"
    )


def limit_malloc_arenas() -> None:
    """Have all threads allocate from two arenas, which reuse freed memory for the next frame; only with glibc.

    By default glibc gives each thread an arena of its own (up to eight for each processor) and moves its mmap
    threshold with the sizes freed. A frame that one thread allocates and another frees then leaves a hole that is not
    reused, and the process grows in steps for hours without holding more. Call it before threads are started.

    Where the environment has any ``MALLOC_*``, nothing is changed.
    """
    if sys.platform != "linux" or any(name.startswith("MALLOC_") for name in os.environ):
        return
    with contextlib.suppress(OSError, AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_ARENA_MAX, _ARENAS)
        mallopt(_M_MMAP_THRESHOLD, _MMAP_THRESHOLD_BYTES)
        mallopt(_M_TRIM_THRESHOLD, _TRIM_THRESHOLD_BYTES)
        allocator_set.set()


def give_back_holes() -> None:
    """Return the free pages between pictures to the system, which takes a millisecond.

    Called once a second, it keeps a flight's peak near the memory in use. It acts only after `limit_malloc_arenas`:
    in a program that only imports us it would walk through all memory each second.
    """
    if allocator_set.is_set():
        ctypes.CDLL(None).malloc_trim(0)
