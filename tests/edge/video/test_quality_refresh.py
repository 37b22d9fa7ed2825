"""Which regions of which frame get more bits."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clips import framed, hard_pictures
from hvt_common.values import Tracks
from hvt_edge.video.quality_refresh import RefreshPlan, RollingRefreshPlan, TrackRegions, combined, grid_cells
from hvt_edge.video.regions import BLOCK_PX, MOST_REGIONS, Region
from hvt_edge.video.x265 import BaseEncoder, EncoderSettings

SIZE = (640, 360)


def tracks(*boxes, confidences=None) -> Tracks:
    """Tracks at these boxes."""
    count = len(boxes)
    return Tracks(
        frame_index=0,
        ids=np.arange(1, count + 1),
        boxes_xyxy_px=np.array(boxes, np.float32).reshape(-1, 4),
        confidences=np.array([0.5] * count if confidences is None else confidences, np.float32),
        class_ids=np.zeros(count, np.int32),
        born_frames=np.zeros(count, np.int64),
        seen_frames=np.zeros(count, np.int64),
        started=np.zeros(count, np.bool_),
    )


def refreshed(plan, ticks, keyframes=()) -> list[int]:
    """The ticks that get a pulse."""
    return [tick for tick in ticks if plan.regions(tick, None, keyframe=tick in keyframes)]


def test_a_whole_frame_comes_once_a_period():
    """``--pulse 1s`` would do nothing, or with each frame."""
    plan = RefreshPlan(SIZE, period_ticks=15, depth=0.3)
    assert refreshed(plan, range(50)) == [15, 30, 45]
    plan = RefreshPlan(SIZE, period_ticks=15, depth=0.3)
    plan.regions(0, None, keyframe=True)
    assert plan.regions(15, None) == [Region((0, 0, 640, 360), -0.3)]


def test_pulses_keep_their_period_where_not_every_tick_is_coded():
    """With ``--fps auto`` the pulses would become rarer and rarer."""
    assert refreshed(RefreshPlan(SIZE, period_ticks=15, depth=0.3), range(0, 80, 4)) == [16, 32, 48, 60, 76]


def test_a_keyframe_takes_the_place_of_a_pulse():
    """Two large frames in a row would wait for each other."""
    plan = RefreshPlan(SIZE, period_ticks=15, depth=0.3)
    assert refreshed(plan, range(60), keyframes=(0, 28, 30)) == [15, 45]


@pytest.mark.parametrize(("columns", "rows"), [(5, 3), (1, 1), (8, 4), (3, 7)])
def test_the_cells_tile_the_picture(columns, rows):
    """A strip of the picture would never be refreshed."""
    cells = grid_cells(SIZE, columns=columns, rows=rows)
    shown = np.zeros((360, 640), int)
    for x1, y1, x2, y2 in cells:
        shown[y1:y2, x1:x2] += 1
        assert (x1 % BLOCK_PX, y1 % BLOCK_PX) == (0, 0)
    assert (shown == 1).all()


@pytest.mark.parametrize(("columns", "rows"), [(5, 3), (1, 1), (8, 4), (2, 1)])
def test_without_tracks_each_cell_has_its_turn(columns, rows):
    """Parts of the picture would stay poor for ever."""
    plan = RollingRefreshPlan(SIZE, columns=columns, rows=rows, depth=0.1)
    boxes = [plan.regions(tick, None)[0].box_px for tick in range(3 * columns * rows)]
    count = columns * rows
    for start in (0, count, 2 * count):
        assert len(set(boxes[start : start + count])) == count
    assert boxes[:count] == boxes[count : 2 * count]


def test_cells_with_tracks_come_more_often_and_first():
    """The bits would go to empty ground as much as to the cars."""
    plan = RollingRefreshPlan(SIZE, columns=4, rows=3, depth=0.1)
    held = tracks((170, 130, 200, 160), (500, 300, 560, 340))
    boxes = [plan.regions(tick, held)[0].box_px for tick in range(120)]
    count = Counter(boxes)
    first, second = (160, 128, 320, 240), (480, 240, 640, 360)
    assert {first, second} == set(boxes[:2])
    others = [count[box] for box in count if box not in (first, second)]
    assert len(others) == 10, "the others have their turn too"
    assert min(count[first], count[second]) > 2 * max(others)


def test_a_keyframe_takes_no_turn():
    """A cell would lose its turn to a frame that is coded whole anyway."""
    plan, other = (RollingRefreshPlan(SIZE, columns=4, rows=3, depth=0.1) for _ in range(2))
    assert plan.regions(0, None, keyframe=True) == []
    assert plan.regions(1, None) == other.regions(0, None)


def test_tracks_are_quantised_finer():
    """R0 would be M0 under another name."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0)
    assert plan.regions(3, tracks((33, 20, 60, 40))) == [Region((32, 16, 64, 48), -0.1)]
    assert plan.regions(3, None) == []
    assert plan.regions(3, tracks()) == []


