"""Where runs are done: processes of this machine, or the workers of a Dask cluster."""

import logging
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from multiprocessing.resource_tracker import ensure_running
from typing import ParamSpec, TypeVar, cast

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

    Raises `UserError` where a process was killed, or cannot be started.
    """
    pool = _Processes(jobs)
    try:
        yield pool
    except BaseException as error:
        pool.end()
        if isinstance(error, BrokenExecutor):
            raise UserError(
                f"a process of the study was killed, perhaps for want of memory (lower --jobs): {_GOES_ON}"
            ) from None
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        pool.close()


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


class _Processes(ThreadPoolExecutor):
    """A process for each thread, which hands it work through a pipe and waits.

    `ProcessPoolExecutor` has semaphores with names in the system, which stay there where all is killed at once.
    """

    def __init__(self, jobs: int) -> None:
        # Fresh processes: a fork would share threads and locks of open files and models.
        self._context = multiprocessing.get_context("spawn")
        self._here = threading.local()
        self._each: list[tuple[BaseProcess, Connection]] = []
        self._ended = False
        super().__init__(jobs)

    def submit(self, fn: Callable[P, R], /, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        return super().submit(self._there, partial(fn, *args, **kwargs))

    def end(self) -> None:
        """Let go of running work."""
        self._ended = True
        for process, _ in list(self._each):
            process.terminate()

    def close(self) -> None:
        """Let idle processes end in peace."""
        for process, pipe in self._each:
            pipe.close()
            process.join()

    def _start(self) -> None:
        ensure_running()  # it unblocks Ctrl-C
        # Blocked signals are inherited: one that is still being imported would answer Ctrl-C with a traceback.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        here, there = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(there,), daemon=True)
        process.start()
        there.close()
        self._here.pipe = here
        self._each.append((process, here))

    def _there(self, work: Callable[[], R]) -> R:
        if not hasattr(self._here, "pipe") and not self._ended:
            try:
                self._start()
            except OSError as error:
                raise UserError(
                    f"a process of the study cannot be started ({error.strerror}; lower --jobs): {_GOES_ON}"
                ) from None
        if self._ended:  # perhaps only now: `end` has terminated all that was started before
            raise BrokenExecutor
        try:
            self._here.pipe.send(work)
            done, found = self._here.pipe.recv()
        except (EOFError, OSError):
            raise BrokenExecutor from None
        if done:
            return cast("R", found)
        raise found


def _serve(pipe: Connection) -> None:
    _prepare()
    with suppress(EOFError):
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _answer(request: bytes) -> bytes:
    try:
        return bytes(ForkingPickler.dumps((True, pickle.loads(request)())))  # noqa: S301 - of our own parent
    except BaseException as error:  # noqa: BLE001 - it is raised in the process that asked
        trace = traceback.format_exc()
        error.add_note(trace)
        with suppress(Exception):  # an error may not survive pickling
            failed = bytes(ForkingPickler.dumps((False, error)))
            pickle.loads(failed)  # noqa: S301 - our own
            if isinstance(error, Exception):  # `SystemExit` would end the study without a word
                return failed
        return bytes(ForkingPickler.dumps((False, RuntimeError(trace))))


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


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0].rstrip(".:")
