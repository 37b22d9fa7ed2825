"""Live video comes back: budgets, frame rates, silences and falls of the link, with all that shares the window."""

import random

import pytest

from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check, check_rate
from hvt_edge.video.encoder import keyframe_total_bps
from media.clips import hard_pictures
from rigs.live_flight import LiveFlight, SteppedLink

SIZES = ((1920, 1080), (1280, 720), (640, 360), (320, 180), (96, 64))
BACK_S = 3.0
RATE_BACK_S = 5.0
M0, M6 = {"method": "M0"}, {"method": "M6", "video_share": 0.85}


def needed_bps(config: EdgeConfig, window_s: float) -> int:
    """What holds a keyframe in so long, with status and tracks beside it."""
    size = config.fixed_size
    assert size is not None
    return keyframe_total_bps(
        size, window_s=window_s, metadata_bps=config.metadata_bps, edge_id=config.edge_id
    )


def largest(budget: int, fps: float, **settings) -> dict:
    """Settings with the largest size that this budget carries; `UserError` where there is none."""
    for size in SIZES:
        given = {"budget": budget, "fps": fps, "size": size, "window": max(1.0, 2 / fps), **settings}
        try:
            config = check(EdgeConfig(source="demo", **given))
            check_rate(config, size)
        except UserError:
            continue
        if needed_bps(config, config.window) <= budget:
            return given
    raise UserError("no size")


def flown(flight: LiveFlight, seconds: float) -> LiveFlight:
    """The flight, with its budget kept in each window, and no picture coded that had no room."""
    flight.fly(seconds)
    assert not flight.failures.parts
    assert flight.ledger.worst_window_bps.total <= flight.operating.now.highest_budget_bps
    return flight


@pytest.mark.parametrize("store", [False, True])
@pytest.mark.parametrize("silent_s", [2.5, pytest.param(4, marks=pytest.mark.nightly), 12])
@pytest.mark.parametrize(
    ("budget", "fps"),
    [
        (300_000, 2),
        (1_800_000, 15),
        *(
            pytest.param(*one, marks=pytest.mark.nightly)
            for one in ((600_000, 5), (8_000_000, 30), (400_000, 1))
        ),
    ],
)
def test_live_video_is_back_after_a_silence(tmp_path, budget, fps, silent_s, store):
    """After a hiccup of some seconds no frame would ever be sent again, however good the link is."""
    link = SteppedLink(((0, 1.3 * budget), (12, 0), (12 + silent_s, 1.3 * budget)), loses=store)
    given = largest(budget, fps, **M6)
    flight = flown(LiveFlight(link, store=tmp_path / "store" if store else None, **given), 40 + silent_s)
    assert flight.back_after(12 + silent_s) <= BACK_S
    assert flight.longest_hole(15 + silent_s, 40 + silent_s) <= BACK_S
    # Little is sent at first, and the rate would grow no faster than that shows: for 6 to 9 s.
    back_s = RATE_BACK_S + (budget == 8_000_000)  # up from a hundredth of it
    assert min(bps for second, bps in flight.rates if second > 12 + silent_s + back_s) > 0.9 * budget


@pytest.mark.parametrize(
    ("budget", "fps", "video"), [(300_000, 2, M0), (500_000, 2, M6), (1_800_000, 15, M0)]
)
@pytest.mark.parametrize("loses", [False, True])
def test_where_video_has_the_window_to_itself_it_is_back_without_a_frame_coded_in_vain(
    budget, fps, video, loses
):
    """Four pictures would be coded one after the other at the former rate, and none of them has room."""
    link = SteppedLink(((0, 1.3 * budget), (12, 0), (13.7, 1.3 * budget)), loses=loses)
    given = largest(budget, fps, **video) | {"window": 1}
    flight = flown(LiveFlight(link, track_bytes=0, pose_bytes=0, coding_s=0.05, **given), 24)
    assert flight.back_after(13.7) <= BACK_S


