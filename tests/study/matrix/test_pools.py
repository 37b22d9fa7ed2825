"""The processes of a study."""

import subprocess
import sys

PROGRAM = """
import multiprocessing, os, signal, time
from multiprocessing.synchronize import SemLock
from hvt_study.matrix.pools import local_pool

SemLock.__init__ = None  # one with a name in the system would stay there after kill -9 of a whole study

if __name__ == "__main__":
    with local_pool(1) as pool:
        done = pool.submit(os.getpid)
        while not (children := multiprocessing.active_children()):
            time.sleep(0.001)
        (child,) = children
        os.kill(child.pid, signal.SIGINT)  # a moment after its start: it is still being imported
        assert done.result(60) == child.pid
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ()), "here it is heard again"
"""


def test_a_process_that_is_being_started_does_not_answer_ctrl_c(tmp_path):
    """Who stops a study in its first second would get a traceback for each process."""
    program = tmp_path / "program.py"
    program.write_text(PROGRAM, encoding="utf-8")
    done = subprocess.run([sys.executable, str(program)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
