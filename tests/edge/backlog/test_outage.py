"""When the link is away."""

from __future__ import annotations

from hvt_edge.backlog.outage import Outage

S = 1_000_000_000


def states(outage: Outage, *, first: float, last: float, linked: bool, reports: float = 0) -> list[bool]:
    """Asked fifteen times a second; a ground reports each ``reports`` seconds."""
    answers, next_report = [], first
    for tick in range(round(first * 15), round(last * 15)):
        now = tick / 15
        if reports and now >= next_report:
            outage.reported(round(now * S))
            next_report += reports
        answers.append(outage.offline(round(now * S), linked=linked))
    return answers


def test_a_clip_that_nobody_has_heard_yet_is_not_kept():
    """Each run of a clip without a ground would fill the disk."""
    assert not any(states(Outage(live=False), first=0, last=30, linked=False))


def test_a_camera_is_kept_from_its_first_frame():
    """What a drone saw before the ground was switched on would be lost."""
    assert all(states(Outage(live=True), first=0, last=5, linked=False))


def test_a_ground_that_falls_silent_is_noticed_long_before_zenoh_does():
    """Seconds of the flight would go into a dead connection."""
    outage = Outage(live=False)
    assert not any(states(outage, first=0, last=10, linked=True, reports=0.5))
    after = states(outage, first=10, last=14, linked=True)
    assert 1.0 <= after.index(True) / 15 <= 1.6
    assert all(after[after.index(True) :])
    assert not any(states(outage, first=14, last=16, linked=True, reports=0.5)), "one report ends it"


def test_a_ground_that_is_gone_is_an_outage_and_its_return_ends_it():
    """Keeping would go on with somebody there, or not begin."""
    outage = Outage(live=False)
    states(outage, first=0, last=3, linked=True, reports=0.5)
    assert all(states(outage, first=3, last=20, linked=False))
    # Back, and not heard of yet: the silence of before is not held against it.
    assert not any(states(outage, first=20, last=30, linked=True))


def test_who_listens_and_never_reports_gets_everything():
    """Another program that shows the video would get a frame a second."""
    assert not any(states(Outage(live=True), first=0, last=30, linked=True))


def test_a_ground_that_left_does_not_keep_the_others_from_seeing():
    """After 15 s of silence on a living link it was the ground that went."""
    outage = Outage(live=False)
    states(outage, first=0, last=3, linked=True, reports=0.5)
    after = states(outage, first=3, last=30, linked=True)
    assert after[-1] is False
    assert 13 <= sum(after) / 15 <= 14.5
