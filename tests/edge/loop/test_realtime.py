"""The frame loop in real time: video goes on whatever happens behind it."""

import threading
import weakref
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from hvt_common.protocol.messages import BaseHeader
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures
from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.realtime import RealtimePace
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.source.contract import IDLE_S
from hvt_edge.stills.worker import SkippedUnits
from hvt_edge.video.encoder import EncoderSettings
from hvt_edge.video.x265 import BaseEncoder
from media.clips import START_NS, framed, smooth_pictures
from programs.processes import eventually
from rigs.messages import counted, feedback
from rigs.world import QuietStills, make_base_stage, make_transmitter

SIZE = (320, 192)


class SteppedTime(threading.Event):
    """A clock that stands still but for what is put into it, and the wait of a loop that goes by it."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = START_NS

    def __call__(self) -> int:
        return self.now_ns

    def wait(self, timeout: float | None = None) -> bool:
        self.pass_s(timeout)
        return self.is_set()

    def pass_s(self, seconds: float) -> None:
        self.now_ns += round(seconds * SECOND_NS)


class Out:
    """Keeps the headers of base frames; ``blocks_s(count)`` is how long the link takes for the next."""

    def __init__(self, blocks_s=lambda _count: 0.0) -> None:
        self.time, self.blocks_s = SteppedTime(), blocks_s
        self.headers: list[BaseHeader] = []

    def put(self, channel, payload, *, attachment=None, encoding="") -> None:
        self.time.pass_s(self.blocks_s(len(self.headers)))
        self.headers.append(BaseHeader.parse(attachment, payload))


class BlockedStills(QuietStills):
    """Decodes what it is given; sending its first still takes until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.released, self.decoder, self.decoded = threading.Event(), BaseDecoder(), 0

    def analyze(self, frame, unit, skipped=()):
        for one in (*skipped, unit):
            self.decoded += self.decoder.decode(one.data) is not None
        return super().analyze(frame, unit)

    def step(self, seen, **moment):
        assert self.released.wait(60)
        return super().step(seen, **moment)


def paced(out: Out, stills: QuietStills, **parts) -> RealtimePace:
    """The loop of a clip at 15 frames a second, with real x265; ``parts`` are in place of its own."""
    encoder = BaseEncoder(EncoderSettings(size=SIZE, fps=15, bitrate_bps=100_000, preset="ultrafast"))
    plain = {"inbox": FeedbackInbox(), "clock": out.time, "stop": out.time, "failures": Failures(out.time)}
    plain |= {"fps": 15, "live": False, "counts": FrameCounts()}
    return RealtimePace(make_base_stage(encoder, make_transmitter(out)), stills, **(plain | parts))


def test_a_still_that_blocks_for_seconds_costs_no_frame_of_video():
    """The picture would freeze a second after a still met a full link, and thaw when the link does."""
    out, stills, inbox = Out(), BlockedStills(), FeedbackInbox()
    inbox.on_report(counted(feedback(last_frame_index=0, objects_detected=7), now_ns=1))
    frames = list(framed(smooth_pictures(60, size=SIZE)))
    with paced(out, stills, inbox=inbox, clock=SteadyClock(), live=True, stop=threading.Event()) as pace:
        for frame in frames[:50]:  # more than three seconds
            pace.step(frame)
        assert (len(out.headers), pace.counts.groups) == (50, {"sent": 50})
        assert pace.counts.unanalyzed > 40, "no more than half a second of frames waits to be tracked through"
        stills.released.set()
        for frame in frames[50:]:
            pace.step(frame)
        eventually(lambda: len(stills.seen) == 60 - pace.counts.unanalyzed)
    assert len(out.headers) == 60
    assert [said.objects for _, said in stills.detected] == [7]
    assert stills.decoded == max(stills.seen)[0] + 1, "no unit is missing before any frame that was analyzed"