def test_a_margin_is_added_and_cut_at_the_rim():
    """The outline of a car would stay in the poor part."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.5)
    assert plan.regions(0, tracks((600, 340, 639, 359)))[0].box_px == (576, 320, 640, 360)


def test_tracks_that_fill_the_picture_are_quantised_less_fine():
    """Everything would be important: x265 would take the bits from the very same tracks, and lose quality."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0, free_share=0.1)
    (one,) = plan.regions(0, tracks((0, 0, 320, 352)))
    assert -0.03 < one.offset < -0.015
    two = plan.regions(0, tracks((0, 0, 320, 352), (0, 0, 320, 352)))
    assert [region.offset for region in two] == [one.offset] * 2, "what overlaps covers once"


def test_the_surest_tracks_stay_where_there_are_too_many():
    """The cars would lose their place to what is hardly one."""
    boxes = [
        (16 * (index % 40), 16 * (index // 40), 16 * (index % 40) + 8, 16 * (index // 40) + 8)
        for index in range(200)
    ]
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0)
    regions = plan.regions(0, tracks(*boxes, confidences=[0.2] * 100 + [0.9] * 100))
    assert len(regions) == MOST_REGIONS
    assert min(region.box_px[1] for region in regions) >= 32


def test_plans_add_up():
    """``--pulse`` and ``--roi-depth`` together would be one of them."""
    assert combined(None, None) is None
    refresh = RefreshPlan(SIZE, period_ticks=5, depth=0.3)
    assert combined(None, refresh) is refresh
    both = combined(refresh, TrackRegions(SIZE, depth=0.1))
    assert both is not None
    held = tracks((33, 20, 60, 40))
    assert [len(both.regions(tick, held)) for tick in range(6)] == [1, 1, 1, 1, 1, 2]


@given(
    boxes=st.lists(st.tuples(*[st.floats(-2000, 4000, width=32) | st.just(float("nan"))] * 4), max_size=30)
)
def test_no_box_of_a_tracker_breaks_a_plan(boxes):
    """A track that leaves the picture, or whose filter ran away, would end the edge."""
    held = tracks(*boxes)
    for plan in (
        TrackRegions(SIZE, depth=0.1),
        RollingRefreshPlan(SIZE, columns=4, rows=3, depth=0.1),
        RefreshPlan(SIZE, period_ticks=3, depth=0.1),
    ):
        for region in plan.regions(1, held):
            x1, y1, x2, y2 = region.box_px
            assert 0 <= x1 < x2 <= 640
            assert 0 <= y1 < y2 <= 360
            assert -0.1 <= region.offset < 0


def frame_bytes(plan, *, vbv_s: float) -> list[int]:
    """Sizes of the frames of a pan."""
    encoder = BaseEncoder(
        EncoderSettings(size=SIZE, fps=15, bitrate_bps=200_000, side_data=True, vbv_s=vbv_s)
    )
    return [
        len(encoder.encode(frame, keyframe=not frame.index, regions=plan.regions(frame.index, None)).data)
        for frame in framed(hard_pictures(200, size=SIZE)[:75])
    ]


def test_a_rolling_pulse_keeps_its_frames_small():
    """The point of rolling: the gain without the frame that blocks the link for half a second."""
    whole = frame_bytes(RefreshPlan(SIZE, period_ticks=30, depth=0.15), vbv_s=0.5)
    rolling_refresh = frame_bytes(RollingRefreshPlan(SIZE, columns=8, rows=4, depth=0.1), vbv_s=0.15)
    assert max(rolling_refresh[1:]) < 0.6 * max(whole[1:])
    assert max(whole[1:]) > 5000, "a pulse is a large frame"
    assert sum(rolling_refresh) * 8 / 5 <= 1.06 * 200_000
