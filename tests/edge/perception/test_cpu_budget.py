"""Perception gives way to video, and among its parts the later ones to those before."""

import math
from itertools import pairwise

import pytest

from hvt_common.units import SECOND_NS
from hvt_edge.perception.cpu_budget import CpuBudget, most_cores, share_out

FPS = 15
COSTS = {"track": 0.006, "detect": 0.14, "compare": 0.14, "choose": 0.01}


@pytest.mark.parametrize(
    ("cores", "track_s", "detect_s", "compare_s", "share"),
    [
        (math.inf, 0, 0, 0, 1),
        (1.0, 0, 0.194, 1.03, 1),
        (0.25, 0, 0.861, 5.83, 0.875),
        (0.1, 0.12, 1.06, 18.7, 0.5),
        (0.02, 0.5, 5, 117, 0.5),
        (0.0, 0.5, 5, math.inf, 0.5),
    ],
)
def test_what_comes_later_gives_way_first(cores, track_s, detect_s, compare_s, share):
    """A board would have no boxes at all because it measures what boxes are worth, or boxes of four seconds ago."""
    plan = share_out(cores, COSTS, fps=FPS)
    assert (plan.track_s, plan.detect_s, plan.compare_s, plan.detector_share) == pytest.approx(
        (track_s, detect_s, compare_s, share), rel=0.01
    )


@pytest.mark.parametrize(
    ("processors", "others", "cores"), [(0.5, 0.2, 0.25), (2, 0.5, 1.0), (2, 1.2, 0.6), (2, 2, 0), (16, 0, 8)]
)
def test_nobody_is_given_the_last_tenth_of_the_processors(processors, others, cores):
    """A control group stops the whole process where it takes all; each keyframe cost two frames."""
    assert most_cores(processors, others=others) == pytest.approx(cores)


class Rig:
    """A flight whose parts take the processor time that they are said to; ``video`` cores go to video."""

    def __init__(self, *, processors: float = math.inf, video: float = 0.5) -> None:
        self.spent_ns = 0
        self.budget = CpuBudget(fps=FPS, processors=processors, spent_ns=lambda: self.spent_ns)
        self.video = video
        self.index = self.lost = 0
        self.followed, self.looked, self.compared = list[int](), list[int](), list[int]()

    def fly(self, seconds: float, *, loses=lambda _index: False, late: bool = False):
        for _ in range(round(seconds * FPS)):
            self._frame(loses, late=late)
            self.index += 1
        return self

    def _frame(self, loses, *, late: bool) -> None:
        at_ns = self.index * SECOND_NS // FPS
        if self.index % FPS == 0:
            before_ns, self.measured_ns = getattr(self, "measured_ns", 0), self.spent_ns
            self.budget.measure(self.video + (self.spent_ns - before_ns) / SECOND_NS, now_ns=at_ns)
        self.lost += loses(self.index)
        if not self.budget.admits_frame(at_ns, lost=self.lost, late=late):
            return
        self._spend("track", self.followed)
        if self.budget.admits_detection(at_ns):
            self._spend("detect", self.looked)
            if self.budget.admits_comparison(at_ns):
                self._spend("compare", self.compared)

    def _spend(self, part, noted: list[int]) -> None:
        with self.budget.spending(part):
            of_input = self.budget.detector_share**2 if part == "detect" else 1
            self.spent_ns += round(COSTS[part] * of_input * SECOND_NS)
        noted.append(self.index)


def test_in_lockstep_each_part_gets_all_that_it_asks_for():
    """A study's numbers would depend on the machine."""
    rig = Rig().fly(4)
    assert rig.followed == rig.looked == rig.compared == list(range(60))
    assert not rig.budget.too_slow


