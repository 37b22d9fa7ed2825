"""The size and frame rate of the base stream where nobody gives them, and a camera that is passed through."""

from __future__ import annotations

from pathlib import Path

import pytest

from hvt_common.config import load
from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check, check_rate, with_profile
from hvt_edge.source.opening import open_source
from hvt_edge.wiring import as_the_camera_is, base_size, default_size
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


def settled(*flags: str) -> EdgeConfig:
    """The settings as a start takes them."""
    config, loaded = load(EdgeConfig, ["--source", "x.mp4", *flags], program="hvt-edge", description="")
    return check(with_profile(config, given=loaded.values))


@pytest.mark.parametrize(
    ("flags", "size"),
    [((), (360, 240)), (("--size", "1280x720"), (1280, 720)), (("--fit", "crop"), (360, 202))],
)
def test_a_size_that_is_given_holds(flags, size):
    """Who wants a small camera enlarged, as the ground's detector may, must be able to say so."""
    found = base_size(settled(*flags))
    assert (found((360, 240)) if callable(found) else found) == size


@pytest.mark.parametrize(
    ("flags", "size"),
    [
        ("--method M0 --fps 2 --budget 40kbps", (1280, 720)),
        ("--method M0 --fps 2 --budget 30kbps", (960, 540)),
        ("--method M0 --fps 2 --budget 13kbps", (320, 180)),
        ("--method M0 --fps 2 --budget 12kbps", (320, 180)),  # and is refused
        ("--profile M0-best --budget 31kbps", (320, 180)),
    ],
)
def test_a_thin_budget_makes_the_picture_smaller_where_nobody_says_how_large_it_is(flags, size):
    """The start would be refused for a size that nobody has asked for."""
    config = settled(*flags.split())
    found = base_size(config)
    assert callable(found)
    assert found((1920, 1080)) == size
    if config.budget_bps > 12_000:
        check_rate(config, size)


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
