"""The rate follows the link: a bottleneck with a queue, simulated, and what the edge would have sent into it."""

import random
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_edge.config import EdgeConfig, check
from hvt_edge.link.feedback import PrimaryReceiver
from hvt_edge.link.pacer import Flight, Pacer
from hvt_edge.link.rate_control import LeastDelay, Progress, RateController, ReconfigurationTrigger
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.wiring.link import make_pacer
from rigs.live_flight import LiveFlight, SteppedLink
from rigs.messages import counted, feedback

MS = 1_000_000
S = 1_000_000_000
FPS = 15


def flown(
    seconds: float, *steps: tuple[float, float], cross: tuple[float, float, float] = (0, 0, 0), **more: Any
) -> LiveFlight:
    """Video alone at 800 kbps over this link."""
    given = {"size": (640, 360), "budget": 800_000, "min_budget": 100_000, "method": "M0"}
    return LiveFlight(SteppedLink(steps, cross=cross), **given | more).fly(seconds)


def controller() -> RateController:
    return RateController(ceiling_bps=800_000, floor_bps=100_000)


def progress(sent_ns: int, arrived_bytes: float, *, delay_ns: int = 20 * MS, **changes: int) -> Progress:
    said = {"serialization_ns": 0, "arrived_bytes": round(arrived_bytes), **changes}
    return Progress(now_ns=sent_ns + 40 * MS, sent_ns=sent_ns, arrived_ns=sent_ns + delay_ns, **said)


class LosesOneWay(SteppedLink):
    """For a second and a half nothing arrives, and reports go on."""

    def carry(self, size_bytes: int, *, at_ns: int) -> int | None:
        return None if 15 * S <= at_ns < 16.5 * S else super().carry(size_bytes, at_ns=at_ns)


def test_live_video_is_back_after_a_loss_of_one_way_alone():
    """What was lost would pass for a queue, and the picture stay dark for 10 s, until that had emptied."""
    link = LosesOneWay(((0, 6_000_000),))
    flight = LiveFlight(link, size=(1280, 720), budget=5_000_000, method="M0").fly(25)
    assert flight.back_after(16.5) <= 1


@pytest.mark.parametrize(
    ("found_s", "held", "more"),
    [
        (1.5, 0, {}),
        (3, 0, {"method": "M5", "video_share": 0.6}),  # where little is sent: there are no stills
        (4, 0, {"late_s": lambda second: 0.0 if second % 0.5 < 0.1 else None}),  # where little arrives
        (6, 10, {"way_s": lambda _second: 0.6}),  # of 450, while the round trip is not known yet
        (3, 0, {"ahead_s": lambda second: 10**6 + second * 50e-6}),
        (3, 0, {"ahead_s": lambda second: 0 if second < 10 else 3_600}),
        (3, 0, {"ahead_s": lambda second: 0 if second < 10 else -3_600}),
    ],
    ids=["near", "quiet", "few reports", "satellite", "clock drift", "clock set ahead", "clock set back"],
)
def test_a_steady_link_above_the_budget_is_found_within_seconds_and_kept(found_s, held, more):
    """On a link that carries the budget the picture would be worse than paid for, or freeze as a clock is set."""
    flight = flown(30, (0, 1e6), **more)
    assert min(flight.rate_between(found_s, 30)) > 0.85 * 800_000
    assert set(flight.rate_between(found_s + 3, 30)) == {800_000}
    assert len(flight.opened) <= 8
    assert flight.held <= held


def test_a_keyframe_behind_a_small_frame_is_no_queue_as_a_flight_begins():
    """A camera of one frame a second stayed at half of its budget for the first quarter of a minute."""
    one_a_second = {"size": (1920, 1080), "budget": 400_000, "fps": 1, "window": 2.0, "video_share": 0.85}
    flight = flown(15, (0, 520_000), method="M6", **one_a_second)
    assert min(flight.rate_between(5, 15)) == 400_000


