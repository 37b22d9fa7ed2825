"""What is sent beside the video, by what it was measured to give."""

from dataclasses import replace

import pytest

from hvt_common.protocol.edge_words import DECISION_WORDS, each_decision
from hvt_common.protocol.messages import Status
from hvt_common.protocol.messages.envelope import kinds
from hvt_edge.operating import Operating
from hvt_edge.perception.auto import AutoControl, AutoSettings, Measured

SECOND_NS = 1_000_000_000
SETTINGS = AutoSettings(tracks_bps=8_000)


class Rig:
    """A control at a budget, fed by hand; time runs in seconds."""

    def __init__(self, *, budget_bps: int = 800_000, finer: bool = False) -> None:
        self.operating = Operating(
            budget_bps=budget_bps, video_share=None, base_bps=budget_bps, method="M6", decimation=1
        )
        self.control = AutoControl(self.operating, replace(SETTINGS, finer=finer))
        self.at_s = 0

    def tracks(self, gain: float, **measured: float) -> bool:
        self.control.measured = Measured(
            **{"comparisons": 3.0, "sure_gain": gain, "hidden": 4} | measured, gain=gain
        )
        return self.second().tracks

    def answers(self, count: int, *, changed: int = 0) -> bool:
        for number in range(count):
            self.control.take_answer(changed=number < changed)
        return self.second().stills

    def second(self, seconds: int = 1):
        self.at_s += seconds
        self.control.decide(self.at_s * SECOND_NS)
        says = self.operating.now.decisions.says
        assert {one for one, _ in each_decision(says)} <= DECISION_WORDS.keys(), "the page has words for each"
        return self.operating.now.decisions


@pytest.mark.parametrize(
    ("gain", "moved", "stable"),
    [(0.0, 0.0, True), (0.01, 0.0, False), (0.1, 0.01, True), (0.1, 0.06, False), (0.1, 0.5, False)],
)
def test_a_judgement_near_its_threshold_is_not_settled(gain, moved, stable):
    """It would be measured half as often, and tracks would come or go late."""
    rig = Rig()
    rig.control.measured = Measured(3.0, gain, gain, moved=moved)
    rig.second()
    assert rig.control.stable is stable
    rig.control.unlike = True
    assert rig.control.stable


def test_in_a_view_that_the_detector_does_not_know_its_tracks_have_no_credit():
    """A tenth of the budget went into guesses, because the ground guessed otherwise."""
    rig = Rig()
    assert rig.tracks(0.3)
    rig.control.unlike = True
    assert not rig.tracks(0.3)
    assert rig.operating.now.decisions.says.startswith(
        "no tracks: this view is unlike what the detector knows; "
    )
    rig.control.unlike = False
    assert rig.tracks(0.3)


def test_tracks_follow_their_gain_and_do_not_flicker():
    """At the border of being worth their bits they would come and go with the noise of the measurement."""
    rig = Rig()
    unsure = {"sure_gain": 0.0}
    assert not rig.tracks(0.0)
    assert not rig.tracks(0.05, **unsure)
    assert rig.tracks(0.05)
    assert rig.tracks(0.05, **unsure), "what they were sent for may still be there"
    assert not rig.tracks(0.0)
    sees_more = [rig.tracks(0.0, sure_gain=0.05) for _ in range(4)]
    assert sees_more == [True] * 4, "a ground may surely see less than it probably does"


def test_it_says_who_does_not_see_them():
    """An operator would look for the fault in the video where the ground's model is the wrong one."""
    rig = Rig()
    for reported, who in ((True, "the ground misses"), (False, "the video hides")):
        rig.control.measured = Measured(3.0, 0.5, 0.5, 16, reported=reported)
        assert rig.second().says.startswith(f"tracks: {who} 16 objects; ")
    rig.control.measured = Measured(3.0, 0.5, 0.5, 16, suppressed=4.2, misnamed=2.6)
    says = "tracks: the video hides 16 objects, shows 4 false, misnames 3; "
    assert rig.second().says.startswith(says)


