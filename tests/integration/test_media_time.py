"""An outage in media time: the edge's real stages, the laboratory's link, a ground that reports. Nothing sleeps."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import pytest

from lab.link.carriers.pipe import SEGMENT_BYTES, SEGMENT_HEADER_BYTES, Pipe, Segment, Stream
from lab.link.timeline import LinkState, Phase, Script
from media.clips import START_NS
from rigs.keeping import FRAMES, Ground, Rig

FRAME_S = 1 / 15
LIGHT = LinkState(rate_bps=1_000_000, delay_s=0.02)


class DistantGround(Ground):
    """A ground at the other end of one TCP connection: what was put arrives when the link has carried it."""

    def __init__(self, script: Script, *, now_ns: Callable[[], int], seed: int) -> None:
        super().__init__()
        self._now_ns = now_ns
        self._stream = Stream(Pipe(script, seed=seed))
        self._sent_s = 0.0
        self._under_way: deque[tuple[list[Segment], tuple]] = deque()
        self._base_came_s = 0.0
        self.latest_s = 0.0
        """The longest that a message was under way."""

    def take(self, *message) -> None:
        _, payload, attachment = message
        left, segments = len(payload) + len(attachment), []
        while left > 0:
            size = min(left, SEGMENT_BYTES)
            self._sent_s = self._stream.may_send_s(max(self._sent_s, self.now_s))
            segments.append(self._stream.segment(size + SEGMENT_HEADER_BYTES, self._sent_s))
            left -= size
        self._under_way.append((segments, (self.now_s, message)))

    def arrive(self) -> None:
        """What has come by now, in the order of sending."""
        while self._under_way:
            segments, (sent_s, message) = self._under_way[0]
            came_s = max(one.arrives_s for one in segments)
            if came_s > self.now_s:
                return
            self._under_way.popleft()
            self.latest_s, self._base_came_s = max(self.latest_s, came_s - sent_s), came_s
            super().take(*message)

    def report(self, now_ns: int):
        self.arrive()
        held_us = round(1e6 * (self.now_s - self._base_came_s))
        return replace(super().report(now_ns), base_held_us=held_us)

    @property
    def now_s(self) -> float:
        return (self._now_ns() - START_NS) / 1e9


@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.parametrize("dark_s", [1.0, 2.7])
def test_every_frame_and_still_arrives_whatever_the_outage_took(tmp_path, dark_s, loss):
    """The operator would never see what the drone saw while the link was away."""
    light = replace(LIGHT, loss=loss)
    dark = (Phase(2.0, replace(LIGHT, dark=True)), Phase(2.0 + dark_s, light))
    script = Script(phases=(Phase(0.0, light), *dark), lasts_s=60.0, queue_bytes=64_000)
    rig = Rig(tmp_path)
    ground = rig.out.ground = DistantGround(script, now_ns=lambda: rig.now_ns, seed=3)
    stills = set()
    for index in range(len(FRAMES)):
        rig.play(index, index + 1)
        if index % 7 == 3 and not script.at(ground.now_s).dark:
            stills.add(index // 7)
            rig.still(index // 7)
        if index % 3 == 2 and not script.at(ground.now_s).dark:
            rig.report()
    rig.finish()
    ground.arrive()
    assert set(rig.coded) == ground.frames | set(ground.backlog_frames)
    assert {index: rig.coded[index] for index in ground.backlog_frames} == ground.backlog_frames
    assert stills == ground.stills | ground.backlog_stills
    assert bool(ground.backlog_frames) == (dark_s > 2), "a short one is mended by the connection itself"
    assert all(count == 1 for count in ground.twice.values())
