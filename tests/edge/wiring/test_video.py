"""The size and frame rate of the base stream where nobody gives them, and a camera that is passed through."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.source.opening import open_source
from hvt_edge.wiring import as_the_camera_is, base_size, default_size, tried_decimation
from media.hevc_camera import SIZE, write_clip


@pytest.mark.parametrize(
    ("source", "letterbox", "crop"),
    [
        ((1920, 1080), (1280, 720), (1280, 720)),
        ((3840, 2160), (1280, 720), (1280, 720)),
        ((1366, 768), (1280, 720), (1280, 720)),
        ((1100, 720), (1100, 720), (1100, 618)),
        ((1600, 1200), (960, 720), (1280, 720)),
        ((1080, 1920), (404, 720), (1080, 608)),
        ((360, 240), (360, 240), (360, 202)),
        ((363, 243), (362, 242), (362, 204)),
        ((30, 30), (64, 64), (64, 64)),
    ],
)
def test_no_source_is_enlarged(source, letterbox, crop):
    """Bits would be spent on pixels that nobody has taken, or on black borders."""
    assert default_size(source, fit="letterbox") == letterbox
    assert default_size(source, fit="crop") == crop


@pytest.mark.parametrize(
    ("flags", "size"),
    [((), (360, 240)), (("--size", "1280x720"), (1280, 720)), (("--fit", "crop"), (360, 202))],
)
def test_a_size_that_is_given_holds(flags, size):
    """Who wants a small camera enlarged, as the ground's detector may, must be able to say so."""
    config, _ = load(EdgeConfig, ["--source", "x.mp4", *flags], program="hvt-edge", description="")
    found = base_size(config)
    assert (found((360, 240)) if callable(found) else found) == size


@pytest.mark.parametrize(("coded", "says"), [(True, "--fps is 5"), (False, "no video that is coded already")])
def test_no_refusal_says_the_cameras_password(tmp_path: Path, coded, says):
    """It would stand in a log that everybody reads."""
    config = EdgeConfig(source="rtsp://admin:SECRET@10.0.0.5/s", encoder="passthrough", fps=5.0)
    clip = write_clip(tmp_path / "a.mp4")
    with (
        open_source(str(clip), size=SIZE, fps=15, coded=coded) as source,
        pytest.raises(UserError, match=says) as caught,
    ):
        as_the_camera_is(config, source)
    assert "SECRET" not in str(caught.value)
    assert "10.0.0.5" in str(caught.value)


def moving(folder: Path, *, coarse: int, frames: int) -> Path:
    """A landscape that moves by three pixels a frame; the coarser its grain, the easier it is to code."""
    rng = np.random.default_rng(1)
    grain = rng.integers(0, 255, (420 // coarse, 720 // coarse, 3), np.uint8)
    ground = cv2.resize(grain, (720, 420), interpolation=cv2.INTER_CUBIC)
    for index in range(frames):
        cv2.imwrite(str(folder / f"{index:03}.png"), ground[30:390, 3 * index : 3 * index + 640])
    return folder


@pytest.mark.parametrize(
    ("coarse", "frames", "flags", "decimation"),
    [
        (60, 15, (), 1),
        (3, 15, (), 2),
        (60, 5, (), 2),  # too short to tell: by the bits for each pixel
        (60, 15, ("--fps", "15"), 1),
        (3, 15, ("--fps", "15"), 1),
    ],
)
def test_auto_begins_with_the_frame_rate_that_the_scene_needs(tmp_path, coarse, frames, flags, decimation):
    """An easy scene would be shown at half its rate, and a hard one in mud."""
    words = ["--source", str(moving(tmp_path, coarse=coarse, frames=frames)), "--pace", "lockstep", *flags]
    words += ["--budget", "100kbps", "--size", "640x360", "--preset", "ultrafast"]
    loaded, given = load(EdgeConfig, words, program="hvt-edge", description="")
    config = check(with_profile(loaded, given=given.values))
    with open_source(str(tmp_path), size=(640, 360), fps=15) as source:
        stop = threading.Event()
        assert tried_decimation(config, source, clock=time.time_ns, stop=stop) == decimation
        first = next(iter(source.steps(start_ns=0)))
        assert first is not None
        assert first.index == 0, "the clip begins anew"