@pytest.mark.parametrize(("kbps", "soon_s", "most_s"), [(60, 10, 8), (150, 5, 3), (300, 3, 1.5)])
def test_a_link_far_below_the_budget_is_not_overrun_at_the_start(kbps, soon_s, most_s):
    """A pilot with a thin radio who forgot ``--budget`` would see the picture of ten seconds ago, or none at all."""
    flight = flown(40, (0, 1e3 * kbps), size=(1280, 720), way_s=lambda _second: 0.3)
    assert max(flight.delays_between(0, 40)) < most_s
    assert max(flight.delays_between(soon_s, 40)) < 2
    assert flight.longest_hole(0, 40) < 2


@pytest.mark.parametrize(
    ("budget", "steps"), [(1_400_000, [(0, 6e4)]), (800_000, [(0, 6e4), (20, 0), (40, 6e4)])]
)
def test_a_queue_of_many_seconds_is_emptied_and_taken_for_no_longer_route(budget, steps):
    """Below the floor each picture would be half a minute old for the whole flight, and the next older still."""
    flight = flown(80, *steps, size=(1280, 720), budget=budget, way_s=lambda _second: 0.3)
    assert max(flight.delays_between(65, 80)) < 4
    assert flight.longest_hole(65, 80) < 2


def test_a_fall_to_a_fifth_and_back():
    """Behind a hill the picture would be seconds old; past it, it would stay as coarse as behind it."""
    flight = flown(60, (0, 1e6), (15, 2e5), (35, 1e6))
    assert max(flight.delays_between(15, 18)) > 0.9
    assert max(flight.delays_between(18, 60)) < 0.6
    assert flight.carried_bps(20, 35) > 0.8 * 200_000
    before = flight.carried_bps(5, 15)
    assert min(flight.carried_bps(t, t + 2) for t in range(48, 58, 2)) > 0.9 * before
    assert flight.rates[-1][1] == 800_000
    assert len(flight.opened) <= 17


def test_cross_traffic_is_given_way_and_taken_back():
    """Two edges on one radio would starve each other."""
    flight = flown(35, (0, 1e6), cross=(10, 22, 5e5))
    assert 400_000 < flight.carried_bps(14, 22) < 500_000
    assert max(flight.delays_between(10, 22)) < 0.6, "and so are the other's"
    assert flight.rates[-1][1] == 800_000


def test_loss_without_a_queue_lowers_the_rate_where_it_is_heavy():
    """A radio that loses one packet in twenty would be taken for a full one, or a policer be flooded for ever."""
    assert min(flown(40, (0, 1e6), loss=0.05).rate_between(3, 40)) > 600_000
    heavy = flown(40, (0, 1e6), loss=0.3)
    assert heavy.rates[-1][1] < 600_000
    assert heavy.pacer.backoffs >= 2


ANY_FPS = pytest.mark.parametrize("fps", [1, 2, 3, 5, 7.5, 10, 15, 30])


def rates_under_loss(fps: float, lost: list[bool], *, report_s: float = 0.1) -> list[int]:
    # The rate after each report of a link without a queue that loses these messages, and reports the rest.
    steered, rates, count, reported_s = controller(), [], 0, -1.0
    for number, gone in enumerate(lost):
        count += gone
        if gone or number / fps - reported_s < report_s:
            continue
        reported_s, size = number / fps, (number + 1) * 100_000 / fps
        steered.on_progress(progress(round(number * S / fps), size, messages=number + 1, lost=count))
        rates.append(steered.rate_bps)
    return rates


def losses(share: float, count: int, *, seed: int) -> list[bool]:
    chance = random.Random(f"{share} {seed}")
    return [chance.random() < share for _ in range(count)]