@pytest.mark.parametrize(
    ("budget", "fps", "falls_to"),
    [(800_000, 3, 200_000), (2_000_000, 15, 150_000), (2_000_000, 7.5, 150_000), (8_000_000, 30, 300_000)],
)
def test_live_video_is_back_after_a_fall_of_the_link(budget, fps, falls_to):
    """Behind a hill nothing more would be sent, although the link carries a coarser picture well."""
    given = largest(budget, fps, **M6)
    flight = flown(LiveFlight(SteppedLink(((0, 1.3 * budget), (12, falls_to))), **given), 60)
    known = flight.drained(14)  # what was on its way, and what went before anybody could know
    assert flight.longest_hole(known, 60) <= BACK_S
    assert flight.longest_hole(known + 10, 60) <= 1.5


@pytest.mark.parametrize("lasts_s", [0.4, pytest.param(0.6, marks=pytest.mark.nightly), 0.8])
@pytest.mark.parametrize(
    ("budget", "fps"), [(300_000, 5), (800_000, 15), pytest.param(2_000_000, 30, marks=pytest.mark.nightly)]
)
def test_live_video_is_back_after_all_under_way_was_lost(budget, fps, lasts_s):
    """On UDP each fade of a third of a second took the picture for 1.5 s: the edge waited for what was lost."""
    for second in (12, 12.04, 12.11):
        link = SteppedLink(
            ((0, 1.5 * budget), (6, 0), (6.35, 1.5 * budget), (second, 0), (second + lasts_s, 1.5 * budget)),
            loses=True,
        )
        flight = flown(LiveFlight(link, size=(640, 360), budget=budget, fps=fps), 17)
        assert flight.longest_hole(11, 17) <= lasts_s + 0.65


@pytest.mark.parametrize(
    ("link", "late_s", "most"),
    [
        (((0, 1.3), (6, 0), (6.35, 1.3)), lambda second: 0.6 if second > 10 and second % 3 < 1 else 0.0, 4),
        (((0, 1.3), (6, 0), (6.35, 1.3), (12, 0.13)), lambda _second: 0.0, 30),
    ],
    ids=["late reports", "a queue"],
)
def test_what_is_late_is_not_taken_for_lost_again_and_again(link, late_s, most):
    """After one loss each delay would bring keyframes, for which all else waits."""
    budget = 300_000
    stepped = SteppedLink(tuple((at, share * budget) for at, share in link), loses=True)
    flight = LiveFlight(stepped, size=(640, 360), budget=budget, fps=5, late_s=late_s)
    keyframes: list[float] = []
    done = flight.keyframes.done
    flight.keyframes.done = lambda now_ns: keyframes.append(flight.second) or done(now_ns)
    flown(flight, 40)
    assert sum(second > 10 for second in keyframes) <= most


@pytest.mark.parametrize("window", [5, 60])
@pytest.mark.parametrize(("budget", "fps"), [(300_000, 2), (800_000, 15)])
def test_a_long_window_keeps_live_video_away_no_longer(budget, fps, window):
    """What the link carried before it fell would fill the window for all its seconds at the lower rate."""
    given = largest(budget, fps, **M6) | {"window": window}
    silent = SteppedLink(((0, 1.3 * budget), (12, 0), (16, 1.3 * budget)), loses=True)
    assert flown(LiveFlight(silent, **given), 30).back_after(16) <= BACK_S
    fallen = flown(LiveFlight(SteppedLink(((0, 1.3 * budget), (12, 0.3 * budget))), **given), 30)
    assert fallen.longest_hole(fallen.drained(14), 30) <= BACK_S


@pytest.mark.parametrize(("budget", "fps"), [(2_000_000, 2), (800_000, 3)])
def test_what_is_stored_does_not_stand_before_live_video(tmp_path, budget, fps):
    """With a store the link would come back full of large frames, sent to find out whether it is back."""
    flights = []
    for store in (None, tmp_path / "store"):
        link = SteppedLink(((0, 1.3 * budget), (13, 0), (20, 200_000)))
        given = largest(budget, fps, **M6)
        flights.append(flown(LiveFlight(link, store=store, **given), 60))
    live, stored = (flight.back_after(20) for flight in flights)
    assert stored <= live + BACK_S + budget / fps / 200_000  # and one frame that was on its way


