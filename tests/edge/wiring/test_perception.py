"""What stills are worth, by how much finer the source is than the base."""

from __future__ import annotations

import pytest

from hvt_common.config import load
from hvt_common.values import View
from hvt_edge.config import EdgeConfig, check, with_profile
from hvt_edge.stills.policy.m6 import ExpectedGain
from hvt_edge.wiring.link import lever_settings
from hvt_edge.wiring.perception import make_method


def settings(*flags: str) -> EdgeConfig:
    loaded, given = load(EdgeConfig, ["--source", "x.mp4", *flags], program="hvt-edge", description="")
    return check(with_profile(loaded, given=given.values))


@pytest.mark.parametrize(
    ("source", "weight", "finer"),
    [
        ((3840, 2160), 5 * 8 / 9, True),
        ((1920, 1080), 5 * 5 / 9, True),
        ((1600, 900), 5 * (1 - 0.64), False),
        ((1280, 720), 0, False),
        ((640, 360), 0, False),
    ],
)
def test_auto_values_pixels_that_the_base_does_not_have(source, weight, finer):
    """Of a 4K camera the operator would get a 720p picture, and no still that shows more."""
    view = View.fitted(source, (1280, 720), fit="letterbox")
    config = settings()
    made = make_method(config, view)
    assert isinstance(made, ExpectedGain)
    assert made.detail_weight == pytest.approx(weight)
    assert lever_settings(config, view).finer == finer


def test_a_method_that_comes_back_has_the_parameters_it_began_with():
    """`set-method M5` and back would fly another M6 than was asked for."""
    view = View.fitted((1280, 720), (1280, 720), fit="letterbox")
    config = settings("--tune", "min_gain=0.07")
    assert make_method(config, view) == make_method(config, view, name="m6")
    assert make_method(config, view, name="M5").name == "M5"


@pytest.mark.parametrize("flags", [("--tune", "detail_weight=0"), ("--method", "M5", "--profile", "auto")])
def test_stills_may_pause_where_nobody_wants_details(flags):
    """They would be sent for ever, for what the method does not value."""
    view = View.fitted((3840, 2160), (1280, 720), fit="letterbox")
    assert not lever_settings(settings(*flags), view).finer


@pytest.mark.parametrize(
    ("flags", "weight"),
    [
        (("--tune", "detail_weight=2"), 2),
        (("--method", "M6"), 0),
        (("--profile", "thin"), 0),
        (("--profile", "auto", "--method", "M5"), None),
    ],
)
def test_what_was_asked_for_holds(flags, weight):
    """A study of M6 would fly another method, or a user's word count for nothing."""
    made = make_method(settings(*flags), View.fitted((3840, 2160), (1280, 720), fit="letterbox"))
    assert getattr(made, "detail_weight", None) == weight
