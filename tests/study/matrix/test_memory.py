"""What a run holds in memory is a window of frames, not the clip."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from studies.small_study import FRAMES, detector, write_scene

FLY = """
import sys
from pathlib import Path
from hvt_study.runs import execute
from hvt_study.runs.methods import chosen_methods
from hvt_study.matrix.plan import StudyPlan, first_runs, parse_regimes
from hvt_study.runs.spec import ModelChoice

uri, network, cache, frames, width, height = sys.argv[1:]
plan = StudyPlan(
    sequences=((uri, "street"),), methods=chosen_methods("M5"), regimes=parse_regimes("300kbps"),
    still_codecs=("jpeg",), models=(ModelChoice(network, network),), labels="annotations",
    cache=Path(cache), size=(int(width), int(height)), max_frames=int(frames),
)
(spec,) = first_runs(plan)
peaks, score = [], execute._labelled
def note(*flown):  # scoring takes memory by the square of the tracks, and this detector makes some each frame
    status = Path("/proc/self/status").read_text()
    peaks.append(status.partition("VmHWM:")[2].split()[0])  # ru_maxrss would be that of whoever started this process
    return score(*flown)
execute._labelled = note
row = execute.run_spec(spec, cache=plan.cache)
assert not row["failed"], row["failed"]
assert round(row["duration_s"] * 15) == int(frames)
print(*peaks)
"""
LONG = 240
SIZE = (640, 384)


pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not say")


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    """The same two seconds again and again."""
    root = tmp_path_factory.mktemp("scene")
    found = write_scene(root, "street", size=SIZE)
    folder, file = root / "sequences" / "street", root / "annotations" / "street.txt"
    lines = [line.partition(",") for line in file.read_text().splitlines()]
    for again in range(1, LONG // FRAMES):
        for number in range(1, FRAMES + 1):
            os.link(folder / f"{number:07d}.png", folder / f"{number + again * FRAMES:07d}.png")
        with file.open("a") as stream:
            stream.writelines(f"{int(number) + again * FRAMES},{rest}\n" for number, _, rest in lines)
    return found


def peak_mb(uri, cache, frames):
    words = [uri, detector(uri), str(cache), str(frames), *map(str, SIZE)]
    done = subprocess.run([sys.executable, "-c", FLY, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return int(done.stdout) / 1024


@pytest.mark.nightly
def test_a_longer_clip_takes_no_more_memory(uri, tmp_path):
    """A study of long clips would end in the middle of the night for want of memory."""
    short, long = (peak_mb(uri, tmp_path / f"{frames}", frames) for frames in (60, LONG))
    frames_mb = (LONG - 60) * SIZE[0] * SIZE[1] * 3 / 2**20
    assert frames_mb > 110
    assert long - short < frames_mb / 2, f"{short:.0f} MB at 60 frames, {long:.0f} MB at {LONG}"
