"""R0: the tracks get more bits than the rest of the picture."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hvt_common.values import Tracks
from hvt_edge.video.x265 import MOST_REGIONS, Region, TrackRegions
from rigs.examples import tracks_of

SIZE = (640, 360)


def tracks(*boxes, confidences=None) -> Tracks:
    """Tracks at these boxes."""
    return tracks_of(0, boxes, confidences=0.5 if confidences is None else confidences)


def test_tracks_are_quantised_finer():
    """R0 would be M0 under another name."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0)
    assert plan.regions(tracks((33, 20, 60, 40))) == [Region((32, 16, 64, 48), -0.1)]
    assert plan.regions(None) == []
    assert plan.regions(tracks()) == []


def test_a_margin_is_added_and_cut_at_the_rim():
    """The outline of a car would stay in the poor part."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.5)
    assert plan.regions(tracks((600, 340, 639, 359)))[0].box_px == (576, 320, 640, 360)


def test_tracks_that_fill_the_picture_are_quantised_less_fine():
    """Everything would be important: x265 would take the bits from the very same tracks, and lose quality."""
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0, free_share=0.1)
    (one,) = plan.regions(tracks((0, 0, 320, 352)))
    assert -0.03 < one.offset < -0.015
    two = plan.regions(tracks((0, 0, 320, 352), (0, 0, 320, 352)))
    assert [region.offset for region in two] == [one.offset] * 2, "what overlaps covers once"


def test_the_surest_tracks_stay_where_there_are_too_many():
    """The cars would lose their place to what is hardly one."""
    boxes = [
        (16 * (index % 40), 16 * (index // 40), 16 * (index % 40) + 8, 16 * (index // 40) + 8)
        for index in range(200)
    ]
    plan = TrackRegions(SIZE, depth=0.1, padding=0.0)
    regions = plan.regions(tracks(*boxes, confidences=[0.2] * 100 + [0.9] * 100))
    assert len(regions) == MOST_REGIONS
    assert min(region.box_px[1] for region in regions) >= 32


@given(
    boxes=st.lists(st.tuples(*[st.floats(-2000, 4000, width=32) | st.just(float("nan"))] * 4), max_size=30)
)
def test_no_box_of_a_tracker_breaks_a_plan(boxes):
    """A track that leaves the picture, or whose filter ran away, would end the edge."""
    held = tracks(*boxes)
    for region in TrackRegions(SIZE, depth=0.1).regions(held):
        x1, y1, x2, y2 = region.box_px
        assert 0 <= x1 < x2 <= 640
        assert 0 <= y1 < y2 <= 360
        assert -0.1 <= region.offset < 0
