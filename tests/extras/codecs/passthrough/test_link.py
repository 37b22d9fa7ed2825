"""A camera's own units over a link that goes, thins out and comes back: the real pacer, rates and budget."""

import pytest

from hvt_common.values import CameraUnit
from rigs.live_flight import LiveFlight, SteppedLink

FPS = 25
BUDGET_BPS = 800_000
GOOD_BPS = 10_000_000


def camera(
    seconds: float, *, key_bytes: int, every_s: float = 2.0, rest_bytes: int = 1200
) -> list[CameraUnit]:
    """Units of a camera at 25 fps."""
    every = round(every_s * FPS)
    sizes = [rest_bytes if index % every else key_bytes for index in range(round(seconds * FPS))]
    return [CameraUnit(b"\1" * size, keyframe=not index % every) for index, size in enumerate(sizes)]


def flown(
    steps: list[tuple[float, int]], units: list[CameraUnit], *, surveyed: list[CameraUnit], **more
) -> tuple[LiveFlight, list[int]]:
    """The flight, and how many frames that were taken in each second the ground could show."""
    given = {"source": "camera.mp4", "encoder": "passthrough", "fps": FPS, "budget": BUDGET_BPS}
    given |= {"method": "M0", "track_bytes": 0, "pose_bytes": 0}
    seconds = len(units) // FPS
    link = SteppedLink(steps, loses=True)
    flight = LiveFlight(link, camera=units, surveyed=surveyed, **given | more).fly(seconds)
    taken = [int(second + 1e-6) for _, second in flight.ground.shown]
    return flight, [taken.count(second) for second in range(seconds - 1)]  # the last ones are under way


@pytest.mark.parametrize("share", [1.0, pytest.param(0.85, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("every_s", [1.0, pytest.param(2.0, marks=pytest.mark.nightly), 4.0])
@pytest.mark.parametrize(
    ("surveyed_bytes", "key_bytes"), [(15_000, 15_000), (15_000, 45_000), (8_000, 70_000)]
)
def test_a_link_that_was_away_for_a_moment_does_not_end_the_video(surveyed_bytes, key_bytes, every_s, share):
    """Four seconds without a link would be the end of the video, also where the scene costs more than before."""
    surveyed = camera(8, key_bytes=surveyed_bytes, every_s=every_s)
    more = {} if share == 1.0 else {"method": "M5", "video_share": share}
    units = camera(33, key_bytes=key_bytes, every_s=every_s)
    flight, got = flown([(0, GOOD_BPS), (10, 0), (14, GOOD_BPS)], units, surveyed=surveyed, **more)
    assert got[10:13] == [0, 0, 0], "the link was away"
    assert got[20:] == [FPS] * 12, "the third keyframe behind it at the latest goes on"
    assert flight.ledger.worst_window_bps.total <= BUDGET_BPS


@pytest.mark.parametrize("key_bytes", [20_000, 50_000])
def test_a_link_that_carries_less_than_the_camera_makes_gets_no_queue(key_bytes):
    """The picture would be a minute old, and the older the longer the link stays thin."""
    units = camera(61, key_bytes=key_bytes, every_s=1.0)
    flight, got = flown([(0, GOOD_BPS), (10, 100_000), (50, GOOD_BPS)], units, surveyed=units[: 8 * FPS])
    assert max(flight.delays_between(0, 60)) < 12
    assert all(sum(got[second : second + 14]) for second in range(10, 46)), "something is shown"
    assert got[-6:] == [FPS] * 6
    assert flight.ledger.worst_window_bps.total <= BUDGET_BPS


@pytest.mark.parametrize("adapt", [True, False])
def test_a_budget_that_was_lowered_too_far_can_be_raised_again(adapt):
    """One wrong number from a ground would end the video: the edge would never look at another."""
    units = camera(31, key_bytes=15_000)
    commands = [(4.99, 60_000), (14.99, BUDGET_BPS)]
    flight, got = flown([(0, GOOD_BPS)], units, surveyed=units[: 8 * FPS], adapt=adapt, commands=commands)
    assert got[8:15] == [0] * 7, "no window of 60 kbps holds its keyframes"
    assert got[:5] == [FPS] * 5
    assert got[18:] == [FPS] * 12
    assert flight.transmitter.budget.total_bps > 300_000


def test_without_reports_all_goes_out():
    """Somebody who only listens would get a keyframe now and then."""
    units = camera(20, key_bytes=15_000)
    _, got = flown([(0, GOOD_BPS)], units, surveyed=units[: 8 * FPS], late_s=lambda _second: None)
    assert sum(got) > 8 * FPS
    assert got[-6:] == [FPS] * 6