@ANY_FPS
@pytest.mark.parametrize(("share", "messages"), [(0.15, 400), (0.2, 250), (0.3, 120), (0.4, 80)])
def test_heavy_loss_lowers_the_rate_at_any_frame_rate(fps, share, messages):
    """At ten frames a second and below a policer would be flooded for ever: too few messages came together."""
    for seed in range(3):
        rates = rates_under_loss(fps, losses(share, messages, seed=seed))
        assert rates[-1] < 700_000, f"{share:.0%} lost of {messages} messages, seed {seed}"


@ANY_FPS
@pytest.mark.parametrize("share", [0.0, 0.02, 0.05])
def test_a_little_loss_leaves_the_rate_at_any_frame_rate(fps, share):
    """A radio that loses one packet in twenty would be taken for a full one, or two lost of three for all."""
    for seed in range(3):
        assert min(rates_under_loss(fps, losses(share, 600, seed=seed))) > 600_000
    assert min(rates_under_loss(fps, [False, True, True, *[False] * 17])) == 800_000


@ANY_FPS
def test_a_loss_that_is_over_lowers_the_rate_no_more(fps):
    """Behind a hill a few seconds were lost: at two frames a second the rate would go on falling for a minute."""
    rates = rates_under_loss(fps, [*losses(0.4, 60, seed=1), *[False] * 200])
    lowest = rates.index(min(rates))
    assert min(rates) < 700_000
    assert lowest < 60, "of the reports: some 36 come while messages are lost"
    assert rates[-1] == 800_000


def test_what_an_outage_lost_is_no_property_of_the_link():
    """After each tunnel the rate would stay down for the messages that were lost in it."""
    steered, number, lost = controller(), 0, 0
    for second in range(60):
        if 20 <= second < 24:
            number, lost = number + 15, lost + 15
            steered.on_silence(second * S)
            continue
        for frame in range(15):
            number += 1
            sent_ns = second * S + frame * S // 15
            steered.on_progress(progress(sent_ns, number * 7_000, messages=number, lost=lost))
    assert (steered.backoffs, steered.rate_bps) == (1, 800_000), "the silence itself"


def test_a_link_below_the_budget_is_filled_without_oscillation():
    """The picture would pump between coarse and frozen."""
    flight = flown(60, (0, 2e5))
    rates = flight.rate_between(20, 60)
    assert min(rates) > 150_000
    assert max(rates) < 370_000
    assert flight.carried_bps(20, 60) > 0.8 * 200_000
    assert max(flight.delays_between(20, 60)) < 0.6
    assert len([second for second in flight.opened if second > 20]) <= 12
    falls = sum(1 for a, b in pairwise(rates) if b < a)
    assert falls <= 8  # one for each trial of what is beyond


@pytest.mark.parametrize("quiet", [False, True])
def test_after_an_outage_the_picture_is_live_at_once_and_little_traffic_does_not_keep_the_rate_down(quiet):
    """The operator would first watch eight seconds of the past, or a picture as coarse as the least budget."""
    more = {"method": "M5", "video_share": 0.6} if quiet else {}  # there are no stills
    flight = flown(45, (0, 1e6), (15, 0), (23, 1e6), **more)
    assert 100_000 in flight.rate_between(17, 23)
    assert flight.rates[-1][1] > 799_000
    # What was on its way when the link went, and the frames that ask whether it is back, come before that.
    assert max(flight.delays_between(24, 45)) < 0.5
    assert min(flight.rate_between(30, 45)) > 700_000 or quiet


def test_what_was_never_sent_proves_nothing():
    """A quiet scene would let the rate run away from what the link has shown, and the next busy one overrun it."""
    steered = controller()
    steered.on_silence(0)
    for number in range(1, 200):
        steered.on_progress(progress(number * 150 * MS - 40 * MS, number * 1_500, serialization_ns=5 * MS))
    assert 150_000 < steered.rate_bps <= 250_000  # 80 kbps arrive


