"""The demo: what a newcomer sees first."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import pytest

from programs.rrd import Recording

pytestmark = [pytest.mark.nightly, pytest.mark.integration, pytest.mark.timeout(400)]

ROOT = Path(__file__).resolve().parents[2]
EDGES = ("m0", "paper", "auto")


class Row(NamedTuple):
    """A line of the table, as printed."""

    named_f1: float
    class_right: float
    in_stills_alone: int
    kbps: float


class Demo(NamedTuple):
    """What the command left."""

    folder: Path
    rows: dict[str, Row]


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    folder = tmp_path_factory.mktemp("demo")
    command = [sys.executable, str(ROOT / "deploy" / "demo.py"), "--max-frames", "120"]
    done = subprocess.run(
        command,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=380,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    lines = [line.split() for line in done.stdout.splitlines()]
    rows = {
        words[0]: Row(float(words[1]), float(words[3]), int(words[-2]), float(words[-1]))
        for words in lines
        if words and words[0] in EDGES and "of" in words
    }
    assert tuple(rows) == EDGES, done.stdout
    return Demo(folder, rows)


def test_auto_knows_more_than_video_for_the_same_bits(demo):
    """The first figures that a newcomer sees would speak for sending video alone."""
    assert demo.rows["auto"].named_f1 > demo.rows["m0"].named_f1 + 0.05
    assert demo.rows["auto"].class_right > demo.rows["m0"].class_right
    assert all(row.kbps <= 250 for row in demo.rows.values())


def test_stills_show_codes_that_no_video_shows(demo):
    """The pairs below the picture would be of roofs on which nothing can be read."""
    assert demo.rows["m0"].in_stills_alone == 0
    assert demo.rows["auto"].in_stills_alone >= 1


def test_the_picture_and_the_recording_hold_all_three(demo):
    """The newcomer would be shown a blank, or one flight of three."""
    picture = cv2.imread(str(demo.folder / "demo.png"))
    assert picture is not None
    assert picture.shape[1] > 3 * 640
    recording = Recording(demo.folder / "demo.rrd")
    assert recording.blueprints == 1
    for edge in EDGES:
        assert recording.rows(f"/{edge}/base/video", "VideoStream:sample")
        assert recording.rows(f"/{edge}/session", "TextDocument:text")
