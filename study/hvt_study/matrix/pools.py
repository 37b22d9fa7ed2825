"""Where runs are done: processes of this machine, or the workers of a Dask cluster."""

import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import cv2

from hvt_common.errors import UserError

P = ParamSpec("P")
R = TypeVar("R")

_CONNECT_S = 10
_TALKERS = ("distributed", "distributed.client", "tornado", "tornado.application", "asyncio")
_GOES_ON = "finished runs are kept, and the same command goes on from there"


@contextmanager
def local_pool(jobs: int) -> Iterator[Executor]:
    """So many processes. On an error they end at once: finished runs are in the cache.

    Raises `UserError` where a process was killed.
    """
    # Fresh processes: a fork would share threads and locks of open files and models.
    context = multiprocessing.get_context("spawn")
    pool = _Processes(jobs, mp_context=context, initializer=_prepare)
    try:
        yield pool
    except BaseException as error:
        _end(pool)
        if isinstance(error, BrokenExecutor):
            raise UserError(
                f"a process of the study was killed, perhaps for want of memory (lower --jobs): {_GOES_ON}"
            ) from None
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def dask_pool(address: str) -> Iterator[Executor]:
    """The workers behind a scheduler such as ``tcp://host:8786``; they have to see datasets, models and cache.

    Runs of a worker that is lost go to others. Raises `UserError` where Dask is not installed, no scheduler answers,
    or it or too many workers are lost.
    """
    try:
        from distributed import Client, KilledWorker  # noqa: PLC0415 - an extra
    except ImportError:
        raise UserError("--dask needs Dask: pip install 'hvt[dask]'") from None
    for name in _TALKERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # one sentence is said here
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(
            f"--dask {address}: no scheduler answers ({_first_line(error)}): give the address that dask scheduler "
            "prints, such as tcp://host:8786"
        ) from None
    with client:
        pool = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        try:
            yield pool
        except KilledWorker:
            raise UserError(f"--dask {address}: one run after another lost its worker: {_GOES_ON}") from None
        except (CancelledError, OSError) as error:
            why = _first_line(error) or "it cancelled what was running"
            raise UserError(f"--dask {address}: the scheduler was lost ({why}): {_GOES_ON}") from None
        finally:
            pool.shutdown(wait=False)


class _Processes(ProcessPoolExecutor):
    """Starts its processes deaf to Ctrl-C: one that is still being imported would answer it with a traceback."""

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        # Blocked signals are inherited; here they are only late.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return super().submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare() -> None:
    """Once in each process: one thread, no word of its own when interrupted, and no life after its parent."""
    cv2.setNumThreads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "it was started by one"
    parent.join()
    os._exit(1)


def _end(pool: ProcessPoolExecutor) -> None:
    """Let go of running work; Python 3.14 has `terminate_workers` for it."""
    for process in list((pool._processes or {}).values()):  # noqa: SLF001
        process.terminate()


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0].rstrip(".:")