def any_flight(seed: int) -> tuple[dict, dict, list[tuple[float, float]], list[float], float]:
    """Settings, what goes along, the link's steps, when it is back, and the end."""
    chance = random.Random(seed)
    while True:
        budget = round(12_000 * (8_000_000 / 12_000) ** chance.random())
        share = chance.choice([{"video_share": 0.85}, {"video_share": 0.6}, {"method": "M0"}, {}])
        more = {"send_tracks": chance.random() < 0.7, **share}
        if chance.random() < 0.5:
            more["min_budget"] = min(budget, chance.choice([1_000, 50_000, 400_000]))
        try:
            given = largest(budget, chance.choice([1, 2, 3, 5, 7.5, 10, 15, 30]), **more)
        except UserError:
            continue
        break
    link_bps = max(1.3 * budget, 1.1 * needed_bps(check(EdgeConfig(source="demo", **given)), 1.0))
    second, steps, back = 11.0 + chance.random(), [(0.0, link_bps)], []
    for _ in range(chance.randint(1, 4)):
        steps.append((second, 0.0))
        second += chance.choice([0.5, 1.5, 2, 2.5, 3, 4, 6, 12])
        steps.append((second, link_bps))
        back.append(second)
        second += chance.choice([6, 8, 15])
    beside = {
        "track_bytes": 250 if given["send_tracks"] else 0,
        "texture": chance.choice([0.4, 1.0]),
        "joins_s": chance.choice([0.0, 5.0]),
        "seed": seed,
    }
    if chance.random() < 0.5:
        beside["commands"] = [(chance.uniform(8, second), round(0.9 * budget))]
    return given, beside, steps, back, second


@pytest.mark.parametrize("loses", [False, True])
@pytest.mark.parametrize(
    "seeds",
    [
        range(0, 60, 12),
        *(pytest.param(range(first, 60, 12), marks=pytest.mark.nightly) for first in range(1, 12)),
    ],
)
def test_from_every_state_live_video_is_back_within_three_seconds(seeds, loses):
    """Some budget, frame rate and silence would end the video, as some did."""
    for seed in seeds:
        given, beside, steps, back, end = any_flight(seed)
        flight = flown(LiveFlight(SteppedLink(steps, loses=loses), **beside, **given), end)
        # A budget may take longer than a second for a keyframe; then all takes so much longer.
        slow = max(1.0, needed_bps(flight.config, 1.0) / flight.config.budget_bps)
        for second in back:
            held = max(second, flight.drained(second))  # what waited in the link comes first
            assert flight.back_after(second) <= held - second + slow * BACK_S, f"seed {seed}, to {second}"


@pytest.mark.parametrize(("late_s", "share"), [(0.6, 1.0), (1.5, 1.0), (0.0, 0.4)])
def test_reports_that_come_late_or_in_part_do_not_end_the_video(late_s, share):
    """A ground that is badly heard would see the video stop for good."""
    chance, link = random.Random(3), SteppedLink(((0, 500_000), (12, 0), (15, 500_000)))
    late = lambda _second: late_s if chance.random() < share else None  # noqa: E731
    flight = flown(LiveFlight(link, late_s=late, **largest(400_000, 3)), 60)
    assert flight.longest_hole(20 + late_s, 60) <= BACK_S


@pytest.mark.parametrize("late_s", [1.5, 2.5, 5])
def test_reports_that_begin_to_come_late_are_late_and_nothing_is_lost(late_s):
    """Over a satellite from some second on, the rate would stay at its least for the rest of the flight."""
    late = lambda second: late_s if second > 12 else 0  # noqa: E731
    flight = flown(LiveFlight(SteppedLink(((0, 500_000),)), late_s=late, **largest(300_000, 3)), 60)
    assert flight.pacer is not None
    assert flight.pacer.rate_bps == 300_000
    assert flight.longest_hole(12, 60) <= 1.5


