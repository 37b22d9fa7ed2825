"""The hard budget, counted over every rolling window."""

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_edge.link.budget import BASE_PEAK, BudgetSettings, RollingBudget
from rigs.footprint import footprint_bytes

SECOND_NS = 1_000_000_000
START_NS = 1_790_000_000 * SECOND_NS


@dataclass
class Run:
    """A budget, and everything that was recorded with it."""

    settings: BudgetSettings
    own_peak: bool = True
    """Whether base messages keep the base stream's own peak, as in flight."""
    events: list[tuple[int, int, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.budget = RollingBudget(self.settings)

    def base(self, size: int, now_ns: int, *, keyframe: bool = False) -> int:
        at_ns = self.budget.earliest_ns(size, now_ns=now_ns, base=self.own_peak)
        self.budget.record_base(size, now_ns=at_ns, keyframe=keyframe)
        self.events.append((at_ns, size, "base"))
        return at_ns

    def status(self, size: int, now_ns: int) -> None:
        at_ns = self.budget.earliest_ns(size, now_ns=now_ns)
        self.budget.record_metadata(size, now_ns=at_ns)
        self.events.append((at_ns, size, "meta"))

    def still(self, size: int, now_ns: int) -> None:
        self.budget.record_still(size, now_ns=now_ns)
        self.events.append((now_ns, size, "still"))

    def stills(self, now_ns: int, rng: np.random.Generator, *, most: int = 4, greed: float = 1.0) -> None:
        """Some, of whatever size there is room for."""
        for _ in range(most):
            room = self.budget.still_allowance(now_ns)
            if room < 300:
                break
            self.still(int(rng.integers(300, max(300, round(room * greed)) + 1)), now_ns)

    def fullest(self, window_ns: int, kinds: tuple[str, ...] = ("base", "meta", "still")) -> int:
        chosen = sorted((at_ns, size) for at_ns, size, kind in self.events if kind in kinds)
        times_ns = np.array([at_ns for at_ns, _ in chosen], np.int64)
        until = np.cumsum([0, *(size for _, size in chosen)])
        begin, end = (times_ns.searchsorted(times_ns - back_ns, side="right") for back_ns in (window_ns, 0))
        return int((until[end] - until[begin]).max(initial=0))


def frame_times(count: float, fps: float = 15) -> Iterator[tuple[int, int]]:
    return ((number, START_NS + round(number * SECOND_NS / fps)) for number in range(round(count)))


def total_bytes(one: BudgetSettings) -> float:
    return one.total_bps * one.window_ns / 8 / SECOND_NS


def budgets(
    *, windows: tuple[float, ...] = (0.5, 1.0, 2.3), borrow_unused: bool | None = None
) -> st.SearchStrategy[BudgetSettings]:
    return st.builds(
        lambda total, share, fps, window, metadata, borrow_unused: BudgetSettings(
            total_bps=total,
            base_bps=round(total * share),
            fps=fps,
            window_ns=round(window * SECOND_NS),
            metadata_bps=metadata,
            borrow_unused=borrow_unused,
        ),
        st.sampled_from([100_000, 800_000, 1_400_000]),
        st.floats(0.3, 1.0),
        st.sampled_from([3.0, 10.0, 15.0, 29.97]),
        st.sampled_from(windows),
        st.sampled_from([0, 8_000]),
        st.booleans() if borrow_unused is None else st.just(borrow_unused),
    )


@settings(max_examples=60)
@given(one=budgets(), seed=st.integers(0, 2**32 - 1), burst=st.floats(0.0, 3.0), greed=st.floats(0.1, 1.0))
def test_no_rolling_window_exceeds_the_total(one, seed, burst, greed):
    """The link would be asked for more than the user has, in some second of the flight."""
    rng = np.random.default_rng(seed)
    run, mean = Run(one), one.base_bps / 8 / one.fps
    for number, now_ns in frame_times(min(240, round(6 * one.fps) + 20), one.fps):
        keyframe = number == 0 or rng.random() < 0.02
        size = mean * rng.gamma(2, 0.5) * (1 + burst * (rng.random() < 0.1)) + (8 * mean if keyframe else 0)
        size = int(min(size, total_bytes(one)))  # no single message exceeds the window
        run.base(size, now_ns, keyframe=keyframe)
        if number % max(1, round(one.fps)) == 0:
            run.status(400, now_ns)
        run.stills(now_ns, rng, greed=greed)
    assert run.fullest(one.window_ns) <= total_bytes(one)


@settings(max_examples=40)
@given(one=budgets(borrow_unused=False), seed=st.integers(0, 2**32 - 1))
def test_stills_keep_to_their_share(one, seed):
    """Stills would live on what the base leaves, and the base's quality would be paid for twice."""
    rng = np.random.default_rng(seed)
    run = Run(one)
    for _, now_ns in frame_times(min(240, round(8 * one.fps)), one.fps):
        run.base(int(one.base_bps / 8 / one.fps * rng.uniform(0.1, 0.6)), now_ns)  # it leaves a lot
        run.stills(now_ns, rng, most=1000)
    share = one.still_bps / 8
    for seconds in (one.window_ns / SECOND_NS, 1.0, 4.0):
        fullest = run.fullest(round(seconds * SECOND_NS), ("still",))
        assert fullest <= share * (seconds + one.carry_s) + 1


@settings(max_examples=60)
@given(one=budgets(), seed=st.integers(0, 2**32 - 1))
def test_a_base_message_waits_no_longer_than_a_window_and_keeps_its_order(one, seed):
    """A picture would come late for nothing, or before the one that it rests on."""
    rng = np.random.default_rng(seed)
    run, last_ns = Run(one, own_peak=False), 0
    for _, now_ns in frame_times(100, one.fps):
        size = int(rng.integers(1, round(total_bytes(one) * 1.3)))
        ready_ns = max(now_ns, last_ns)
        before = sum(held for at_ns, held, _ in run.events if at_ns > ready_ns - one.window_ns)
        at_ns = run.base(size, now_ns)
        assert ready_ns <= at_ns <= ready_ns + one.window_ns
        if before + size <= total_bytes(one):
            assert at_ns == ready_ns, "there was room"
        elif size <= total_bytes(one):
            # Just so long, and no longer: a nanosecond earlier the window would have been too full.
            early = sum(held for other, held, _ in run.events[:-1] if other > at_ns - 1 - one.window_ns)
            assert early + size > total_bytes(one)
        last_ns = at_ns


@settings(max_examples=80)
@given(
    total=st.sampled_from([60_000, 300_000, 800_000]),
    share=st.floats(0.5, 0.97),
    fps=st.sampled_from([2.0, 3.0, 4.0, 5.0, 15.0]),
    silence_s=st.floats(0, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_nothing_of_lower_priority_delays_a_frame(total, share, fps, silence_s, seed):
    """After a short silence of the camera the backlog would fill each window, and no frame would ever go again."""
    rng = np.random.default_rng(seed)
    one = BudgetSettings(total, round(total * share), fps=fps)
    budget, mean = RollingBudget(one), int(one.base_bps / 8 / fps - 400 / fps)  # the rest is for status
    silent = range(round(5 * fps), round((5 + silence_s) * fps))
    backlog_bytes = 0
    for number in range(round((9 + silence_s) * fps)):
        due_ns = START_NS + round(number * SECOND_NS / fps)
        if number not in silent:
            at_ns = budget.earliest_ns(mean, now_ns=due_ns, base=True)
            assert at_ns == due_ns, f"frame {number} waits {(at_ns - due_ns) / 1e6:.0f} ms"
            budget.record_base(mean, now_ns=at_ns)
        for now_ns in range(due_ns, due_ns + round(SECOND_NS / fps), SECOND_NS // 50):
            kind, size = rng.integers(5), int(rng.integers(100, 300))
            if kind == 0 and budget.metadata_fits(size, now_ns=now_ns):
                budget.record_metadata(size, now_ns=now_ns)
            elif kind == 1 and (room := budget.still_allowance(now_ns)) >= 600:
                budget.record_still(room, now_ns=now_ns)
            elif kind > 1 and (room := min(2_000, budget.backlog_allowance(now_ns, reserve=0.0))) >= 600:
                budget.record_other(room, now_ns=now_ns)
                backlog_bytes += room
    assert backlog_bytes or share * total > total - 5_000 or total < 100_000, "what is over is used"


def test_messages_of_one_moment_leave_the_window_together():
    """In lockstep a frame and its stills have one time: frames a second later would wait longer than they must."""
    run = Run(
        BudgetSettings(total_bps=80_000, base_bps=40_000, fps=10), own_peak=False
    )  # 10 000 bytes a window
    run.still(3_000, START_NS)
    run.still(3_000, START_NS)
    run.base(2_000, START_NS + 500_000_000)
    assert run.base(8_000, START_NS + 600_000_000) == START_NS + SECOND_NS


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), one=budgets(windows=(0.5, 1.0)), skew=st.integers(0, 300_000_000))
def test_two_threads_with_times_a_little_apart_hold_it_too(seed, one, skew):
    """The still thread decides at a time that has passed, while a base message already waits for a later one."""
    rng = np.random.default_rng(seed)
    run, mean = Run(one), one.base_bps / 8 / one.fps
    for _, now_ns in frame_times(100, one.fps):
        run.base(int(min(mean * rng.gamma(1, 1.5), total_bytes(one))), now_ns)
        late_ns = now_ns - int(rng.integers(0, skew + 1))
        run.stills(late_ns, rng, most=3)
    assert run.fullest(one.window_ns) <= total_bytes(one)


@pytest.mark.parametrize("window_s", [1.0, 2.0])
@pytest.mark.parametrize(("total_bps", "base_bps"), [(800_000, 650_000), (1_400_000, 1_200_000)])
def test_with_a_steady_base_the_stills_get_their_share(total_bps, base_bps, window_s):
    """A budget that is too careful would leave unused what the user paid for."""
    one = BudgetSettings(total_bps, base_bps, fps=15, window_ns=round(window_s * SECOND_NS))
    run, sent, seconds = Run(one), 0, 30
    rng = np.random.default_rng(1)
    for _, now_ns in frame_times(seconds * 15):
        run.base(round(base_bps / 8 / 15 * rng.uniform(0.9, 1.1)), now_ns)
        while run.budget.still_allowance(now_ns) >= 1_500:
            run.still(1_500, now_ns)
            sent += 1_500
    assert sent * 8 / seconds >= 0.85 * (total_bps - base_bps)
    assert run.fullest(one.window_ns) <= total_bytes(one)


def test_stills_yield_where_the_base_overshoots():
    """Stills and a burst of the base together would fill the link's queues."""
    one = BudgetSettings(800_000, 650_000, fps=15)
    run, rooms = Run(one), []
    for number, now_ns in frame_times(45):
        run.base(round(650_000 / 8 / 15 * (1.2 if number >= 15 else 1.0)), now_ns)
        rooms.append(run.budget.still_allowance(now_ns))
    assert rooms[14] > 15_000
    assert rooms[29] < 3_000


def test_a_keyframe_fits_once_what_was_before_it_has_left():
    """It would be sent into a full window, and every picture after it would wait."""
    one = BudgetSettings(800_000, 650_000, fps=15)  # 100 000 bytes a window
    run = Run(one)
    for _, now_ns in frame_times(30):
        run.base(5_400, now_ns)
    now_ns += SECOND_NS // 15
    assert run.budget.keyframe_fits(20_000, now_ns=now_ns)
    run.still(10_000, now_ns)
    assert not run.budget.keyframe_fits(20_000, now_ns=now_ns)
    # The stills leave after a second in which the base went on as before.
    for _, now_ns in list(frame_times(46))[30:]:
        run.base(5_400, now_ns)
    assert run.budget.keyframe_fits(20_000, now_ns=now_ns + SECOND_NS // 15)
    # A camera that comes back would be shown by difference from a picture that is long gone.
    thin = Run(BudgetSettings(800_000, 760_000, fps=15))
    for _, now_ns in frame_times(30):
        thin.base(6_300, now_ns)
    assert not thin.budget.keyframe_fits(20_000, now_ns=now_ns)
    assert thin.budget.keyframe_fits(20_000, now_ns=now_ns + 2 * SECOND_NS)


@pytest.mark.parametrize("window_s", [0.5, 1.0, 4.0])
def test_the_most_a_still_is_ever_given_is_known(window_s):
    """A request larger than that would wait for room that never comes."""
    one = BudgetSettings(800_000, 650_000, fps=10, window_ns=round(window_s * SECOND_NS))
    budget = RollingBudget(one)
    assert budget.most_still_bytes == int(min(window_s, 2.0) * 150_000 / 8)
    rooms = []
    for number in range(120):
        now_ns = START_NS + round(number * SECOND_NS / 10)
        budget.record_base(8125, now_ns=now_ns)
        rooms.append(budget.still_allowance(now_ns))
    assert max(rooms[round(20 * window_s) :]) <= budget.most_still_bytes
    assert rooms[-1] >= 0.95 * budget.most_still_bytes


def test_memory_is_bounded_and_a_long_window_costs_no_more():
    """An hour of flight would make each frame slower than the one before."""
    calls = Counter[int]()
    for window_s in (1, 10):
        one = BudgetSettings(800_000, 650_000, fps=30, window_ns=window_s * SECOND_NS)
        budget = RollingBudget(one)

        def fly(first: int, end: int, *, budget=budget) -> None:
            for number in range(first, end):
                now_ns = START_NS + round(number * SECOND_NS / 30)
                at_ns = budget.earliest_ns(2_700, now_ns=now_ns)
                budget.record_base(2_700, now_ns=at_ns)
                budget.still_allowance(now_ns)

        def count(_frame, event: str, _arg, *, window_s=window_s) -> None:
            calls[window_s] += event == "c_call"

        fly(0, 1_800)
        before = footprint_bytes(budget)
        sys.setprofile(count)
        try:
            fly(1_800, 1_810)
        finally:
            sys.setprofile(None)
        fly(1_810, 3_600)
        assert footprint_bytes(budget) < 1.05 * before
    assert calls[10] < 1.2 * calls[1], "what one frame does does not grow with the window"


@given(jitter=st.lists(st.integers(0, 60_000_000), min_size=60, max_size=60), burst=st.floats(1.0, 1.8))
def test_the_base_keeps_its_own_peak_where_frames_bunch_up(jitter: list[int], burst: float):
    """In real time frames come late and close together; the radio would see a burst that no VBV allowed."""
    settings = BudgetSettings(total_bps=800_000, base_bps=650_000, fps=15)
    run = Run(settings)
    mean = settings.base_bps / 8 / settings.fps
    waits = []
    for number, late_ns in enumerate(jitter):
        size = round(mean * (burst if number % 5 == 0 else 1.25 - burst / 4))
        now_ns = START_NS + round(number * SECOND_NS / 15) + late_ns
        waits.append(run.base(size, now_ns) - now_ns)
    assert run.fullest(SECOND_NS, ("base",)) <= BASE_PEAK * settings.base_bps / 8
    assert max(waits) < SECOND_NS / 5


@dataclass(frozen=True)
class Flight:
    """What went over a lumpy base: one coded frame each ``every`` frames of 15 a second."""

    run: Run
    still_bytes: int
    base_bytes: int
    longest_wait_s: float


def fly(one: BudgetSettings, *, every: int, use: float, seconds: int = 20, seed: int = 0) -> Flight:
    rng, run, longest = np.random.default_rng(seed), Run(one), 0
    for index, now_ns in frame_times(seconds * 15):
        if index % every == 0:
            at_ns = run.base(round(use * one.base_bps / 8 / one.fps * rng.uniform(0.8, 1.2)), now_ns)
            longest = max(longest, at_ns - now_ns)
        while (room := run.budget.still_allowance(now_ns)) >= 500:
            run.still(min(room, int(rng.integers(500, 1_800))), now_ns)
    sums = {kind: sum(size for _, size, other in run.events if other == kind) for kind in ("still", "base")}
    return Flight(run, sums["still"], sums["base"], longest / SECOND_NS)


@pytest.mark.parametrize(("every", "use"), [(1, 0.7), (1, 0.9), (3, 0.7), (5, 0.7), (15, 0.7)])
def test_what_the_base_leaves_is_lent_and_no_more(every, use):
    """A quiet scene would leave a third of the link idle while tracks wait for their still."""
    plain = BudgetSettings(300_000, 240_000, fps=15 / every)
    alone = fly(plain, every=every, use=use)
    borrowed = fly(replace(plain, borrow_unused=True), every=every, use=use)
    total = plain.total_bps / 8 * 20
    assert alone.still_bytes + alone.base_bytes < (use * 0.8 + 0.2 + 0.03) * total
    assert 0.96 * total < borrowed.still_bytes + borrowed.base_bytes <= 1.01 * total
    assert borrowed.run.fullest(plain.window_ns) <= total_bytes(plain)
    assert borrowed.longest_wait_s <= alone.longest_wait_s + 0.07, "the base pays for what it borrowed"


def test_nothing_is_lent_where_the_base_takes_its_share():
    """Lending would take from the base what it needs itself."""
    plain = BudgetSettings(300_000, 240_000, fps=5)
    assert fly(replace(plain, borrow_unused=True), every=3, use=1.05).still_bytes == pytest.approx(
        fly(plain, every=3, use=1.05).still_bytes, rel=0.15, abs=5_000
    )


@pytest.mark.parametrize("every", [1, 3, 5])
@pytest.mark.parametrize("use", [0.5, 0.8, 1.0])
def test_a_loan_is_counted_and_what_is_kept_for_others_is_not_lent(every, use):
    """What the base left would be given twice, or the tracks channel would find its bytes spent."""
    one = BudgetSettings(300_000, 140_000, fps=15 / every, metadata_bps=100_000, borrow_unused=True)
    flight = fly(one, every=every, use=use)
    rate_bps = flight.still_bytes * 8 / 20
    # The share, two seconds of it saved up at the start, and what was left; frames that differ by 20 % leave a little
    # more than their mean does.
    assert rate_bps == pytest.approx(66_000 + (1 - use) * 140_000, abs=14_000)


@settings(max_examples=60)
@given(
    one=budgets(windows=(1.0,)),
    seed=st.integers(0, 2**32 - 1),
    changes=st.lists(
        st.tuples(st.floats(0.3, 1.0), st.sampled_from([1, 2, 3, 5, 7])), min_size=1, max_size=4
    ),
)
def test_no_window_exceeds_the_total_when_rate_and_share_change_in_flight(one, seed, changes):
    """At every keyframe with --fps auto or --video-share auto the link would get more than the user has."""
    rng = np.random.default_rng(seed)
    one = replace(one, fps=15.0)
    run, every, base_bps, since = Run(one), 1, one.base_bps, 0
    for index, now_ns in frame_times(45 * (len(changes) + 1)):
        keyframe = index % 45 == 0
        if keyframe and index:
            share, every = changes[index // 45 - 1]
            base_bps, since = round(one.total_bps * share), index
            run.budget.set_total(one.total_bps, base_bps, 15 / every, now_ns=now_ns)
        if (index - since) % every == 0:
            size = base_bps / 8 * every / 15 * rng.gamma(4, 0.25) * (3 if keyframe else 1)
            run.base(int(min(size, total_bytes(one))), now_ns, keyframe=keyframe)
        run.stills(now_ns, rng)
    assert run.fullest(one.window_ns) <= total_bytes(one)


def test_a_new_split_changes_what_stills_get_and_no_frame_waits_for_it():
    """Bits that the scene asks for elsewhere would stay where they were, or pictures would come late."""
    run = Run(BudgetSettings(300_000, 240_000, fps=15))
    sent = {"before": 0, "after": 0}
    for index, now_ns in frame_times(15 * 40):
        if index == 300:
            run.budget.set_total(300_000, 200_000, 5.0, now_ns=now_ns)
        coded = index < 300 or index % 3 == 0
        if coded:
            at_ns = run.base(round((240_000 if index < 300 else 3 * 200_000) / 8 / 15), now_ns)
            assert at_ns == now_ns
        while run.budget.still_allowance(now_ns) >= 800:
            run.still(800, now_ns)
            sent["before" if index < 300 else "after"] += 800
    assert sent["before"] * 8 / 20 == pytest.approx(60_000, rel=0.15)
    assert sent["after"] * 8 / 20 == pytest.approx(100_000, rel=0.15)
    assert run.fullest(SECOND_NS) <= 300_000 / 8


def test_metadata_comes_out_of_what_stills_have():
    """The tracks channel would make every picture wait, because stills had already spent its bytes."""
    one = BudgetSettings(200_000, 160_000, fps=15, metadata_bps=10_000)
    run, sent = Run(one), 0
    for index, now_ns in frame_times(15 * 20):
        assert run.base(round(160_000 / 8 / 15), now_ns) == now_ns
        if index % 5 == 0:
            run.status(10_000 // 8 // 3, now_ns)
        while run.budget.still_allowance(now_ns) >= 300:
            run.still(300, now_ns)
            sent += 300
    assert sent * 8 / 20 == pytest.approx(30_000, rel=0.15)
    assert run.budget.most_still_bytes == 30_000 // 8


@pytest.mark.parametrize("share", [0.75, 0.9])
@pytest.mark.parametrize("cut_bps", [800_000, 600_000, 500_000, 300_000, 200_000, 100_000])
def test_where_a_camera_takes_all_that_a_budget_has_a_requested_still_is_refused_at_once(cut_bps, share):
    """After the budget was cut who asked would wait ten seconds for room that never comes."""
    settings = BudgetSettings(800_000, round(800_000 * share), fps=25, yields=False)
    budget = RollingBudget(settings)
    sent, room = False, 0
    for index in range(300):
        now_ns, keyframe = START_NS + index * SECOND_NS // 25, index % 25 == 0
        if index == 50:
            budget.set_total(cut_bps, round(cut_bps * share), 25, now_ns=now_ns)
        if index == 150:
            most_bytes = budget.most_requested_bytes
        size = 12_000 if keyframe else 2_500
        wait_ns = budget.earliest_ns(size, now_ns=now_ns, base=True) - now_ns
        sent = (keyframe or sent) and wait_ns < SECOND_NS // 2
        if sent:
            budget.record_base(size, now_ns=now_ns + wait_ns, keyframe=keyframe)
        if index >= 150:
            room = max(room, budget.requested_allowance(now_ns + max(0, wait_ns)))
    assert most_bytes <= room
    assert most_bytes or cut_bps < 800_000


@pytest.mark.parametrize("taker", ["still", "requested", "backlog"])
def test_what_else_goes_beside_a_camera_takes_nothing_of_the_largest_requested_still(taker):
    """A second closer look would be refused, or coded smaller, for the room that the first one took."""
    budget = RollingBudget(BudgetSettings(400_000, 240_000, fps=25, yields=False))
    most_bytes = []
    for index in range(200):
        now_ns = START_NS + index * SECOND_NS // 25
        budget.record_base(900, now_ns=now_ns, keyframe=False)
        if index < 50:
            most_bytes.append(budget.most_requested_bytes)
            continue
        now_ns += SECOND_NS // 100
        if taker == "still":
            budget.record_still(budget.still_allowance(now_ns), now_ns=now_ns)
        elif taker == "backlog":
            budget.record_other(budget.backlog_allowance(now_ns, reserve=0.0), now_ns)
        elif (free := budget.requested_allowance(now_ns)) >= 6_000:
            budget.record_requested(free, now_ns=now_ns)
    assert budget.most_requested_bytes == most_bytes[-1] > 10_000


@pytest.mark.parametrize("step_bps", [0, 100])
def test_beside_large_keyframes_of_a_camera_a_requested_still_waits_and_is_not_refused(step_bps):
    """In the first second, and behind each step of the link's rate, it would be told to raise the budget."""
    budget = RollingBudget(BudgetSettings(800_000, 600_000, fps=25, yields=False))
    most_bytes = []
    for index in range(150):
        now_ns = START_NS + index * SECOND_NS // 25
        if step_bps and index % 10 == 0:
            budget.set_total(800_000 + index * step_bps, 600_000, 25, now_ns=now_ns)
        budget.record_base(2_000 if index % 50 else 30_000, now_ns=now_ns, keyframe=False)
        most_bytes.append(budget.most_requested_bytes)
    assert min(most_bytes) > 15_000
