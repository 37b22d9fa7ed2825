"""From a rate to the size and the frame rate of the base stream."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_edge.video.rate_model import better_decimation, choose_base, most_decimation, sizes_of

CAMERA = (1920, 1080)


def chosen(payload_bps, *, source=CAMERA, size=None, fps=None, most_fps=15.0):
    """Size and n."""
    return choose_base(payload_bps, source, size=size, fps=fps, most_fps=most_fps)


def test_what_the_user_sets_stays_as_it_is():
    """``--size`` and ``--fps`` would be ignored."""
    assert chosen(100_000, size=(640, 360), fps=30.0) == ((640, 360), 1)
    assert chosen(100_000, size=(4000, 3000), fps=5.0)[0] == (4000, 3000)
    assert chosen(10_000_000, size=(640, 360)) == ((640, 360), 1)


def test_fewer_bits_mean_fewer_frames():
    """At a thin rate each frame would be mud; at a rich one motion would be lost for nothing."""
    steps = [chosen(kbps * 1000, size=(1280, 720))[1] for kbps in (60, 100, 150, 200, 300, 400, 800, 1400)]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] >= 3
    assert steps[-1] == 1


def test_fewer_bits_never_mean_a_larger_picture():
    """The rate of a better link would buy a worse picture."""
    areas = [
        wide * high for wide, high in (chosen(kbps * 1000)[0] for kbps in (20, 60, 100, 200, 400, 800, 4000))
    ]
    assert areas == sorted(areas)
    assert areas[0] < areas[-1]


@given(
    payload_bps=st.floats(1_000, 50_000_000),
    source=st.tuples(st.integers(64, 8192), st.integers(64, 8192)),
    most_fps=st.floats(0.5, 60),
    fps=st.none() | st.floats(0.5, 60),
)
def test_what_is_chosen_can_be_coded(payload_bps, source, most_fps, fps):
    """The edge would refuse, or distort, what it has chosen itself."""
    (width, height), decimation = choose_base(payload_bps, source, size=None, fps=fps, most_fps=most_fps)
    assert (width % 2, height % 2) == (0, 0)
    assert 64 <= width <= source[0]
    assert 64 <= height <= source[1]
    assert abs(width / height - source[0] / source[1]) < 0.04 * source[0] / source[1]
    assert decimation == 1 or (fps is None and most_fps / decimation >= 2)


def test_the_ladder_keeps_the_source_s_shape():
    """A circle would become an egg, or black bars would be coded."""
    assert sizes_of((1920, 1080)) == [(1280, 720), (960, 540), (640, 360), (480, 270), (320, 180)]
    assert sizes_of((1280, 720))[0] == (1280, 720)
    assert sizes_of((1100, 720))[0] == (1100, 720)
    assert sizes_of((3840, 2160))[0] == (1280, 720)
    assert sizes_of((64, 64)) == [(64, 64)]


def test_a_source_too_small_is_one_sentence():
    """A traceback out of x265."""
    with pytest.raises(UserError, match="the source has 60x40 pixels"):
        sizes_of((60, 40))


def test_the_quantiser_moves_the_rate_the_right_way():
    """A starved scene would get more frames still."""
    assert better_decimation(1, mean_qp=34.0, most_decimation=5) == 2
    assert better_decimation(1, mean_qp=45.0, most_decimation=5) == 3
    assert better_decimation(5, mean_qp=45.0, most_decimation=5) == 5
    assert better_decimation(3, mean_qp=29.0, most_decimation=5) == 3
    assert better_decimation(3, mean_qp=22.0, most_decimation=5) == 2
    assert better_decimation(1, mean_qp=20.0, most_decimation=5) == 1


def test_two_frames_a_second_are_left():
    """A budget's window of a second would be empty, or filled by a single frame."""
    assert [most_decimation(fps) for fps in (15, 30, 4, 1)] == [5, 15, 2, 1]
