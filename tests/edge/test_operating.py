"""What holds in flight, and who reads it."""

from __future__ import annotations

from hvt_edge.operating import LoopClock, Operating, Rates, base_rate_bps


def operating() -> Operating:
    """As at the start."""
    return Operating(budget_bps=400_000, video_share=0.75, base_bps=300_000, method="M5", decimation=1)


def test_a_reader_has_one_moment():
    """Status would tell the budget of now with the rate of before."""
    holder = operating()
    before = holder.now
    holder.command(budget_bps=200_000, video_share=None, method="M6")
    holder.open(Rates(total_bps=150_000, base_bps=100_000, decimation=3), total_bps=150_000)
    assert (before.budget_bps, before.method, before.decimation) == (400_000, "M5", 1)
    now = holder.now
    assert (now.budget_bps, now.video_share, now.method) == (200_000, None, "M6")
    assert (now.total_bps, now.base_bps, now.decimation) == (150_000, 100_000, 3)
    assert now.highest_budget_bps == 400_000, "the summary compares with the most that was allowed"


def test_media_time_and_wall_time():
    """In lockstep a keyframe that a ground requests would come at another frame in each run."""
    wall = [5]
    media, real = LoopClock(lambda: wall[0], lockstep=True), LoopClock(lambda: wall[0], lockstep=False)
    for clock in (media, real):
        clock.advance(77)
    assert (media(), real()) == (77, 5)


def test_tracks_are_left_their_part_of_the_budget():
    """Video at a share of 1 would leave tracks nothing, and exceed the budget with them."""
    assert base_rate_bps(400_000, 0.75, metadata_bps=8_000) == 300_000
    assert base_rate_bps(400_000, 1.0, metadata_bps=8_000) == 392_000