@pytest.mark.parametrize("way_s", [0.32, 1.02])
def test_a_route_that_becomes_longer_costs_some_seconds_only(way_s):
    """After a hand-over to a satellite the edge would stay at its least for good, or for most of a minute."""
    flight = flown(60, (0, 1e6), way_s=lambda second: 0.02 if second < 15 else way_s)
    assert len([second for second in flight.sent if second > 21]) > 550  # of 585
    assert min(flight.rate_between(34, 60)) == 800_000


@pytest.mark.parametrize("jump_s", [2, -2])
def test_a_small_clock_step_costs_some_seconds_only(jump_s):
    """It cannot be told from a queue at once, but it would have to be in the end."""
    flight = flown(45, (0, 1e6), ahead_s=lambda second: 0 if second < 10 else jump_s)
    assert min(flight.rate_between(30, 45)) == 800_000


def honest(pacer: Pacer, primary: PrimaryReceiver, *, now_ns: int, sequence: int, seconds: int) -> None:
    # Each frame that goes out is reported 40 ms later.
    for number in range(seconds * FPS):
        now_ns += S // FPS
        if pacer.admits_base(now_ns):
            sequence += 1
            pacer.sent_base(sequence, 6_000, now_ns=now_ns)
        said = feedback(receiver_id=1, sequence=number, send_ns=now_ns + 20 * MS, base_sequence=sequence)
        pacer.on_report(primary.judge(said, sent=(sequence, -1), now_ns=now_ns + 40 * MS))


def test_reports_of_others_do_not_steer():
    """Anybody who may send feedback would slow the edge down, or make it flood its link."""
    pacer, primary = Pacer(controller()), PrimaryReceiver()
    honest(pacer, primary, now_ns=S, sequence=-1, seconds=5)
    for number in range(200):
        said = feedback(receiver_id=2, sequence=number, base_sequence=74, send_ns=number * 10**15)
        pacer.on_report(primary.judge(said, sent=(74, -1), now_ns=6 * S + 50 * MS))
        assert pacer.rate_bps == 800_000
    assert pacer.ignored == 200
    honest(pacer, primary, now_ns=6 * S + 50 * MS, sequence=74, seconds=5)
    assert pacer.rate_bps == 800_000


@given(
    reports=st.lists(
        st.tuples(
            st.integers(0, 3),
            st.integers(0, 2**32 - 1),
            st.integers(-1, 2**32 - 1),
            st.integers(-1, 2**32 - 1),
            st.integers(0, 2**63 - 1),
            st.integers(0, 2**32 - 1),
            st.integers(0, 2**53 - 1),
            st.integers(0, 10 * S),
        ),
        max_size=60,
    )
)
@settings(max_examples=20)
def test_absurd_reports_keep_the_rate_within_its_bounds(reports):
    """One forged message would stop the edge or crash it."""
    pacer, now_ns = Pacer(controller()), 10**18
    for number, (receiver, sequence, base, still, send_ns, held_us, lost, pause_ns) in enumerate(reports):
        now_ns += pause_ns
        pacer.sent_base(number, 5_000, now_ns=now_ns)
        said = feedback(
            receiver_id=receiver, sequence=sequence, base_sequence=base % (number + 3) - 1, still_sequence=still,
            send_ns=send_ns, base_held_us=held_us, lost=lost,
        )  # fmt: skip
        pacer.on_report(counted(said, now_ns=now_ns, first=receiver == 0))
        pacer.admits_still(now_ns)
        pacer.admits_base(now_ns)
        assert 100_000 <= pacer.rate_bps <= 800_000
        assert 100_000 <= pacer.steady_bps <= 800_000
    # Honest reports go on: nothing that was said before holds the edge back for good.
    honest(pacer, PrimaryReceiver(), now_ns=now_ns + 5 * S, sequence=len(reports) + 10, seconds=60)
    assert pacer.rate_bps >= 0.9 * 800_000


def reported() -> Pacer:
    # To which a ground has reported that nothing came.
    pacer = Pacer(controller())
    pacer.on_report(counted(feedback(base_sequence=-1), now_ns=0, first=True))
    return pacer


