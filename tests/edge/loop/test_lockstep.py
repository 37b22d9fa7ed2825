"""The frame loop in lockstep where not every frame is coded."""

import threading
from typing import Any

import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BaseHeader
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.operating import Keyframes, LoopClock
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, smooth_pictures
from rigs.messages import counted, feedback
from rigs.world import Puts, QuietStills, make_base_stage, make_transmitter

SIZE = (320, 192)


class Ground:
    """Answers each access unit that it gets, and nothing else."""

    def __init__(self) -> None:
        self.inbox = FeedbackInbox()
        self.frames: list[int] = []

    def put(
        self, row: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        assert row is Channel.BASE
        assert attachment is not None
        self.frames.append(BaseHeader.parse(attachment, payload).frame_index)
        report = feedback(
            session_id=1,
            sequence=len(self.frames),
            last_frame_index=self.frames[-1],
            base_messages=len(self.frames),
            objects_detected=self.frames[-1],
        )
        self.inbox.on_report(counted(report, now_ns=1))


def paced(
    link: Any, stills: QuietStills, inbox: FeedbackInbox, *, fps: float, **parts: Any
) -> tuple[LockstepPace, LoopClock]:
    """A loop in which every third of ``fps`` frames is coded, and its clock."""
    keyframes, clock = Keyframes(), LoopClock(lambda: 0, lockstep=True)
    stage = make_base_stage(
        BaseEncoder(EncoderSettings(size=SIZE, fps=5.0, bitrate_bps=100_000, preset="ultrafast")),
        make_transmitter(link, budget=RollingBudget(BudgetSettings(800_000, 400_000, fps=5)), lockstep=True),
        keyframes=keyframes,
        frame_skip=FrameSkip(3),
    )
    plain = {"has_ground": lambda: True, "stop": threading.Event(), "counts": FrameCounts()}
    pace = LockstepPace(
        stage, stills, inbox=inbox, keyframes=keyframes, clock=clock, fps=fps, **(plain | parts)
    )
    return pace, clock


def test_ticks_that_are_not_coded_are_seen_and_not_waited_for():
    """With ``--fps auto`` a run in lockstep would stand still for 20 s at the first frame that was never sent."""
    ground, stills, counts = Ground(), QuietStills(), FrameCounts()
    pace, clock = paced(ground, stills, ground.inbox, fps=15, counts=counts)
    with pace:
        for frame in framed(smooth_pictures(50, size=SIZE)):
            pace.step(frame)
            assert clock() == frame.capture_ns, "media time"
    assert ground.frames == list(range(0, 50, 3))
    assert stills.seen == [(index, None if index % 3 else index) for index in range(50)]
    assert counts.encoded == 17
    # The ground is always done at once; what it says of a frame counts a second later, in every run the same.
    said = [(steps, detected.frame_index) for steps, detected in stills.detected]
    assert said == [*((frame + 15, frame) for frame in range(0, 35, 3)), (50, 48)]


class Silent(FeedbackInbox):
    """Of a ground that never answers; counts the tenths of a second for which it was waited."""

    tenths = 0

    def wait_for(self, *, frame_index: int, stills: set[int], timeout_s: float) -> bool:
        del frame_index, stills
        self.tenths += round(10 * timeout_s)
        return False


@pytest.mark.parametrize(
    ("subscribed", "stops", "tenths"), [(True, False, 200), (False, False, 20), (True, True, 3)]
)
def test_a_ground_that_never_answers_is_waited_for_once(subscribed, stops, tenths):
    """A long run of a study, or Ctrl-C, would hang on a ground that crashed: seconds for each of its frames."""
    inbox, stop, there = Silent(), threading.Event(), [True]
    has_ground = lambda: subscribed or bool(there and there.pop())  # noqa: E731
    pace, _ = paced(Puts(), QuietStills(), inbox, fps=3, stop=stop, has_ground=has_ground)
    if stops:
        stop.set()
    with pace:
        for frame in framed(smooth_pictures(12, size=SIZE)):
            pace.step(frame)
    assert inbox.tenths == pytest.approx(tenths, abs=1)  # they are summed as fractions
