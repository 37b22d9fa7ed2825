"""What holds in flight; when a keyframe comes, and who may request one."""

import threading
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_edge.operating import Keyframes, KeyframeSettings, LoopClock, Operating, base_rate_bps

MS = 1_000_000
STEP_NS = 66_666_667


def play(plan: Keyframes, steps: int, *, fits=lambda _n: True, asked=lambda _n: False) -> list[int]:
    """Numbers of the frames that became keyframes."""
    keyframes = []
    for number in range(steps):
        now_ns = number * STEP_NS
        if asked(number):
            plan.request(now_ns)
        if plan.now(now_ns, fits=fits(number)):
            plan.done(now_ns)
            keyframes.append(number)
    return keyframes


@pytest.mark.parametrize(
    ("interval_ms", "fits", "keyframes"),
    [
        (0, lambda _n: False, [0]),
        (1_000, lambda _n: True, [0, 15, 30]),
        (1_000, lambda n: n % 20 == 19, [0, 19, 39]),  # due at 15 and 34, room at 19 and 39
        (1_000, lambda _n: False, [0, 21]),
    ],
)
def test_the_first_frame_is_one_and_the_schedule_waits_for_room(interval_ms, fits, keyframes):
    """Nobody could decode anything, or enter a recording in its middle; or a keyframe not wait for its budget."""
    plan = Keyframes(KeyframeSettings(interval_ns=interval_ms * MS, scheduled_patience_ns=400 * MS))
    assert plan.due(0)
    assert play(plan, 40, fits=fits) == keyframes
    assert plan.sent == len(keyframes)


@pytest.mark.parametrize("interval_ms", [0, 1_000])
def test_while_one_is_due_stills_know_it(interval_ms):
    """Stills would go on taking the room that the keyframe waits for, requested or of the schedule."""
    plan = Keyframes(KeyframeSettings(interval_ns=interval_ms * MS))
    plan.done(0)
    assert not plan.due(999 * MS)
    if not interval_ms:
        assert plan.request(1_000 * MS) is None
    assert plan.due(1_000 * MS)
    assert not plan.now(1_100 * MS, fits=False)
    assert plan.due(1_100 * MS)
    assert plan.now(1_200 * MS, fits=True)
    plan.done(1_200 * MS)
    assert not plan.due(1_300 * MS)


def test_a_request_that_crossed_a_keyframe_is_answered_by_it():
    """One loss would cost two keyframes, and the second would push pictures and stills aside for nothing."""
    plan = Keyframes(KeyframeSettings(interval_ns=0))
    plan.done(0)
    for asked_ms, due in ((200, False), (400, True)):
        assert plan.request(asked_ms * MS) is None
        assert plan.due(asked_ms * MS) == due
    assert plan.served == 2


def test_a_ground_that_joins_right_after_a_keyframe_sees_a_picture_within_a_second():
    """It would look at nothing for longer than promised: its first request is taken as answered."""
    settings = KeyframeSettings(interval_ns=0)
    second_ask_ns = 300 * MS  # as the reassembler repeats it
    for joined_ns in range(0, 300 * MS, 10 * MS):
        plan = Keyframes(settings)
        plan.done(0)
        asks = {joined_ns, joined_ns + second_ask_ns}
        for now_ns in range(0, 3_000 * MS, 10 * MS):
            if now_ns in asks:
                plan.request(now_ns)
            if plan.now(now_ns, fits=False):
                break
        assert now_ns - joined_ns < 1_000 * MS


@given(
    asks=st.sets(st.integers(0, 199), max_size=60),
    room=st.sets(st.integers(0, 199)),
    interval_s=st.sampled_from([0, 2, 10]),
)
def test_every_request_is_answered_in_time_and_not_more_often(asks, room, interval_s):
    """A ground would wait for a picture; or many grounds together would make the stream all keyframes."""
    settings = KeyframeSettings(interval_ns=interval_s * 1_000 * MS, refill_ns=0)
    keyframes = play(Keyframes(settings), 240, fits=lambda n: n in room, asked=lambda n: n in asks)
    for ask in asks:
        near = [
            one
            for one in keyframes
            if -settings.rest_ns < (one - ask) * STEP_NS < settings.patience_ns + STEP_NS
        ]
        assert near, f"the request at frame {ask} was not answered: {keyframes}"
    for first, second in pairwise(keyframes):
        assert (second - first) * STEP_NS >= settings.rest_ns
        because_asked = any(first < ask <= second for ask in asks)
        assert because_asked or (interval_s and (second - first) * STEP_NS >= settings.interval_ns)


