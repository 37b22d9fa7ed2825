"""What a camera needs, and whether a thin link is free: by hand, and against the budget itself."""

from __future__ import annotations

import pytest

from hvt_common.units import SECOND_NS
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.operating import base_rate_bps
from hvt_edge.video.encoders.passthrough import FullestWindow, LeastLink, needed_bps


@pytest.mark.parametrize("share", [1.0, 0.85, 0.5])
@pytest.mark.parametrize("metadata_bps", [0, 40_000])
def test_what_is_needed_has_room_for_the_fullest_window(share, metadata_bps):
    """A floor that is a little too low is as bad as none: what follows a keyframe would never go out."""
    sizes = [15_000, *[1200] * 24]
    total_bps = needed_bps(sum(sizes), window_s=1.0, share=share, metadata_bps=metadata_bps)
    base_bps = base_rate_bps(total_bps, share, metadata_bps=metadata_bps)
    budget = RollingBudget(BudgetSettings(total_bps, base_bps, fps=25))
    for index, size in enumerate(sizes * 3):
        now_ns = index * SECOND_NS // 25
        assert budget.earliest_ns(size, now_ns=now_ns, base=True) == now_ns
        assert budget.fits(size, now_ns=now_ns)
        budget.record_base(size, now_ns=now_ns)


def test_a_clock_that_is_set_back_makes_no_window_fuller():
    """The camera would be refused for what it does not take."""
    window = FullestWindow(SECOND_NS)
    held = [
        window.add(100, at_ns=at_ns) for at_ns in (0, SECOND_NS // 2, SECOND_NS, -SECOND_NS, -SECOND_NS // 2)
    ]
    assert held == [100, 200, 200, 100, 200]
    assert window.most_bytes == 200


def test_a_link_is_free_when_all_is_reported_or_had_its_time():
    """A queue would grow on a thin link, or a link that has lost something be waited for."""
    unreported = [0]
    least = LeastLink(100_000, unreported_bytes=lambda: unreported[0])
    for number in range(1, 100):  # reports follow some way behind: what they name waits no more
        unreported[0] = min(12_500, number * 1250)
        least.sent(1250, now_ns=number)
    assert not least.is_free(SECOND_NS // 2)
    assert least.is_free(2 * SECOND_NS), "as long as for what is not reported, not for all"
    least.sent(12_500, now_ns=2 * SECOND_NS)
    unreported[0] = 25_000
    assert not least.is_free(2 * SECOND_NS)
    unreported[0] = 0
    assert least.is_free(2 * SECOND_NS)
