"""The ring of source frames: what it keeps, and how far back it goes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.values import Frame
from hvt_edge.perception.frame_ring import FrameRing
from hvt_edge.stills.on_demand import OnDemandRequest, frame_for
from hvt_edge.stills.requested_coding import RefusedError
from media.clips import START_NS
from rigs.flight import tracks_at

SECOND_NS = 1_000_000_000
PICTURE = np.zeros((10, 20, 3), np.uint8)  # 600 bytes, 300 packed


def frame(index: int, *, fps: float = 15.0, picture: np.ndarray = PICTURE) -> Frame:
    return Frame(index, START_NS + round(index * SECOND_NS / fps), picture, picture)


def filled(ring: FrameRing, count: int, *, fps: float = 15.0) -> FrameRing:
    for index in range(count):
        ring.add(frame(index, fps=fps), tracks_at(index, {}))
    return ring


def test_with_room_every_frame_of_the_last_seconds_is_there():
    """An operator who saw something a moment ago would get the frame beside it."""
    ring = filled(FrameRing(max_bytes=300 * 200, max_age_ns=2 * SECOND_NS), 100)
    assert len(ring) == 31
    assert [ring.near_index(index).frame_index for index in (69, 80, 99)] == [69, 80, 99]
    assert ring.reach_s() == pytest.approx(2.0)
    newest_ns = ring.newest().capture_ns
    assert ring.near_time(newest_ns - 2 * SECOND_NS).frame_index == 69
    # The operator would be shown another moment than he asked for, and not know.
    assert ring.near_index(68) is ring.near_index(100) is None
    assert ring.near_time(newest_ns - 3 * SECOND_NS) is None


def test_with_little_memory_it_goes_back_as_far_with_frames_left_out():
    """On a 4K camera "three seconds ago" would be refused, because 250 MB are gone after 0.7 s."""
    ring = filled(FrameRing(max_bytes=300 * 10, max_age_ns=5 * SECOND_NS), 400)
    assert ring.size_bytes <= 3000
    assert ring.reach_s() == pytest.approx(5.0, abs=0.7)
    kept = [
        ring.near_time(START_NS + round(399 / 15 * SECOND_NS) - ago * SECOND_NS) for ago in (0, 1, 2, 3, 4)
    ]
    assert kept[0].frame_index == 399
    for ago, one in enumerate(kept):
        assert one.frame_index == pytest.approx(399 - 15 * ago, abs=5.1)


@settings(max_examples=50)
@given(
    count=st.integers(0, 120),
    max_bytes=st.integers(0, 40_000),
    age_s=st.floats(0.0, 6.0),
    fps=st.sampled_from([1.0, 5.0, 15.0, 29.97]),
)
def test_its_bounds_hold_and_the_newest_is_always_there(count, max_bytes, age_s, fps):
    """A drone would run out of memory in flight, or "now" would be a picture of before."""
    ring = FrameRing(max_bytes=max_bytes, max_age_ns=round(age_s * SECOND_NS))
    for index in range(count):
        ring.add(frame(index, fps=fps), tracks_at(index, {}))
        assert ring.size_bytes == 300 * max(0, len(ring) - 1) <= max_bytes
        assert ring.reach_s() <= age_s + 1e-9
        if max_bytes:
            assert ring.newest().frame_index == index
        else:
            assert ring.newest() is None


def test_the_newest_is_the_sources_own_and_the_tracks_are_those_of_the_frame():
    """A still would show what another loss left of it, or the place where the object was later."""
    ring = FrameRing()
    ring.add(frame(0), tracks_at(0, {7: (1.0, 1.0, 5.0, 5.0)}))
    ring.add(frame(1, picture=PICTURE), tracks_at(1, {7: (2.0, 1.0, 6.0, 5.0)}))
    assert ring.newest().source_bgr is PICTURE
    assert ring.near_index(0).tracks.boxes_xyxy_px.tolist() == [[1, 1, 5, 5]]


@pytest.mark.parametrize(("size", "error"), [((64, 48), 10), ((65, 48), 0)])
def test_a_frame_of_before_is_what_the_camera_saw(size, error):
    """A still of three seconds ago would show other colours, or half the picture."""
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    picture = np.stack([255 * x, 255 * y, 255 * (1 - x)], axis=2).astype(np.uint8)
    ring = FrameRing()
    for index in range(3):
        ring.add(frame(index, picture=picture), tracks_at(index, {}))
    kept = ring.near_index(0)
    assert kept.source_bgr.shape == picture.shape
    assert np.abs(kept.source_bgr.astype(int) - picture).max() <= error
    assert (ring.size_bytes < picture.nbytes * 2) == (error > 0)


def test_now_is_the_newest_frame_from_the_camera_and_a_track_is_where_it_was_analyzed():
    """On a slow machine a closer look at "now" would show what was there seconds ago."""
    ring = FrameRing()
    ring.capture(frame(0))
    assert ring.newest(tracked=False).frame_index == 0
    assert ring.newest() is None
    filled(ring, 10)
    ring.capture(frame(12))
    assert frame_for(OnDemandRequest(), ring).frame_index == 9, "the analyzed one is near: a base to beat"
    ring.capture(frame(60))
    for asked, index in (
        ({}, 60),
        ({"ago_ms": 3000}, 9),
        ({"ago_ms": 500}, 60),
        ({"frame_index": 50}, 60),
        ({"track_id": 1}, 9),
        ({"track_id": 1, "frame_index": 55}, 9),
    ):
        assert frame_for(OnDemandRequest(**asked), ring).frame_index == index
    with pytest.raises(RefusedError, match="frame 61 is yet to come: the newest is 60"):
        frame_for(OnDemandRequest(frame_index=61), ring)


def test_without_a_ring_nothing_is_kept_of_the_newest_frame_either():
    """Whoever wants no pictures kept would have one kept."""
    ring = FrameRing(max_bytes=0)
    ring.capture(frame(0))
    with pytest.raises(RefusedError, match="none is kept"):
        frame_for(OnDemandRequest(), ring)
