"""The strongest competitor: video alone at its best rate and size, found without flying every pair."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_scene import Scene
from hvt_study.runs.run_context import open_run_context
from hvt_study.runs.spec import ModelChoice, RunSpec
from hvt_study.runs.video_shape import VideoShape, competing_sizes, grid_target, match, search_shape, within

RATES = (15.0, 5.0, 2.0, 1.0)
SIZES = ((640, 360), (960, 540), (1280, 720), (1920, 1080))
NOMINAL = (1280, 720)


@pytest.mark.parametrize(
    ("nominal", "source", "sizes"),
    [
        ((1280, 720), (1920, 1080), [(640, 360), (960, 540), (1280, 720), (1920, 1080)]),
        ((640, 360), (1100, 720), [(640, 360), (824, 540), (1100, 720)]),
        ((640, 360), (640, 360), [(640, 360)]),
        ((360, 240), (360, 240), [(360, 240)]),
        ((1280, 720), (360, 240), [(540, 360), (810, 540), (1280, 720)]),
        ((640, 360), (2000, 1500), [(640, 360), (720, 540), (960, 720), (1440, 1080), (2000, 1500)]),
    ],
)
def test_sizes_go_up_to_the_sources_own(nominal, source, sizes):
    """Video of the source's own size would be missing, or one that invents pixels would be flown."""
    assert list(competing_sizes(nominal, source)) == sizes


def flown(worth):
    """The shapes that are flown where a flight's worth follows from rate and size; None: refused."""
    seen = []

    def fly(shape):
        seen.append(shape)
        found = worth(shape.fps, shape.size or NOMINAL)
        return None if found is None else (found, 0.0)

    search_shape(fly, rates=RATES, sizes=SIZES, nominal=NOMINAL)
    assert len(seen) == len(set(seen))
    return seen


def test_shapes_are_found_without_flying_every_pair():
    """The best shape would be missed, or a study take days."""
    # At 5 frames a second 1280x720 is best; 1920x1080 at 2 is better still.
    seen = flown(lambda fps, size: -abs(fps - (5 if size == NOMINAL else 2)) + size[0] / 1280)
    assert {VideoShape(2.0, (1920, 1080)), VideoShape(5.0, (960, 540))} <= set(seen)
    assert VideoShape(1.0, (1920, 1080)) not in seen, "only neighbours of the best rate"
    # A way that gets worse is left.
    seen = flown(lambda fps, size: -abs(fps - 5) - abs(size[0] - 1280))
    assert {one.size for one in seen} == {None, (960, 540), (1920, 1080)}
    assert len(seen) == len(RATES) + 2 * 3
    # x265 refuses large pictures at thin rates: the search must go on with the others.
    assert flown(lambda _fps, _size: None) == [VideoShape(fps) for fps in RATES]
    seen = flown(lambda fps, size: None if size[0] > 1280 else -abs(fps - 1) - size[0])
    assert {one.size for one in seen} == {None, (640, 360), (960, 540), (1920, 1080)}
    assert {one.fps for one in seen if one.size} == {2.0, 1.0}


totals = st.floats(2e4, 1e7)


@given(target=totals, ratio=st.floats(0.5, 1.3), power=st.floats(0.8, 1.2), seed=st.integers(0, 99))
def test_a_method_that_follows_its_budget_is_matched(target, ratio, power, seed):
    """A comparison at other bits than the hybrid's would say nothing, or lie."""

    def spends(budget):
        wobble = 1 + 0.002 * math.sin(budget * (seed + 1))
        return ratio * 1e6 * (budget / 1e6) ** power * wobble

    found = match(spends, target_bps=target)
    assert within(found.total_bps, target)
    assert found.tries <= 16
    assert found.total_bps == spends(found.budget_bps)


def test_a_curve_of_steps_ends_the_search():
    """x265 may jump from one total to the next: the search would go on for ever, or return the worse side."""
    asked = []

    def spends(budget):
        asked.append(budget)
        return 500_000 if budget < 616_000 else 640_000

    assert match(spends, target_bps=600_000).total_bps == 640_000
    assert len(asked) == len(set(asked)) <= 16
    # One that cannot spend so much is not averaged as if it had spent the same.
    assert match(lambda budget: min(budget, 300_000), target_bps=800_000).total_bps == 300_000


@given(target=totals)
def test_near_totals_share_their_target(target):
    """Two methods that spent the same would be compared with two different flights of video."""
    near = grid_target(target)
    assert abs(near / target - 1) < 0.0051
    assert grid_target(near) == pytest.approx(near)


def test_a_budget_that_is_refused_ends_the_search():
    """A run would be lost because a budget beside the right one cannot be flown, or the search crash."""
    assert match(lambda _: None, target_bps=300_000) is None
    found = match(lambda budget: None if budget < 300_000 else budget * 1.2, target_bps=300_000)
    assert found.tries == 1
    assert found.total_bps == pytest.approx(1.2 * found.budget_bps)


def test_the_reference_sees_no_less_than_the_edge_does(tmp_path):
    """What the edge truly finds in tiles of the source would be called false."""
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    town = np.tile(Scene(0).image(0.0), (1, 2, 1))  # 3840x1080
    cv2.imwrite(str(pictures / "000000.png"), town)
    models = ModelChoice("aerial-nano", "aerial-nano")
    spec = RunSpec(f"clips:{pictures}", "pictures", "M0", "200kbps", 200_000, models, size=(640, 360))
    context = open_run_context(spec, cache=tmp_path / "cache")
    whole = context.detector.detect(town)
    assert len(context.labels[0]) > 1.1 * (whole.confidences >= 0.25).sum() > 0
    assert context.labels[0].boxes_xyxy_px.max() > 1920, "in pixels of the source"
