"""Frames that take long to be coded, at frame rates of which few fill a window of the budget."""

from __future__ import annotations

import pytest

from rigs.live_flight import LiveFlight, SteppedLink


@pytest.mark.parametrize("method", ["M0", "M6"])
@pytest.mark.parametrize("budget", [100_000, 300_000])
@pytest.mark.parametrize(("fps", "coding_s"), [(1, 0.3), (2, 0.12), (2, 0.25), (3, 0.2), (5, 0.1)])
def test_nearly_every_frame_is_sent_however_long_it_takes_to_be_coded(fps, budget, method, coding_s):
    """A third of them would find no room in the budget: the frame before the last has not left the window yet."""
    size = (1280, 720) if budget > 100_000 else (640, 360)
    flight = LiveFlight(
        SteppedLink(((0, 1.3 * budget),)),
        coding_s=coding_s,
        track_bytes=0 if method == "M0" else 250,
        fps=fps,
        budget=budget,
        method=method,
        size=size,
        window=max(1, 2 / fps),
    ).fly(20)
    assert len(flight.sent) >= 0.95 * 20 * fps
    assert flight.ledger.worst_window_bps.total <= budget


@pytest.mark.parametrize("method", ["M0", "M6"])
@pytest.mark.parametrize("fps", [2.25, 2.5, 3.7, 5.5])
def test_nearly_every_frame_is_sent_where_a_window_holds_no_whole_number_of_them(fps, method):
    """Three of 2.5 frames a second fall into some windows, which had room for 2.5: a quarter was left out."""
    flight = LiveFlight(
        SteppedLink(((0, 900_000),)),
        track_bytes=0 if method == "M0" else 250,
        fps=fps,
        budget=300_000,
        method=method,
        size=(640, 360),
    ).fly(30)
    assert len(flight.sent) >= 0.99 * 30 * fps
    assert flight.ledger.worst_window_bps.total <= 300_000


@pytest.mark.parametrize("method", ["M0", "M6"])
@pytest.mark.parametrize("budget", [100_000, pytest.param(300_000, marks=pytest.mark.nightly), 800_000])
@pytest.mark.parametrize(
    ("fps", "coding_s"), [pytest.param(5, 0.04, marks=pytest.mark.nightly), (5, 0.1), (10, 0.07)]
)
def test_no_frame_is_left_out_a_second_after_a_keyframe_that_took_long(fps, coding_s, budget, method):
    """A small board would lose one frame in a hundred: a second later each next one waits for one that went late."""
    flight = LiveFlight(
        SteppedLink(((0, 2 * budget),)),
        coding_s=coding_s,
        keyframe_times=5,
        keyframe_s=7,
        track_bytes=0 if method == "M0" else 250,
        fps=fps,
        budget=budget,
        method=method,
        size=(640, 360) if budget > 100_000 else (320, 180),
    ).fly(60)
    assert flight.held == 0
    assert flight.ledger.worst_window_bps.total <= budget