def test_frames_missed_count_for_the_link_or_for_the_machine():
    """Who flies would buy a faster computer for a thin link."""
    out, (first, second, third, fourth) = Out(), framed(smooth_pictures(4, size=SIZE))
    with paced(out, QuietStills(), live=True) as pace:
        counts = pace.counts
        pace.step(first, missed=4)
        assert counts.groups == {"sent": 1}, "what came before the first is nobody's fault"
        out.blocks_s = lambda _count: 0.5
        pace.step(second, missed=4)
        out.blocks_s = lambda _count: 0.0
        pace.step(third, missed=9)
        assert (counts.groups["link"], counts.dropped_cpu) == (5, 0)
        pace.step(fourth, missed=12)
        assert (counts.groups["link"], counts.dropped_cpu, counts.captured) == (5, 3, 4 + 8)
        assert counts.unanalyzed == 1, "perception gave way where video was late, and not where the link was"


def play_clip(
    *, reading_s: float, frames: int, out: Out, coded: bool = False, slow: int = 1000
) -> FrameCounts:
    """A clip at 15 fps, ``coded`` by a camera or not, each frame of which takes so long to read, and x265.

    One frame in ``slow`` takes two and a half times the time between two.
    """
    with paced(out, QuietStills()) as pace:
        for index, frame in enumerate(framed(smooth_pictures(1, size=SIZE) * frames)):
            out.time.pass_s(2.5 / 15 if index % slow == slow - 1 else reading_s)
            pace.step(replace(frame, camera_unit=unit(index)) if coded else frame)
            assert pace.counts.captured == index + 1
    return pace.counts


def test_the_loop_turns_while_a_clip_of_few_frames_waits_for_the_next():
    """A requested still, a report and a command's rate waited for it: 10 s at one frame in 10 s."""
    out, turns = Out(), list[int | None]()
    with paced(out, QuietStills(), fps=0.1) as pace:
        for frame in pace.steps(framed(smooth_pictures(3, size=SIZE), fps=0.1)):
            turns.append(frame and frame.index)
            pace.step(frame)
            if len(turns) == 45:
                out.time.set()
    assert turns == [0, *[None] * 39, 1, *[None] * 4, 2], "it is stopped in its second wait"
    assert [one.send_delay_ns for one in out.headers[:2]] == [0, 0]


@pytest.mark.parametrize("live", [False, True])
def test_no_frame_is_held_while_the_next_is_read(live):
    """The memory of a small board would have to hold one 1080p frame more."""
    pictures, held = list[weakref.ref[Any]](), list[int]()

    def read(index: int) -> Frame:
        held.extend(before for before, picture in enumerate(pictures) if picture() is not None)
        picture = np.zeros((8, 8, 3), np.uint8)
        pictures.append(weakref.ref(picture))
        return Frame(index, START_NS, picture, picture)

    with paced(Out(), QuietStills(), live=live) as pace:
        for frame in pace.steps(map(read, range(3))):
            del frame  # as the edge does
    assert (len(pictures), held) == (3, [])


@pytest.mark.parametrize("reading_s", [0.1, 0.4, 3.0])
def test_a_clip_that_cannot_be_read_in_real_time_is_played_slower(reading_s):
    """The delay grew for ever (161 s were seen); or capture times, rates and length would be untrue."""
    frames = 150
    out = Out()
    counts = play_clip(reading_s=reading_s, frames=frames, out=out)
    took_s = (out.time.now_ns - START_NS) / SECOND_NS
    assert took_s == pytest.approx(frames * reading_s), "nothing waits where all is late"
    assert counts.paused_ns / SECOND_NS == pytest.approx(took_s - frames / 15, abs=1.1)
    assert counts.duration_s(15) == pytest.approx(took_s, abs=max(1.3, reading_s))
    captures = [one.capture_ns for one in out.headers]
    assert max(one.send_delay_ns for one in out.headers) <= SECOND_NS
    assert [one.frame_index for one in out.headers] == sorted({one.frame_index for one in out.headers})
    assert all(new > old for old, new in pairwise(captures))
    shown_at = [one.capture_ns + one.send_delay_ns for one in out.headers]
    most_s = 0.25 + reading_s
    assert max(new - old for old, new in pairwise(shown_at)) / SECOND_NS <= most_s + 1e-6, "none is away long"


