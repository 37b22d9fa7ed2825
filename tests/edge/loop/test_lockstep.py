"""The frame loop in lockstep where not every frame is coded."""

from __future__ import annotations

import threading

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import BaseHeader
from hvt_edge.keyframes import Keyframes
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.operating import LoopClock
from hvt_edge.video.encoder_settings import EncoderSettings
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, smooth_pictures
from rigs.messages import counted, feedback
from rigs.world import make_base_stage, make_transmitter

SIZE = (320, 192)


class Ground:
    """Answers each access unit that it gets, and nothing else."""

    def __init__(self) -> None:
        self.inbox = FeedbackInbox()
        self.frames: list[int] = []

    def put(
        self, row: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Take one message."""
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


class Stills:
    """Notes what it was given; sends nothing."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, int | None]] = []
        self.latest_tracks = None
        self.sends = 0
        self.detected: list[tuple[int, int]] = []

    def analyze(self, frame, unit):
        """Keep it."""
        self.seen.append((frame.index, unit and unit.frame_index))
        return frame.index

    def send_requested(self, *, now_ns, held):
        """Nothing."""
        return set()

    def send(self, seen, *, now_ns, held):
        """Nothing."""
        self.sends += 1
        return set()

    def on_results(self, results, *, detected=None):
        """Keep which frame the ground spoke of, and after how many frames."""
        if detected is not None:
            self.detected.append((self.sends, detected.frame_index))


def test_ticks_that_are_not_coded_are_seen_and_not_waited_for():
    """With ``--fps auto`` a run in lockstep would stand still for 20 s at the first frame that was never sent."""
    ground, stills, counts, keyframes = Ground(), Stills(), FrameCounts(), Keyframes()
    stage = make_base_stage(
        BaseEncoder(EncoderSettings(size=SIZE, fps=5.0, bitrate_bps=100_000, preset="ultrafast")),
        make_transmitter(
            ground, budget=RollingBudget(BudgetSettings(800_000, 400_000, fps=5)), lockstep=True
        ),
        keyframes=keyframes,
        frame_skip=FrameSkip(3),
    )
    clock = LoopClock(lambda: 0, lockstep=True)
    with LockstepPace(
        stage,
        stills,
        inbox=ground.inbox,
        keyframes=keyframes,
        clock=clock,
        fps=15,
        counts=counts,
        has_ground=lambda: True,
        stop=threading.Event(),
    ) as pace:
        for frame in framed(smooth_pictures(50, size=SIZE)):
            pace.step(frame)
            assert clock() == frame.capture_ns, "media time"
    assert ground.frames == list(range(0, 50, 3))
    assert stills.seen == [(index, None if index % 3 else index) for index in range(50)]
    assert counts.encoded == 17
    # The ground is always done at once; what it says of a frame counts a second later, in every run the same.
    assert stills.detected == [*((frame + 15, frame) for frame in range(0, 35, 3)), (50, 48)]
