"""``--profile auto`` looks at the first second of a scene before it flies: real x265, the embedded detector."""

import threading
import time
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from hvt_common.config import load
from hvt_common.units import SECOND_NS
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.source.contract import Source
from hvt_edge.source.opening import open_source
from hvt_edge.wiring import Beginning, make_detector, trial, try_scene

LOCKSTEP = ("--pace", "lockstep", "--size", "640x360", "--preset", "ultrafast")
THIN = (*LOCKSTEP, "--budget", "100kbps")


def settings(source: str, *flags: str) -> EdgeConfig:
    loaded, given = load(EdgeConfig, ["--source", source, *flags], program="hvt-edge", description="")
    return check(with_profile(loaded, given=given.values))


def tried(config: EdgeConfig, source: Source, *, clock=lambda: 0) -> Beginning:
    detector = make_detector(config)
    return try_scene(config, source, detector=detector, clock=clock, stop=threading.Event())


def moving(folder: Path, *, coarse: int = 60, frames: int = 15) -> str:
    """A landscape that moves by three pixels a frame; the coarser its grain, the easier it is to code."""
    rng = np.random.default_rng(1)
    grain = rng.integers(0, 255, (420 // coarse, 720 // coarse, 3), np.uint8)
    ground = cv2.resize(grain, (720, 420), interpolation=cv2.INTER_CUBIC)
    for index in range(frames):
        cv2.imwrite(str(folder / f"{index:03}.png"), ground[30:390, 3 * index : 3 * index + 640])
    return str(folder)


@pytest.mark.parametrize(
    ("coarse", "frames", "flags", "decimation"),
    [
        (60, 15, (), 1),
        (3, 15, (), 3),
        (60, 5, (), 3),  # too short to tell: by the bits for each pixel
        pytest.param(60, 15, ("--fps", "15"), 1, marks=pytest.mark.nightly),
        (3, 15, ("--fps", "15"), 1),
    ],
)
def test_auto_begins_with_the_frame_rate_that_the_scene_needs(tmp_path, coarse, frames, flags, decimation):
    """An easy scene would be shown at half its rate, and a hard one in mud."""
    config = settings(moving(tmp_path, coarse=coarse, frames=frames), *THIN, *flags)
    with open_source(str(tmp_path), size=(640, 360), fps=15) as source:
        beginning = tried(config, source)
        assert beginning.decimation == decimation
        assert beginning.share == (0.9 if decimation > 1 else 0.95)
        first = next(iter(source.steps(start_ns=0)))
        assert first is not None
        assert first.index == 0, "the clip begins anew"


def test_auto_begins_with_what_the_base_hides():
    """Else the first second of a thin flight is without the objects that only the edge sees, and without stills."""
    config = settings("demo", *THIN)
    with open_source("demo", size=(640, 360), fps=15) as source:
        beginning = tried(config, source)
    assert 1.5 < beginning.shadow.comparisons < 3
    assert beginning.shadow.hidden > 0.3 * beginning.shadow.source_p
    assert beginning.share < config.share


@pytest.mark.parametrize("pace", [pytest.param("lockstep", marks=pytest.mark.nightly), "realtime"])
def test_a_scene_without_objects_keeps_the_bits_for_video(tmp_path, monkeypatch, pace):
    """Tracks and stills of nothing would take a tenth of the budget.

    Nothing flies yet, so what a comparison takes of a processor is no reason to leave one out: one tells too little.
    """
    monkeypatch.setattr(time, "thread_time_ns", count(step=SECOND_NS // 5).__next__)
    config = settings(moving(tmp_path), *THIN, "--pace", pace, "--provider", "cpu")
    with open_source(str(tmp_path), size=(640, 360), fps=15) as source:
        beginning = tried(config, source)
    assert beginning.shadow.comparisons > 1.5
    assert beginning.shadow.sure_gain == 0
    assert beginning.share == config.share


def test_no_second_of_a_live_source_is_lost_for_nothing(tmp_path):
    """With `motion` nothing is compared, and a fixed frame rate is not tried either."""
    config = settings(moving(tmp_path, frames=3), *THIN, "--detector", "motion", "--fps", "15")
    with open_source(str(tmp_path), size=(640, 360), fps=15) as source:
        source.steps = lambda **_kind: pytest.fail("a frame was taken")
        assert tried(config, source).decimation == 1


@pytest.mark.parametrize("flags", [("--profile", "thin"), ("--detector", "motion")])
def test_nothing_is_measured_where_nothing_depends_on_it(tmp_path, flags):
    """Nor by a detector that remembers the pictures of one stream: there the settings decide alone."""
    config = settings(moving(tmp_path), *THIN, *flags)
    with open_source(str(tmp_path), size=(640, 360), fps=15) as source:
        assert tried(config, source).shadow.comparisons == 0


@pytest.mark.parametrize(("most_cores", "preset"), [(1e9, "veryfast"), (1e-9, "ultrafast")])
@pytest.mark.parametrize("flags", [("--method", "M0"), ()])
def test_auto_begins_with_the_preset_that_there_is_time_for(
    tmp_path, monkeypatch, caplog, flags, most_cores, preset
):
    """The first second of a flight would lose its frames, and a keyframe would be spent on finding out."""
    monkeypatch.setattr(trial, "share_of", lambda _cores: most_cores)
    config = settings(moving(tmp_path, frames=5), "--size", "320x192", "--detector", "motion", *flags)
    with caplog.at_level("INFO"), open_source(str(tmp_path), size=(320, 192), fps=15) as source:
        beginning = tried(config, source, clock=time.time_ns)
    assert beginning.preset.preset == preset
    assert caplog.messages == ([beginning.preset.says] if preset == "ultrafast" else [])
