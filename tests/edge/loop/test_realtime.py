"""The frame loop in real time: video goes on whatever happens behind it."""

from __future__ import annotations

import threading
import time

import pytest

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.realtime import RealtimePace
from hvt_edge.operating.keyframes import KeyframeRequests
from hvt_edge.stills.worker import SkippedUnits
from hvt_edge.video.encoder_settings import EncoderSettings
from hvt_edge.video.stage import BaseStage
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, smooth_pictures

SIZE = (320, 192)


class Out:
    """Counts base frames."""

    def __init__(self) -> None:
        self.units = 0

    def put(self, channel, payload, *, attachment=None, encoding="") -> None:
        """One message."""
        self.units += channel is Channel.BASE


class BlockedStills:
    """Decodes what it is given; sending its first still takes until it is released."""

    def __init__(self) -> None:
        self.latest_tracks, self.any_pending = None, False
        self.released, self.decoder = threading.Event(), BaseDecoder()
        self.frames: list[int] = []
        self.decoded = 0

    def analyze(self, frame, unit, skipped=(), *, hurry):
        """As `Analyzer.analyze` does: all units, in their order."""
        for one in (*skipped, unit):
            self.decoded += self.decoder.decode(one.data) is not None
        self.frames.append(frame.index)

    def send(self, seen, *, now_ns):
        """A ``put`` that blocks."""
        assert self.released.wait(60)

    def on_results(self, results):
        """Nothing."""


@pytest.mark.timeout(120)
def test_a_still_that_blocks_for_seconds_costs_no_frame_of_video():
    """The picture would freeze a second after a still met a full link, and thaw when the link does."""
    out, stills, counts = Out(), BlockedStills(), FrameCounts()
    base = BaseStage(
        BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=100_000, preset="ultrafast")),
        keyframes=KeyframeRequests(),
        transmitter=Transmitter(
            out,
            ledger=Ledger(),
            budget=RollingBudget(BudgetSettings(800_000, 400_000, fps=15)),
            edge_id="uav-1",
            session_id=1,
            lockstep=False,
            wait_until=lambda _at_ns: None,
        ),
        local_copy=None,
        first_keyframe_bytes=5000,
    )
    frames = list(framed(smooth_pictures(60, size=SIZE)))
    with RealtimePace(
        base, stills, inbox=FeedbackInbox(), clock=SteadyClock(), fps=15, live=True, counts=counts,
        stop=threading.Event(), failures=Failures(time.time_ns),
    ) as pace:  # fmt: skip
        for frame in frames[:50]:  # more than three seconds
            pace.step(frame)
        assert (out.units, counts.dropped) == (50, 0)
        assert counts.unanalyzed > 20
        stills.released.set()
        for frame in frames[50:]:
            pace.step(frame)
    assert out.units == 60
    assert stills.decoded == max(stills.frames) + 1, "no unit is missing before any frame that was analyzed"


def unit(index: int, *, keyframe: bool = False, size: int = 1_000) -> AccessUnit:
    """An access unit."""
    return AccessUnit(index, index, bytes(size), keyframe)


def test_what_was_skipped_is_bounded_and_decoding_goes_on_at_a_keyframe():
    """A link that is full for minutes would fill the memory; or the decoder would be given what it cannot use."""
    skipped = SkippedUnits()
    skipped.add(unit(1))
    skipped.add(None)
    assert skipped.take(None) == (None, ()), "a frame that is not coded needs nothing yet"
    assert skipped.take(unit(3)) == (unit(3), (unit(1),))
    assert skipped.take(unit(4)) == (unit(4), ())
    for index in range(5, 10):
        skipped.add(unit(index, size=2**19))
    assert skipped.take(unit(10)) == (None, ())
    skipped.add(unit(11, keyframe=True))
    skipped.add(unit(12))
    assert skipped.take(unit(13)) == (unit(13), (unit(11, keyframe=True), unit(12)))
    skipped.add(unit(14))
    assert skipped.take(unit(15, keyframe=True)) == (unit(15, keyframe=True), ())
