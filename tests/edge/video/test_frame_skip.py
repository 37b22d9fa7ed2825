"""Which source frames become frames of the base stream."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_edge.video.rate_model import PROMPT, FrameSkip, MeasuredFrameSkip


def coded(frame_skip: FrameSkip, frames, *, keyframes=(), qp=40.0) -> list[int]:
    """The frames that are coded; at keyframes the decimation may change."""
    taken = []
    for index in frames:
        keyframe = index in keyframes
        if keyframe:
            frame_skip.at_keyframe(index)
        if keyframe or frame_skip.codes(index):
            frame_skip.coded(index, keyframe=keyframe, mean_qp=qp(index) if callable(qp) else qp)
            taken.append(index)
    return taken


def test_each_nth_tick_is_coded():
    """The frame rate would be another than the one that was asked for."""
    assert coded(FrameSkip(), range(5)) == [0, 1, 2, 3, 4]
    assert coded(FrameSkip(3), range(10)) == [0, 3, 6, 9]


def test_a_tick_that_was_missed_is_made_up_for_at_once():
    """A machine that drops one frame would show none for twice the time; and the rate must not creep up."""
    assert coded(FrameSkip(3), [0, 1, 2, 4, 5, 6, 7, 8, 9, 17, 18, 19]) == [0, 4, 6, 9, 17, 18]


def test_a_keyframe_may_come_at_any_tick():
    """A ground that joins would wait for the next frame of a slow stream, a second or more."""
    assert coded(FrameSkip(5), range(20), keyframes=(0, 7)) == [0, 5, 7, 12, 17]


@given(decimation=st.integers(1, 20), frames=st.sets(st.integers(0, 300), min_size=1))
def test_the_rate_is_kept_whatever_is_missed(decimation, frames):
    """More frames than asked for would overspend the budget, fewer would show less than it could."""
    taken = coded(FrameSkip(decimation), sorted(frames))
    slots = [(index - taken[0]) // decimation for index in taken]
    assert len(set(slots)) == len(slots), "never two frames for one turn"
    assert set(slots) == {(index - taken[0]) // decimation for index in sorted(frames)}, (
        "never none where there was one"
    )


def measured(decimation: int = 1) -> MeasuredFrameSkip:
    """As at 15 frames a second."""
    return MeasuredFrameSkip(decimation, most_decimation=7, rest_frames=150, window_frames=150)


def test_a_starved_stream_gets_fewer_frames_and_a_rich_one_more():
    """``--fps auto`` would never change anything."""
    starved, rich = measured(), measured(5)
    coded(starved, range(151), keyframes=(0, 150), qp=49.0)
    coded(rich, range(151), keyframes=(0, 150), qp=22.0)
    assert starved.decimation > 1
    assert rich.decimation < 5


def test_it_changes_at_keyframes_and_not_too_often():
    """Grounds that ask for keyframes would make the frame rate flutter, with a new encoder each time."""
    frame_skip = measured()
    coded(frame_skip, range(149), keyframes=(0, 30, 60, 90, 120), qp=50.0)
    assert frame_skip.decimation == 1
    coded(frame_skip, range(149, 160), keyframes=(155,), qp=50.0)
    assert frame_skip.decimation > 1


def test_it_settles():
    """A scene that gives the same quality again and again would be shown at one rate and another in turn."""
    for start in (1, 2, 3, 5):
        for ease in (30.0, 36.0, 40.0, 44.0, 48.0, 52.0):
            frame_skip = measured(start)
            seen = []
            for keyframe in range(0, 3000, 150):
                qp = min(51.0, ease - 3 * math.log2(frame_skip.decimation))  # fewer frames, finer ones
                coded(frame_skip, range(keyframe, keyframe + 150), keyframes=(keyframe,), qp=qp)
                seen.append(frame_skip.decimation)
            assert len(set(seen[8:])) == 1, (start, ease, seen)


def test_keyframes_and_unknown_quantisers_do_not_count():
    """The first, coarse keyframe would decide for ten seconds."""
    frame_skip = measured()
    coded(frame_skip, range(150), keyframes=range(150), qp=51.0)
    assert frame_skip.at_keyframe(150) == 1
    frame_skip = measured()
    coded(frame_skip, range(150), qp=math.nan)
    assert frame_skip.at_keyframe(150) == 1


def prompt(decimation: int) -> MeasuredFrameSkip:
    """As ``--profile auto`` at 15 frames a second."""
    return MeasuredFrameSkip(
        decimation, most_decimation=2, rest_frames=150, window_frames=15, band=PROMPT, own_keyframes=True
    )


@pytest.mark.parametrize(
    ("decimation", "later_qp", "other"), [(2, 26.0, 1), (1, 37.0, 2), (2, 31.0, 2), (1, 31.0, 1)]
)
def test_auto_asks_for_a_keyframe_of_its_own_for_another_rate(decimation, later_qp, other):
    """An easy scene would be shown at half its rate until somebody asks for a keyframe, a minute on a thin link."""
    frame_skip = prompt(decimation)

    def qp(index: int) -> float:  # what is long ago does not count
        return 45.0 if index < 100 else later_qp

    coded(frame_skip, range(149), keyframes=(0,), qp=qp)
    assert not frame_skip.wants_keyframe(148)
    coded(frame_skip, range(149, 152), qp=qp)
    assert frame_skip.wants_keyframe(151) == (other < decimation), "fewer frames wait for one that comes"
    assert frame_skip.at_keyframe(152) == other
    coded(frame_skip, range(152, 290), keyframes=(152,), qp=50.0)
    assert not frame_skip.wants_keyframe(289), "it rests"
    assert not measured(2).wants_keyframe(1000), "--fps auto alone waits for one that comes"
