"""The processes of a study."""

import subprocess
import sys

PROGRAM = """
import multiprocessing, os, signal, sys, threading, time
from contextlib import suppress
from multiprocessing.process import BaseProcess
from multiprocessing.synchronize import SemLock

from hvt_common.errors import UserError
from hvt_study.matrix.pools import local_pool

SemLock.__init__ = None  # one with a name in the system would stay there after kill -9 of a whole study


class Failed(Exception):
    def __init__(self, what, where):
        super().__init__(f"{what} of {where}")


def fail():
    raise Failed("a", "b")


def leave():
    sys.exit(3)


def interrupt():
    os.killpg(0, signal.SIGINT)
    signal.pause()


def error_of(work, *arguments):
    try:
        return work(*arguments)
    except Exception as error:
        return error


if __name__ == "__main__":
    with local_pool(1) as pool:
        done = pool.submit(os.getpid)
        while not (children := multiprocessing.active_children()):
            time.sleep(0.001)
        (child,) = children
        os.kill(child.pid, signal.SIGINT)  # a moment after its start: it is still being imported
        assert done.result(60) == child.pid
        for work, said in ((fail, "Failed: a of b"), (leave, "SystemExit: 3"), (threading.Lock, "pickle")):
            error = error_of(pool.submit(work).result, 60)
            assert said in str(error) and not isinstance(error, UserError), error
        assert pool.submit(os.getpid).result(60) == child.pid, "an error ends no process"
    with suppress(KeyboardInterrupt), local_pool(1) as pool:
        pool.submit(interrupt).result(60)
    assert not multiprocessing.active_children()
    try:
        with local_pool(1) as pool:
            child = pool.submit(os.getpid).result(60)
            endless = pool.submit(signal.pause)
            os.kill(child, signal.SIGKILL)
            endless.result(60)
    except UserError as error:
        assert "was killed" in str(error), error
    else:
        raise AssertionError
    BaseProcess.start = lambda _: os.open("/", os.O_WRONLY)  # any failure of the system
    try:
        with local_pool(1) as pool:
            pool.submit(os.getpid).result(60)
    except UserError as error:
        assert "cannot be started (Is a directory; lower --jobs)" in str(error), error
    else:
        raise AssertionError
"""


def test_what_ends_a_process_or_fails_in_it_is_told_as_what_it_is(tmp_path):
    """Ctrl-C would give a traceback for each process, and any error that cannot be sent read as want of memory."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")
    asked = [sys.executable, str(program)]
    done = subprocess.run(asked, capture_output=True, text=True, check=False, start_new_session=True)
    assert (done.returncode, done.stderr) == (0, "")
