"""The size of the base stream where nobody gives one."""

from __future__ import annotations

import pytest

from hvt_common.config import load
from hvt_edge.config import EdgeConfig
from hvt_edge.wiring import base_size, default_size


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
