"""Whether a camera fits the budget, from what was seen of it: real clips, and drawn sizes for the window."""

from __future__ import annotations

from itertools import accumulate

import pytest

from hvt_common.errors import UserError
from hvt_common.units import SECOND_NS, bitrate_text
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.operating import base_rate_bps
from hvt_edge.source.contract import CameraStream, SeenUnit
from hvt_edge.source.opening import open_source
from hvt_edge.video.encoders.passthrough import (
    FullestWindow,
    LeastLink,
    about_keyframes,
    check_camera,
    measure_camera,
    needed_bps,
)
from hvt_edge.video.encoders.qualification import allowed, line_bytes
from media.clips import hard_pictures
from media.hevc_camera import SIZE, write_clip

WHOLE = {"window_s": 1.0, "edge_id": "edge-1"}


def stream_of(sizes: list[int], gaps_s: list[float], keyframes: set[int]) -> CameraStream:
    """A camera that sends units of these sizes at these distances."""
    times = accumulate(gaps_s[: len(sizes) - 1], initial=0.0)
    units = (
        SeenUnit(at_s, size, index in keyframes)
        for index, (at_s, size) in enumerate(zip(times, sizes, strict=True))
    )
    return CameraStream(tuple(units), fps=15.0)


def test_the_fullest_window_is_any_window_by_the_cameras_times():
    """A camera that bunches its frames would be taken for one that does not."""
    sizes = [5000, *[100] * 9, 5000, *[100] * 9]
    key, other = (line_bytes(size, "edge-1") for size in (5000, 100))
    even = measure_camera(stream_of(sizes, [0.25] * 20, {0, 10}), **WHOLE)
    assert even.window_bytes == key + 3 * other
    assert even.keyframe_bytes == key
    bunched = measure_camera(stream_of(sizes, [0.25] * 5 + [0.01] * 14, {0, 10}), **WHOLE)
    assert bunched.window_bytes == key + 17 * other, "all but the first two"


def test_a_camera_that_takes_too_much_is_refused_with_its_figure(tmp_path):
    """Most of its pictures would be left out, and nobody say why."""
    clip = write_clip(tmp_path / "a.mp4", hard_pictures(45, size=SIZE), more="qp=30")
    with open_source(str(clip), size=SIZE, fps=15, coded=True) as source:
        stream = source.camera_stream
        takes_bps = 8 * measure_camera(stream, **WHOLE).window_bytes
        for budget_bps, fits in ((round(1.01 * takes_bps), True), (round(0.99 * takes_bps), False)):
            limit = allowed(size=SIZE, fps=15, total_bps=budget_bps, base_bps=budget_bps, window_s=1.0)
            if fits:
                said = check_camera("cam", stream, limit, budget_bps=budget_bps, edge_id="edge-1")
                assert said.startswith("source cam is passed through: 15 fps, ")
                continue
            with pytest.raises(UserError) as caught:
                check_camera("cam", stream, limit, budget_bps=budget_bps, edge_id="edge-1")
            said = str(caught.value)
            assert said.startswith(f"source cam makes {bitrate_text(takes_bps)} in its fullest 1 s (")
            assert f"--budget {bitrate_text(budget_bps)} leaves {bitrate_text(budget_bps)} for it" in said
            assert "re-encode it with --encoder x265" in said


def test_a_camera_with_few_keyframes_is_told_of():
    """A ground that joins would wait for a picture, and the operator for an explanation."""
    rare = stream_of([100] * 60, [0.1] * 60, {0})
    assert "goes 6 s without a keyframe" in about_keyframes("cam", rare)
    assert about_keyframes("cam", stream_of([100] * 60, [0.1] * 60, {0, 20, 40})) == ""


# What a camera needs, and whether a thin link is free: by hand, and against the budget itself.


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
