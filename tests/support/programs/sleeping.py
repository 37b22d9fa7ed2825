"""``sleeping.py SHARE MODULE ARGUMENTS``: runs a module that falls asleep at that share of its calls.

Whatever happens on a busy machine alone, between any two calls of two threads, happens here within minutes.
"""

import random
import runpy
import sys
import threading
import time
from types import FrameType

_LENGTHS_S = (0.01, 0.05, 0.2, 0.5, 0.9)


def main() -> None:
    """The main thread alone stays awake: it starts the others, and reads signals."""
    share, module = float(sys.argv[1]), sys.argv[2]
    del sys.path[0], sys.argv[1:3]

    def sleep(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and "/hvt_" in frame.f_code.co_filename and random.random() < share:
            time.sleep(random.choice(_LENGTHS_S))

    threading.setprofile(sleep)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