def test_what_it_says_has_room_in_a_report():
    """The page would show a sentence without its end, and the half of a number."""
    rig = Rig(finer=True)
    crowd = Measured(3.0, -0.5, -0.5, hidden=99, suppressed=99, misnamed=99, reported=True)
    rig.control.measured = crowd
    assert rig.answers(SETTINGS.most_answers, changed=40)
    says = rig.operating.now.decisions.says
    assert says.startswith(
        "no tracks: the ground misses 99 objects, shows 99 false, misnames 99; stills show"
    )
    assert dict(kinds(Status))["decisions"].decode(says) == says, "a report refuses what is longer"


@pytest.mark.parametrize(
    ("budget_bps", "gain", "measured", "sent"),
    [
        # The first pictures of a stream hide everything: tracks would begin on every clip.
        (800_000, 0.0, {"comparisons": 0.0}, False),
        (800_000, 0.1, {"comparisons": 1.0}, False),
        (800_000, 0.3, {"comparisons": 1.0}, True),
        # One object that the detector imagines among many would bring them; the only one there is must.
        (800_000, 0.1, {"sure_gain": 0.0}, False),
        (800_000, 0.8, {"sure_gain": 0.0}, True),
        # 8 kbps are a tenth of 80 kbps and nothing of 1400: video would gain by them.
        (1_400_000, SETTINGS.least_gain + 0.004, {}, True),
        (60_000, SETTINGS.least_gain + 0.004, {}, False),
    ],
)
def test_tracks_begin_where_their_gain_is_sure_or_plain_and_worth_their_bits(
    budget_bps, gain, measured, sent
):
    assert Rig(budget_bps=budget_bps).tracks(gain, **measured) is sent


def test_stills_that_change_nothing_pause_and_are_tried_again():
    """A fifth of the budget would go to pictures that tell the ground what it knows."""
    rig = Rig()
    assert rig.answers(SETTINGS.least_answers - 1), "too few to tell"
    assert not rig.answers(1)
    pause_s = SETTINGS.pause_ns // SECOND_NS
    assert not rig.second(pause_s - 1).stills
    assert rig.second(1).stills, "the scene may have changed"
    assert not rig.answers(SETTINGS.least_answers), "in vain"
    assert not rig.second(2 * pause_s - 1).stills, "the next try comes later"
    assert rig.second(1).stills
    assert not rig.answers(SETTINGS.least_answers)
    rig.tracks(0.0, misnamed_share=0.3)
    assert rig.operating.now.decisions.stills, "without tracks a right name reaches the ground by them alone"
    rig.control.forget()
    decisions = rig.second()
    assert decisions.stills, "what was measured on the ground says nothing of the sky"
    assert decisions.says.startswith("no tracks: not measured yet")
    assert rig.answers(SETTINGS.most_answers, changed=5), "the next one may be the one that matters"
    assert "stills: they name 5 of 40 otherwise" in rig.operating.now.decisions.says


def test_stills_of_a_source_much_finer_than_the_base_never_pause():
    """Details are what they are for there: no class changes, and an operator could read nothing."""
    rig = Rig(finer=True)
    assert rig.answers(60)
    assert rig.operating.now.decisions.says.endswith("stills show details, they name 0 of 40 otherwise")
    rig.control.take_load(too_slow=True, now_ns=SECOND_NS)
    assert not rig.second().stills, "but on a machine that is too slow"


def test_a_machine_that_is_too_slow_sends_video_alone_and_says_so():
    """Perception that never comes to a frame would leave the last decisions for ever."""
    rig = Rig()
    rig.tracks(0.1)
    rig.control.take_load(too_slow=True, now_ns=SECOND_NS)
    decisions = rig.operating.now.decisions
    assert (decisions.tracks, decisions.stills, "too slow" in decisions.says) == (False, False, True)
    rig.control.take_load(too_slow=False, now_ns=2 * SECOND_NS)
    assert rig.tracks(0.1), "it has time again"


@pytest.mark.parametrize("lies", [True, False])
def test_a_ground_that_lies_moves_stills_alone(lies):
    """Whoever answers on feedback would else decide on video or tracks."""
    rig = Rig()
    rig.tracks(0.1)
    before = rig.operating.now
    rig.answers(1000, changed=1000 if lies else 0)
    now = rig.operating.now
    assert now.decisions.tracks == before.decisions.tracks
    assert (now.total_bps, now.base_bps, now.decimation) == (before.total_bps, before.base_bps, 1)
