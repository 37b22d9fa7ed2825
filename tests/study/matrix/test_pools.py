"""The processes of a study."""

import subprocess
import sys

PROGRAM = """
import multiprocessing, os, signal, threading
from contextlib import suppress

from hvt_common.errors import UserError
from hvt_study.matrix.pools import local_pool


def interrupt():
    os.killpg(0, signal.SIGINT)
    signal.pause()


if __name__ == "__main__":
    with local_pool(1) as pool:
        done = pool.submit(os.getpid)
        (child,) = multiprocessing.active_children()
        os.kill(child.pid, signal.SIGINT)  # a moment after its start: it is still being imported
        assert done.result(60) == child.pid
        error = pool.submit(threading.Lock).exception(60)
        assert "pickle" in str(error) and not isinstance(error, UserError), error
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
"""


def test_what_ends_a_process_or_fails_in_it_is_told_as_what_it_is(tmp_path):
    """Ctrl-C would give a traceback for each process, and a study without one of them would wait for ever."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")
    asked = [sys.executable, str(program)]
    done = subprocess.run(asked, capture_output=True, text=True, check=False, start_new_session=True)
    assert (done.returncode, done.stderr) == (0, "")