@pytest.mark.parametrize(
    ("waits_ms", "still", "frame"),
    [(49, True, True), (60, False, True), (240, False, True), (260, False, False)],
)
def test_a_still_waits_for_little_and_a_frame_for_a_quarter_of_a_second(waits_ms, still, frame):
    """Stills would stand before each frame, and frames of a second in a queue of the edge's own."""
    size = waits_ms * 100  # at 800 kbps
    for send in (
        lambda pacer: pacer.sent_base(0, size, now_ns=0),
        lambda pacer: pacer.sent_still(0, size, now_ns=0),
        lambda pacer: pacer.sent_other(size, now_ns=0),
    ):
        send(pacer := reported())
        assert (pacer.admits_still(0), pacer.admits_base(0)) == (still, frame)
        assert pacer.admits_base(0, coding_ns=20 * MS), "it will be coded by then"
        assert pacer.admits_still((waits_ms - 40) * MS)


def test_what_a_report_names_waits_no_more():
    """A link faster than its rate would stay empty until the edge's own count has run down."""
    pacer = reported()
    pacer.sent_still(0, 30_000, now_ns=0)
    assert not pacer.admits_base(10 * MS)
    pacer.on_report(counted(feedback(sequence=1, base_sequence=-1, still_sequence=0), now_ns=10 * MS))
    assert pacer.admits_still(10 * MS)


def test_where_the_rate_falls_all_that_is_not_reported_still_waits():
    """The link has carried less than was counted: what is sent next would lengthen its queue."""
    pacer, number, admitted = reported(), 0, True
    while not pacer.backoffs:
        number, now_ns = number + 1, number * 50 * MS
        pacer.sent_base(number, 4_000, now_ns=now_ns)
        come, now_ns = number - 3 * (number > 20), now_ns + 45 * MS
        admitted = pacer.admits_still(now_ns)
        said = feedback(sequence=number, base_sequence=come, send_ns=now_ns - 15 * MS)
        pacer.on_report(counted(said, now_ns=now_ns))
    assert admitted
    assert not pacer.admits_still(now_ns)


@pytest.mark.parametrize("silent_s", [1, 3])
def test_after_a_silence_nothing_is_waited_for(silent_s):
    """At the least rate, what was under way would keep live video away for a second more."""
    pacer = Pacer(controller())
    honest(pacer, PrimaryReceiver(), now_ns=0, sequence=-1, seconds=5)
    for number in range(75, 79):
        pacer.sent_base(number, 6_000, now_ns=5 * S)
    now_ns = (5 + silent_s) * S
    pacer.on_report(counted(feedback(sequence=500, base_sequence=75), now_ns=now_ns))
    assert pacer.admits_base(now_ns) is (silent_s == 3)


def test_a_queue_that_builds_up_slowly_is_none_of_the_route():
    """The least delay of the last seconds would rise with it, and the picture become seconds old unseen."""
    steered = controller()
    for number in range(100):
        late_ns = (20 + 2 * number) * MS
        steered.on_progress(progress(number * 150 * MS, number * 15_000, delay_ns=late_ns))
    assert steered.backoffs


def test_a_number_that_was_never_sent_acknowledges_nothing():
    """A forged report would open the gate while the link is full."""
    flight = Flight()
    flight.sent(5_000, now_ns=0, rate_bps=800_000, base=0)
    assert flight.acknowledge(1, -1) is flight.acknowledge(0, 0) is None
    assert flight.size_bytes == 5_000
    flight.sent(7_000, now_ns=0, rate_bps=800_000, still=0)
    assert flight.acknowledge(0, -1) is not None
    assert flight.size_bytes == 7_000
    flight.sent(5_000, now_ns=3 * S, rate_bps=800_000, base=1)
    assert flight.acknowledge(1, -1) is not None
    assert flight.size_bytes == 0, "the still is lost"