@pytest.mark.parametrize(
    ("turns", "real"), [(6, False), (2, True), pytest.param(20, True, marks=pytest.mark.nightly)]
)
def test_an_hour_at_two_frames_a_second_over_a_link_that_comes_and_goes(turns, real):
    """Of a long flight at a thin rate nobody would see the part behind the first hill."""
    given, pictures = largest(300_000, 2), ()
    if real:  # x265 itself, of a small picture at a rate that is as thin for it
        given = {"budget": 40_000, "min_budget": 12_000, "fps": 2, "size": (160, 96)}
        pictures = hard_pictures(20, size=(160, 96))
    chance, best, worst = random.Random(5), 1.3 * given["budget"], 0.23 * given["budget"]
    steps, away = [(0.0, best)], []
    for turn in range(turns):
        begin = 60.0 + 170 * turn + chance.uniform(0, 60)
        end = begin + chance.choice([1, 2, 3, 5, 10, 30, 60])
        steps += [(begin, 0.0 if turn % 4 else worst), (end, best)]
        away.append((begin, end))
    lasts = 180.0 * turns
    flight = flown(LiveFlight(SteppedLink(steps), pictures=pictures, **given), lasts)
    begin = 5.0
    for gone, back in away:
        assert flight.longest_hole(begin, gone) <= BACK_S
        assert flight.back_after(back) <= max(back, flight.drained(back)) - back + BACK_S
        begin = max(back, flight.drained(back)) + BACK_S
    assert flight.longest_hole(begin, lasts) <= BACK_S


@pytest.mark.parametrize("method", ["M0", "M6"])
@pytest.mark.parametrize(
    ("fps", "coding_s", "budget", "least"),
    [
        *(
            (*one, budget, 0.95)
            for one in ((1, 0.3), (2, 0.12), (2, 0.25), (3, 0.2), (5, 0.1))
            for budget in (100_000, 300_000)
        ),
        # Three of 2.5 frames a second fall into some windows, which had room for 2.5: a quarter was left out.
        *((fps, 0.0, 300_000, 0.99) for fps in (2.25, 2.5, 3.7, 5.5)),
    ],
)
def test_nearly_every_frame_is_sent_however_long_it_takes_to_be_coded(fps, coding_s, budget, least, method):
    """A third of them would find no room in the budget: the frame before the last has not left the window yet."""
    given = {"fps": fps, "budget": budget, "method": method, "window": max(1, 2 / fps)}
    given |= {"size": (1280, 720) if coding_s and budget > 100_000 else (640, 360)}
    link = SteppedLink(((0, (1.3 if coding_s else 3) * budget),))
    tracks = 0 if method == "M0" else 250
    flight = flown(LiveFlight(link, coding_s=coding_s, track_bytes=tracks, **given), 30)
    assert len(flight.sent) >= least * 30 * fps - 2  # which the keyframe at the rate that was found takes


@pytest.mark.parametrize("method", ["M0", "M6"])
@pytest.mark.parametrize("budget", [100_000, pytest.param(300_000, marks=pytest.mark.nightly), 800_000])
@pytest.mark.parametrize(
    ("fps", "coding_s"), [pytest.param(5, 0.04, marks=pytest.mark.nightly), (5, 0.1), (10, 0.07)]
)
def test_no_frame_is_left_out_a_second_after_a_keyframe_that_took_long(fps, coding_s, budget, method):
    """A small board would lose one frame in a hundred: a second later each next one waits for one that went late."""
    given = {"fps": fps, "budget": budget, "method": method}
    given |= {"size": (640, 360) if budget > 100_000 else (320, 180)}
    slow = {"coding_s": coding_s, "keyframe_times": 5, "keyframe_s": 7}
    tracks = 0 if method == "M0" else 250
    flight = flown(LiveFlight(SteppedLink(((0, 2 * budget),)), track_bytes=tracks, **slow, **given), 60)
    assert flight.held <= 2  # of at least 300