def test_a_clip_that_waits_for_its_file_to_grow_blames_no_machine():
    """At the end of each flight with --follow the summary said that this machine is too slow; or frames were lost."""
    out = Out()

    def grows() -> Iterator[Frame | None]:
        for frame in framed(smooth_pictures(40, size=SIZE), fps=15):
            for _ in range(3 if frame.index in (10, 30) else 0):
                out.time.pass_s(IDLE_S)
                yield None
            yield frame

    with paced(out, QuietStills()) as pace:
        for frame in pace.steps(grows()):
            pace.step(frame)
    assert [one.frame_index for one in out.headers] == list(range(40))
    assert pace.counts.paused_ns / SECOND_NS == pytest.approx(6 * IDLE_S, abs=0.2)
    assert pace.counts.slow_ns == 0


def test_no_unit_of_a_camera_is_left_out_of_a_clip_that_is_read_too_slowly():
    """All that builds on it would be smear, up to the next keyframe."""
    out = Out()
    play_clip(reading_s=0.1, frames=60, out=out, coded=True)
    assert [one.frame_index for one in out.headers] == list(range(60))


def test_a_clip_that_can_be_read_in_real_time_keeps_its_time():
    """A short hiccup would shift all that follows, and the summary would blame the machine."""
    out = Out(lambda count: 0.8 if count == 20 else 0.02)
    counts = play_clip(reading_s=0.03, frames=90, out=out)
    assert counts.paused_ns == 0
    assert {one.capture_ns - START_NS for one in out.headers} <= {round(n * 1e9 / 15) for n in range(90)}


def test_a_frame_that_is_dear_to_code_now_and_then_costs_no_other():
    """A keyframe takes six times as long as others: each cost two frames on a board, with half of it idle."""
    assert play_clip(reading_s=0.03, frames=120, out=Out(), slow=40).groups == {"sent": 120}
    often = play_clip(reading_s=0.06, frames=120, out=Out(), slow=4)
    assert often.dropped_cpu > 20, "a machine that is too slow would gain delay"


@pytest.mark.parametrize(
    ("frames", "due_from_s", "waits"), [(160, None, range(146, 150)), (60, 1.0, range(11, 19))]
)
def test_the_detector_does_not_begin_just_before_a_keyframe_nor_waits_for_one_for_long(
    frames, due_from_s, waits
):
    """Both together take longer than the frames behind them can wait; for two seconds, boxes were three old."""
    stills, found = QuietStills(), []
    with paced(Out(), stills) as pace:
        if due_from_s is not None:
            pace.base.keyframes.due = lambda now_ns: now_ns >= START_NS + due_from_s * SECOND_NS
        for index, frame in enumerate(framed(smooth_pictures(1, size=SIZE) * frames)):
            pace.step(frame)
            found += [index] if stills.analyzer.cpu_budget.keyframe_soon else []
    assert found == list(waits)


class AskedBudget(CpuBudget):
    """Keeps whether the loop was late."""

    def __init__(self) -> None:
        super().__init__()
        self.late: list[bool] = []

    def admits_frame(self, at_ns, *, lost, late):
        self.late.append(late)
        return super().admits_frame(at_ns, lost=lost, late=late)


@pytest.mark.parametrize(("waits_s", "reading_s", "late"), [(1 / 15, 0.0, False), (0.0, 1 / 15, True)])
def test_perception_gives_way_to_a_slow_machine_alone(waits_s, reading_s, late):
    """Where video took all of the budget, each frame waited for its room: an idle machine had no boxes for good."""
    out, stills = Out(lambda count: waits_s if count else 0.12), QuietStills()
    stills.analyzer.cpu_budget = budget = AskedBudget()
    with paced(out, stills) as pace:
        for frame in framed(smooth_pictures(1, size=SIZE) * 60):
            out.time.pass_s(reading_s)
            pace.step(frame)
    assert set(budget.late[5:]) == {late}


def test_a_clip_behind_a_link_that_stood_still_catches_up():
    """The machine would be called too slow for an outage of the link."""
    out = Out(lambda count: 6.0 if count == 20 else 0.0)
    counts = play_clip(reading_s=0.005, frames=300, out=out)
    assert counts.paused_ns == 0
    delays_ns = [one.send_delay_ns for one in out.headers]
    assert max(delays_ns) > 5 * SECOND_NS
    assert max(delays_ns[-30:]) < SECOND_NS // 15


def unit(index: int, *, keyframe: bool = False, size: int = 1_000) -> AccessUnit:
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