def test_what_is_on_its_way_is_bounded():
    """An edge whose ground never reports would grow without end."""
    flight = Flight()
    for sequence in range(5_000):
        flight.sent(100, now_ns=sequence, rate_bps=800_000, base=sequence)
        flight.sent(100, now_ns=sequence, rate_bps=800_000, still=sequence)
    assert flight.size_bytes <= 2 * 1024 * 100


@pytest.mark.parametrize("viewer", [None, False, True])
def test_without_reports_of_the_video_nothing_is_held_back(viewer):
    """A recording would have holes while no ground is there (None), or one takes stills alone."""
    pacer = Pacer(controller())
    for number in range(150):
        now_ns = number * 66 * MS
        if viewer is not None:
            pacer.link(viewer, reports=False, now_ns=now_ns)
            pacer.on_report(counted(feedback(sequence=number), now_ns=now_ns, first=number == 0))
        assert pacer.admits_base(now_ns)
        pacer.sent_base(number, 5_000, now_ns=now_ns)
    assert pacer.rate_bps == 800_000
    assert not pacer.holds(now_ns)


def test_the_start_waits_for_the_first_report():
    """On a link much thinner than the budget the ground could not even ask what the session is."""
    pacer = Pacer(controller())
    pacer.link(True, now_ns=0)
    admitted = []
    for number in range(150):
        now_ns = number * S // 15
        if pacer.admits_base(now_ns):
            admitted.append(number)
            pacer.sent_base(len(admitted) - 1, 5_000, now_ns=now_ns, keyframe=number == 2)
    # 0.5 s from the keyframe on, one a second, and after the wait who never reports is served all the same.
    assert admitted == [*range(10), *range(24, 130, 15), *range(130, 150)]
    pacer.on_report(counted(feedback(base_sequence=10), now_ns=10 * S, first=True))
    assert pacer.ignored == 0


def test_a_ground_that_never_reports_gets_the_whole_budget_in_the_end():
    """Behind keys that let no report through the picture would stay as coarse as in the first second."""
    pacer, rates = Pacer(controller()), []
    pacer.link(True, reports=False, now_ns=0)  # its subscriptions come one after the other
    for second in range(20):
        pacer.link(True, now_ns=second * S)
        rates.append(pacer.rate_bps)
        pacer.sent_base(second, 5_000, now_ns=second * S, keyframe=True)
    assert rates == [200_000] * 8 + [800_000] * 12


