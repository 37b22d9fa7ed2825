"""Runs one of our programs on a machine whose clock is set in mid-flight: once a file ``step`` appears beside it.

``HVT_STEPPED="hvt_ground.cli 3600" python stepped.py [the program's own arguments]``: from then on the wall clock is
so many seconds ahead, as if NTP had come up. The monotonic clock goes on, as on any machine.
"""

import importlib
import os
import sys
import time
from pathlib import Path


def run(module: str, step_s: float) -> int:
    wall_ns, flag = time.time_ns, Path("step").resolve()
    stepped = False

    def now_ns() -> int:
        nonlocal stepped
        stepped = stepped or flag.exists()
        return wall_ns() + (round(step_s * 1e9) if stepped else 0)

    time.time_ns = now_ns
    time.time = lambda: now_ns() / 1e9
    return importlib.import_module(module).main()


if __name__ == "__main__":
    name, seconds = os.environ["HVT_STEPPED"].split()
    sys.exit(run(name, float(seconds)))
