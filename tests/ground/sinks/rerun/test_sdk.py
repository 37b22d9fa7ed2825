"""A recording that is closed leaves nothing behind in the process."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from hvt_ground.sinks.rerun.rrd_file import open_rrd
from programs import rrd
from programs.processes import eventually


def opened(folder: Path, *numbers: int) -> None:
    """Small recordings, one after the other in one file."""
    for number in numbers:
        rrd.recorded(folder / "flight.rrd", (), session=f"{number:x}")


def run(program: str, *words: str, **env: str) -> str:
    command = [sys.executable, "-c", program, *words]
    return subprocess.run(command, env=os.environ | env, capture_output=True, text=True, check=True).stdout


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
def test_many_recordings_leave_no_threads(tmp_path):
    """A ground that runs for weeks opens one for each session: it would end with thousands of threads."""

    def threads() -> set[str]:
        return {one.name for one in Path("/proc/self/task").iterdir()}

    opened(tmp_path, 0, 1)  # what is shared by all is there now
    before = threads()
    opened(tmp_path, 2, 3, 4, 5)
    eventually(lambda: threads() <= before, what="no thread of the four is left")


def test_recordings_have_the_same_paths(tmp_path):
    """The SDK forgets no path that it has seen: a drone that restarts each minute would cost 22 MB a day."""

    def paths(number: int) -> list[str]:
        opened(tmp_path, number)
        whole = open_rrd(tmp_path / "flight.rrd")
        (screen,) = whole.blueprints()
        return [one.entity_path for one in whole.stream(store=screen)]

    first = paths(0)
    assert any("/visualizers/" in one for one in first)
    assert paths(1) == first


def test_the_sdks_switch_leaves_no_recording_empty(tmp_path):
    """Who has RERUN=off for other programs of the machine flew, and found a file of no bytes."""
    program = """
import os, sys
from hvt_ground.sinks.rerun.sdk import RecordingId, new_recording

recording = new_recording(RecordingId("uav-1", "0"))
assert os.environ["RERUN"] == "off", "it is for a program that uses the library, and its children"
recording.log_file_from_contents("a.txt", b"a")
recording.save(sys.argv[1])
"""
    out = tmp_path / "flight.rrd"
    run(program, str(out), RERUN="off")
    assert out.stat().st_size > 0


def test_recordings_that_begin_and_end_at_once_do_not_stop_the_process(tmp_path):
    """A ground of eight edges hung for ever when they landed together, and no timeout of its own could fire."""
    program = """
import sys, threading
from pathlib import Path
import numpy as np
from hvt_ground.events import Overlay
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings

def fly(number):
    path = Path(sys.argv[1]) / f"{number}.rrd"
    for session in range(3):
        settings = RecorderSettings(
            path=path, edge_id=f"uav-{number}", session=str(session), base_size=(640, 360), fps=15, budget_bps=800_000
        )
        with Recorder(settings) as recorder:
            for index in range(25):
                boxes = np.full((20, 4), index, np.float32) + (0, 0, 9, 9)
                names, ones = ("car",) * 20, np.ones(20, np.float32)
                recorder.log(
                    Overlay(index, index * 10**8, np.arange(20), boxes, names, names, ones, np.zeros(20, bool))
                )

threads = [threading.Thread(target=fly, args=(number,)) for number in range(8)]
for one in threads:
    one.start()
for one in threads:
    one.join()
print("ended")
"""
    assert run(program, str(tmp_path)) == "ended\n"
    assert len(list(tmp_path.glob("*.rrd"))) == 8


@pytest.mark.parametrize("unused", ["pandas", "pyarrow.compute"])
def test_a_recording_does_not_import_what_it_does_not_use(tmp_path, unused):
    """Pandas, where the study is installed too, is 50 MB; Arrow's functions held up a flight's first boxes."""
    if find_spec(unused) is None:
        pytest.skip(f"{unused} is not installed")
    program = f"""
import sys
from pathlib import Path
import numpy as np
from hvt_ground.events import Overlay
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.sdk import leave_out_pandas

leave_out_pandas()
settings = RecorderSettings(Path(sys.argv[1]), "uav-1", "0", base_size=(640, 360), fps=15, budget_bps=800_000)
with Recorder(settings) as recorder:
    one = np.ones(1, np.float32)
    box = np.array([[1, 2, 30, 40]], np.float32)
    recorder.log(Overlay(0, 0, np.arange(1), box, ("car",), ("van",), one, np.ones(1, bool)))
print({unused!r} in sys.modules)
import {unused}  # who wants it has it
"""
    assert run(program, str(tmp_path / "flight.rrd")) == "False\n"
