"""When metadata is said, and at which time of the stream."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.units import SECOND_NS
from hvt_gateways.transport_stream.moments import Moment, Moments, Timeline
from hvt_ground.events import Overlay

STEP_NS = SECOND_NS // 15


def tracks(frame: int) -> Overlay:
    none = np.empty(0, np.int64)
    return Overlay(
        frame, frame * STEP_NS, none, np.empty((0, 4), np.float32), (), (), none.astype(np.float32), none > 0
    )


def fed(moments: Moments, *steps: str) -> list[str]:
    """``p3`` is the picture of frame 3, ``t3`` its tracks; what is given out, with ``+`` where it has tracks."""
    given_out: list[Moment] = []
    for step in steps:
        frame = int(step[1:])
        if step[0] == "p":
            given_out += moments.picture(frame, frame * STEP_NS, at=frame)
        else:
            given_out += moments.tracks(tracks(frame), at=frame)
    return [f"{one.frame_index}{'+' if one.overlay else ''}" for one in given_out]


@pytest.mark.parametrize(
    ("steps", "given_out"),
    [
        ("p0 t0 p1 t1", "0+ 1+"),
        ("p0 p1 t0 p2 t1 t2", "0+ 1+ 2+"),  # perception lags
        ("p0 p1 p2 t2", "0 1 2+"),  # it passed over two
        ("p0 t0 t1 p2 t2", "0+ 1+ 2+"),  # the base stream left out frame 1
        ("p0 t0 t1 t2 p2", "0+ 1+ 2+"),  # the edge's tracks were faster than its picture
        ("p0 t0 t1", "0+"),  # whether there is a picture nobody knows yet
        ("p0 p17", "0"),  # no tracks for more than a second
        ("p0 p17 t0 t17", "0 17+"),  # they came too late
        ("t0 t17 p0", "0+"),
    ],
)
def test_each_frame_is_said_once_with_its_tracks_where_they_come(steps, given_out):
    """Boxes would be missing, or stand in the wrong picture."""
    assert fed(Moments(), *steps.split()) == given_out.split()


def test_at_the_end_nothing_is_kept_back():
    """The last second would have no metadata."""
    moments = Moments()
    assert fed(moments, "p0", "p1", "t1", "t2") == ["0", "1+"]
    assert [one.frame_index for one in moments.rest()] == [2]
    assert moments.rest() == []


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 1 << 62), st.integers(-(1 << 63), 1 << 63))))
def test_whatever_comes_memory_is_bounded(steps):
    """Frame numbers and times come from the wire."""
    moments = Moments()
    for pictured, frame, capture_ns in steps:
        if pictured:
            moments.picture(frame, capture_ns, at=0)
        else:
            moments.tracks(tracks(frame), at=0)
    assert len(moments.rest()) <= 64


def test_frames_that_are_never_complete_do_not_pile_up():
    """A hostile edge whose clock stands still would fill the memory."""
    moments = Moments()
    given_out = sum(len(moments.picture(frame, 0, at=0)) for frame in range(1_000))
    assert given_out + len(moments.rest()) == 1_000
    assert given_out >= 1_000 - 64


def test_times_are_capture_times_from_the_first_picture():
    """A player would run too fast or too slow."""
    line = Timeline(fps=15)
    assert not line.begun
    start_ns = 1_790_000_000 * SECOND_NS
    assert [line.picture(start_ns + one) for one in (0, STEP_NS, 30 * SECOND_NS)] == [0, 6_000, 2_700_000]
    assert line.of(start_ns + SECOND_NS) == 90_000


def test_a_clock_that_is_set_does_not_stop_the_stream():
    """Players wait for hours, or throw away all that is older than what they have."""
    line = Timeline(fps=15)
    at = [
        line.picture(one)
        for one in (0, STEP_NS, -SECOND_NS, STEP_NS - SECOND_NS, 1 << 62, (1 << 62) + STEP_NS)
    ]
    assert at == pytest.approx([0, 6_000, 12_000, 18_000, 24_000, 30_000], abs=2)
    assert line.of(1 << 62) == pytest.approx(24_000, abs=2), "metadata is on the same clock"


@given(st.lists(st.integers(-(1 << 63), 1 << 63), min_size=1))
def test_times_of_pictures_grow(times):
    """A muxer refuses one that does not, and would be made anew each time."""
    line = Timeline(fps=15)
    at = [line.picture(one) for one in times]
    assert all(earlier < later for earlier, later in pairwise(at))


def test_metadata_neither_goes_back_nor_far_ahead():
    """The muxer refuses the first; a receiver would wait for the second."""
    line = Timeline(fps=15)
    line.picture(0)
    order = [line.metadata(one) for one in (0, 0, 6_000, 3_000, 90_000 * 11, 12_000)]
    assert order == [True, False, True, False, False, True]