def test_a_flight_keeps_to_its_budget_and_follows_each_frame():
    """Two small cores would burn for perception what an autopilot beside it needs."""
    rig = Rig(processors=2).fly(4)
    before_ns = rig.spent_ns
    rig.fly(20)
    assert (rig.spent_ns - before_ns) / SECOND_NS / 20 <= most_cores(2) * 1.1
    assert len(rig.followed) == 24 * FPS
    assert max(b - a for a, b in pairwise([one for one in rig.looked if one > 4 * FPS])) <= 1.3 * FPS
    assert len(rig.compared) >= 4


def test_what_video_takes_is_not_there_for_perception():
    """Frames would be lost on a board before anything gives way."""
    roomy, tight = (Rig(processors=0.5, video=video).fly(20) for video in (0.1, 0.4))
    assert len(tight.looked) < len(roomy.looked)
    assert tight.budget.detector_share == 0.5
    assert roomy.budget.detector_share > 0.7, "fewer first, then smaller, then fewer still"


def test_each_frame_that_video_loses_halves_the_budget_and_it_comes_back():
    """Video would lose a frame at each look for as long as the flight lasts; or one busy second cost them all."""
    quiet = len(Rig(processors=8).fly(60).looked)
    assert len(Rig(processors=8).fly(60, loses=lambda index: index % 20 == 0).looked) < quiet / 3
    once = Rig(processors=8).fly(10, loses=lambda index: index < 60)
    looked = len(once.fly(30).looked)
    assert len(once.fly(10).looked) - looked > quiet / 6 - 2, "it has come back"
    # A board's second boxes would come three seconds after its first ones.
    plain, starting = (
        Rig(processors=0.5, video=0.3).fly(5, loses=lambda index, n=n: index < n) for n in (0, 8)
    )
    assert (starting.lost, starting.looked) == (8, plain.looked), "frames lost at the start halve nothing"


def test_where_video_loses_frames_all_the_time_boxes_still_move_twice_a_second():
    """Nothing at all would be listed on a board that is too slow for its video."""
    rig = Rig(processors=1, video=1.2).fly(40, loses=lambda _index: True)
    late = [one for one in rig.followed if one > 10 * FPS]
    assert max(b - a for a, b in pairwise(late)) <= FPS // 2 + 1
    assert len([one for one in rig.looked if one > 10 * FPS]) >= 5
    assert not rig.budget.too_slow


def test_a_machine_that_does_not_come_to_look_is_too_slow():
    """Tracks of long ago would be sent for ever."""
    rig = Rig(processors=2).fly(2)
    rig.fly(10, late=True)
    assert rig.budget.too_slow
    rig.fly(1)
    assert not rig.budget.too_slow


@pytest.mark.parametrize(("fps", "step_s", "count"), [(0.1, 10, 3), (15, 86_400, 2)])
def test_frames_that_are_far_apart_neither_end_a_flight_nor_blame_the_machine(fps, step_s, count):
    """With --fps 0.1, or after a camera was away for a day, whose power of two is no number."""
    budget = CpuBudget(fps=fps, processors=8)
    for number in range(count):
        at_ns = 1 + number * step_s * SECOND_NS
        assert budget.admits_frame(at_ns, lost=0, late=False)
        assert not budget.too_slow, "it has only come"
        assert budget.admits_detection(at_ns)


@pytest.mark.parametrize(
    ("processors", "keyframe_soon", "queued", "admitted"),
    [(0.5, True, 0, False), (math.inf, True, 0, True), (math.inf, False, 3, False), (0.5, False, 2, True)],
    ids=["keyframe", "lockstep", "frames wait", "few wait"],
)
def test_just_before_a_keyframe_and_with_frames_that_wait_nothing_is_searched(
    processors, keyframe_soon, queued, admitted
):
    """Video would lose the frames behind it, or boxes be seconds old; lockstep has all the time that there is."""
    budget = CpuBudget(fps=10, processors=processors)
    budget.keyframe_soon, budget.queued = keyframe_soon, queued
    assert budget.admits_frame(0, lost=0, late=False)
    assert budget.admits_detection(0) is budget.admits_comparison(0) is admitted