@pytest.mark.parametrize(
    ("takes_ms", "losses", "most"),
    [
        (160, False, 1 + 6 + 60_000 // 700),
        (470, False, 1 + 6 + 60_000 // (470 / 0.35)),
        (470, True, 1 + 6 + 60_000 // 600),  # those of the bucket go between
    ],
    ids=["cheap", "dear", "with invented losses"],
)
def test_a_commander_cannot_make_the_stream_all_keyframes(takes_ms, losses, most):
    """Whoever may command could push pictures and stills aside with three keyframes a second, for ever."""
    plan, refusals = Keyframes(KeyframeSettings(interval_ns=0)), []
    for number, now_ns in enumerate(range(0, 60_000 * MS, 50 * MS)):
        if losses:
            plan.report_losses(number, 2**40 + number)
        if (refusal := plan.request(now_ns)) is not None:
            refusals.append(refusal)
        if plan.now(now_ns, fits=True):
            plan.done(now_ns)
            plan.note_cost(takes_ms * MS)
    assert 30 < plan.sent <= most, "three a second would be 180"
    assert plan.served == 1200 - len(refusals)
    assert "the last keyframe came" in refusals[-1]
    assert "ask again in" in refusals[-1]


def test_recovery_after_losses_is_never_refused():
    """The picture would stay dark because a ground asked for what it needed: six losses in six seconds, then rest."""
    plan = Keyframes(KeyframeSettings(interval_ns=0))
    plan.done(0)
    plan.note_cost(470 * MS)
    for start_ns in (1_000 * MS, 30_000 * MS):
        for loss in range(6):
            now_ns = start_ns + loss * 1_000 * MS
            assert plan.request(now_ns) is None
            assert plan.due(now_ns)
            assert plan.request(now_ns + 10 * MS) is None, "the same loss is asked about twice"
            plan.done(now_ns + 60 * MS)
            assert plan.request(now_ns + 100 * MS) is None, "it crossed the keyframe on the way"
            assert not plan.due(now_ns + 100 * MS)


def test_a_keyframe_that_was_lost_itself_is_followed_by_another_as_soon_as_the_link_can_say_so():
    """On a lossy link the second request counted as one that crossed the keyframe, and the screen stayed dark."""
    plan = Keyframes(KeyframeSettings(interval_ns=0))
    plan.done(0)
    assert plan.request(210 * MS) is None
    assert not plan.due(210 * MS), "as long as nothing is known of the link"
    plan.note_round_trip(70 * MS)
    assert plan.request(150 * MS) is None
    assert not plan.due(150 * MS), "it may have crossed"
    assert plan.request(210 * MS) is None
    assert plan.due(210 * MS)
    plan.done(2_000 * MS)
    plan.note_round_trip(1_200 * MS)
    assert plan.request(2_310 * MS) is None
    assert plan.due(2_310 * MS), "over a satellite no later than before"


def test_a_reported_loss_is_a_reason_once():
    """One old loss would be a ticket to as many keyframes as somebody cares to ask for."""
    plan = Keyframes(KeyframeSettings(interval_ns=0, burst=1))
    plan.done(0)
    plan.note_cost(3_500 * MS)  # the next in ten seconds
    assert plan.request(20_000 * MS) is None
    plan.done(20_000 * MS)
    plan.report_losses(1, 5)
    assert plan.request(20_600 * MS) is not None, "too soon, whoever lost what"
    assert plan.request(20_800 * MS) is None
    plan.done(20_800 * MS)
    plan.report_losses(1, 5)
    plan.report_losses(1, 4)
    assert plan.request(22_000 * MS) is not None, "nothing more was lost"
    plan.report_losses(2, 1)
    assert plan.request(22_000 * MS) is None, "another ground has its own losses"


def test_a_receiver_that_counts_anew_has_losses_again():
    """After an outage of a lossy link each keyframe would be refused until as many were lost as before it."""
    plan = Keyframes(KeyframeSettings(interval_ns=0, burst=1))
    plan.report_losses(1, 500)
    plan.done(0)
    plan.note_cost(3_500 * MS)
    assert plan.request(20_000 * MS) is None
    plan.done(20_000 * MS)
    plan.report_losses(1, 0)
    plan.report_losses(1, 2)
    assert plan.request(21_000 * MS) is None


def test_the_edges_own_requests_come_from_any_thread_and_cost_nothing():
    """A change of rate, or a link that comes back, would wait for the schedule; or be refused."""
    both = Keyframes(KeyframeSettings(interval_ns=0, burst=1))
    both.done(0)
    both.note_cost(60_000 * MS)
    threads = [threading.Thread(target=both.require, args=[400 * MS + n]) for n in range(8)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert both.due(401 * MS)
    assert both.now(500 * MS, fits=True)
    both.require(510 * MS)
    both.done(520 * MS)
    assert not both.due(530 * MS), "what was requested while it was made is met by it"
    assert (both.sent, both.served) == (2, 0)


def test_a_reader_has_one_moment():
    """Status would tell the budget of now with the rate of before."""
    holder = Operating(budget_bps=400_000, video_share=0.75, base_bps=300_000, method="M5", decimation=1)
    before = holder.now
    holder.set(budget_bps=200_000, video_share=None, method="M6")
    holder.set(total_bps=150_000, base_bps=100_000, decimation=3)
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
