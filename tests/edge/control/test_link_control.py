"""What reports of grounds decide, and what happens without any."""

from dataclasses import replace

import pytest

from hvt_common.protocol.messages import Flags
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from rigs.keeping import Rig
from rigs.messages import feedback

SECOND_NS = 1_000_000_000


def test_who_reports_nothing_is_not_waited_for():
    """A plain Zenoh program would see half a second of video, and then nothing for two."""
    pacer = Pacer(RateController(ceiling_bps=800_000, floor_bps=100_000))
    pacer.link(True, reports=False, now_ns=0)
    for frame in range(60):
        now_ns = frame * SECOND_NS // 15
        assert pacer.admits_base(now_ns)
        pacer.sent_base(frame, 3_000, now_ns=now_ns, keyframe=frame == 0)
    assert pacer.rate_bps == 800_000


class Faulty(FeedbackInbox):
    """Fails on every report while it is broken."""

    broken = False

    def on_report(self, report):
        if self.broken:
            raise OverflowError("too much")
        super().on_report(report)


@pytest.fixture
def rig(tmp_path, request):
    """A flight with a store; the test's parameter has its settings."""
    made = Rig(tmp_path / "store", **getattr(request, "param", {}))
    yield made
    made.backlog.close()


def test_a_watcher_that_stays_after_the_ground_has_left_is_served(rig):
    """A plain Zenoh program would get a frame a second for a quarter of a minute, and the store fill for nobody."""
    rig.play(0, 45, reports=True)
    rig.watched = True
    rig.play(45, 120, linked=False)
    shown = {one.frame_index for one in rig.out.base}
    assert len(shown & set(range(47, 120))) >= 70
    assert rig.backlog.frames <= 2
    rig.watched = False
    rig.play(120, 135, linked=False)
    assert rig.backlog.frames >= 14, "with nobody there the flight is stored again"


@pytest.mark.parametrize("rig", [{"adapt": True}], indirect=True)
def test_reports_tell_how_soon_a_keyframe_is_known_to_be_lost(rig):
    """The screen would stay dark for as long as on a satellite link."""
    rig.play(0, 30, reports=True)
    rig.keyframes.done(rig.now_ns)
    soon_ns = rig.now_ns + SECOND_NS // 4
    assert rig.keyframes.request(soon_ns) is None
    assert rig.keyframes.due(soon_ns)


def test_a_forged_number_of_a_still_in_a_report_takes_none_for_received(rig):
    """What the link has lost would never be sent again, nor stored when the link goes."""
    rig.play(0, 15, reports=True)
    rig.still(0)
    forged = replace(rig.out.ground.report(rig.now_ns), still_sequence=2**32 - 9, missing_stills=())
    rig.link_control.on_feedback(forged)
    assert rig.outbox.unacknowledged == 1
    rig.report()
    assert rig.outbox.unacknowledged == 0


@pytest.mark.parametrize("rig", [{"adapt": True, "budget": (800_000, 650_000)}], indirect=True)
def test_a_ground_that_hears_and_misses_video_is_said_and_stored_for(rig):
    """Beyond a hole for large packets the edge would send the flight in vain, at its full rate, and be content."""
    waits = replace(
        feedback(lost=9, missing_stills=(), backlog=()), session_id=7, base_sequence=-1, still_sequence=-1
    )
    rig.out.dark = True
    rig.play(0, 15)
    for first in range(15, 195, 5):
        said = replace(waits, sequence=first, send_ns=rig.now_ns)
        rig.link_control.on_feedback(said)
        if first == 120:
            rig.keyframes.request(rig.now_ns)
        rig.play(first, first + 5)
    assert rig.backlog.frames >= 120
    (failed,) = rig.failures.now
    assert failed.part == "pictures"
    assert "large packets are lost" in failed.reason
    asked = next(one for one in rig.out.base if one.frame_index >= 120)
    assert asked.flags & Flags.KEYFRAME, "it alone can show a ground without a picture that the way is free"
    rig.out.dark = False
    rig.play(195, 210, reports=True)
    assert not rig.failures.now


@pytest.mark.parametrize("rig", [{"adapt": True, "inbox": Faulty()}], indirect=True)
def test_a_report_that_cannot_be_used_lowers_the_rate_and_video_goes_on(rig, caplog):
    """An error in a thread of the link is nobody's: the edge would wait for ever for what never arrives."""
    inbox = rig.link_control.inbox
    rig.play(0, 45, reports=True)
    assert rig.pacer.rate_bps > 100_000
    before = len(rig.out.base)
    inbox.broken = True
    rig.play(45, 105, reports=True)
    assert rig.pacer.rate_bps == 100_000, "the floor"
    assert len(rig.out.base) >= before + 4, "a frame a second at the least"
    (failed,) = rig.failures.parts
    assert (failed.part, failed.working) == ("reports", False)
    assert "OverflowError: too much" in failed.reason
    inbox.broken = False
    rates = []
    for first in range(105, 205, 10):
        rig.play(first, first + 10, reports=True)
        rates.append(rig.pacer.rate_bps)
    assert max(rates) > 100_000, "it grows again"
    assert rig.failures.parts[0].working
    assert len(caplog.records) == 2