def test_a_receiver_that_has_left_is_forgotten_and_the_rate_stays_at_its_least():
    """Another listener would see one frame a second for good; or a router whose link is away would get all video."""
    pacer, sequence, admitted = Pacer(controller()), 74, 0
    honest(pacer, PrimaryReceiver(), now_ns=S, sequence=-1, seconds=5)
    pacer.link(True, now_ns=6 * S)
    for number in range(20 * FPS):
        now_ns = 6 * S + number * S // FPS
        if pacer.admits_base(now_ns):
            admitted += number < 14 * FPS
            sequence += 1
            pacer.sent_base(sequence, 2_000, now_ns=now_ns)
    assert admitted < 30
    assert pacer.admits_base(now_ns + S // FPS)
    assert pacer.rate_bps == 100_000


def test_a_round_trip_and_a_rate_are_of_now_or_not_known():
    """Status, metrics and ``hvt-edge status`` showed those of minutes ago while the camera or the ground was away."""
    pacer = Pacer(controller())
    pacer.link(True, now_ns=0)
    assert not pacer.measured_now(0)
    known = []
    for second in range(30):
        if second in (0, 25):  # between, the camera is away
            pacer.sent_base(second, 2_000, now_ns=second * S, keyframe=True)
        if second != 28:  # a report is lost
            said = feedback(sequence=second, base_sequence=25 * (second >= 25))
            pacer.on_report(counted(said, now_ns=second * S + 20 * MS, first=not second))
        known.append(pacer.measured_now(second * S + 30 * MS))
    assert known == [True] * 15 + [False] * 10 + [True] * 5
    assert not pacer.measured_now(32 * S), "the ground is silent"


def test_a_link_that_comes_back_is_noticed_once():
    """No keyframe would come, and the ground would wait for one."""
    pacer = Pacer(controller())
    honest(pacer, PrimaryReceiver(), now_ns=S, sequence=-1, seconds=5)
    assert not pacer.link(True, now_ns=6 * S)
    assert not pacer.link(False, now_ns=6 * S)
    assert pacer.rate_bps == 100_000
    assert pacer.admits_base(6 * S)  # nothing leaves, and a recording goes on
    assert pacer.link(True, now_ns=6 * S)
    assert not pacer.link(True, now_ns=6 * S)


def test_another_ceiling_is_followed_at_once():
    """``set-budget`` would have no effect."""
    pacer = Pacer(controller())
    for ceiling_bps in (400_000, 600_000, 50_000):
        pacer.set_ceiling(ceiling_bps)
        assert pacer.rate_bps == ceiling_bps


def test_the_least_delay_forgets():
    """A route that became longer would count as a queue for ever."""
    least = LeastDelay(10)
    assert [least.add(delay, now_ns=t) for t, delay in ((0, 5), (5, 9), (11, 9), (15, 9), (22, 9))] == [
        5, 5, 5, 5, 9,
    ]  # fmt: skip


def test_x265_is_opened_anew_only_where_it_is_worth_it():
    """A keyframe at each small step would cost more than the step."""
    trigger = ReconfigurationTrigger()
    for wanted, at_s, wants, at_ceiling in (
        (105, 0, False, False),
        (110, 1, False, False),
        (110, 4, True, False),
        (130, 4, True, False),
        (79, 4, True, False),
        (None, 4, None, None),
        (50, 5, False, False),
        (50, 6, True, False),
        (None, 10, None, None),
        (103, 11, False, True),
        (103, 15, True, True),
    ):
        if wanted is None:
            trigger.done(at_s * S)
        else:
            assert trigger.wants(wanted, 100, at_ceiling=at_ceiling, now_ns=at_s * S) is wants


def test_one_report_cannot_do_more_than_its_share():
    """A single odd delay would take the picture down."""
    steered = controller()
    for number in range(30):
        delay_ns = 20 * MS + (3 * S if number == 20 else 0)
        said = progress(number * 150 * MS, number * 10_000, delay_ns=delay_ns, serialization_ns=50 * MS)
        steered.on_progress(said)
    assert steered.rate_bps == 800_000


def test_few_frames_where_x265_can_do_no_more():
    """At a rate that x265 cannot follow the link would be overrun for good."""
    least = [1]
    frame_skip = FrameSkip(2, least_decimation=lambda: least[0])
    assert frame_skip.at_keyframe(0) == 2
    least[0] = 5
    assert frame_skip.decimation == 2  # at keyframes only
    assert frame_skip.at_keyframe(10) == 5
    frame_skip.coded(10, keyframe=True, mean_qp=30.0)
    assert [index for index in range(11, 17) if frame_skip.codes(index)] == [15, 16]
    least[0] = 1
    assert frame_skip.at_keyframe(20) == 2


def test_a_floor_above_the_ceiling_is_refused():
    """The edge would start and do what nobody asked for."""
    with pytest.raises(UserError, match="--min-budget 500 kbps is more than --budget 400 kbps"):
        check(EdgeConfig(source="demo", budget=400_000, min_budget=500_000))
    assert check(EdgeConfig(source="demo", size=(320, 180), budget=80_000)).floor_bps == 80_000
    assert check(EdgeConfig(source="demo")).floor_bps == 100_000
    assert make_pacer(EdgeConfig(source="demo", pace="lockstep"), None, (320, 180)) is None, "media time"
