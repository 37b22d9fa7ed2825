"""What became of each source frame, and the processor time that all would take."""

import math
import os
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.edge_words import FRAME_GROUPS, FrameAccount
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop import counts
from hvt_edge.loop.counts import CpuMeter, FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.loop.realtime import RealtimePace
from hvt_edge.operating import Keyframes, LoopClock
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.video.stage import Action, FrameDecision
from media.clips import framed, smooth_pictures
from rigs.world import Puts, QuietStills, make_base_stage, make_transmitter

SIZE = (128, 96)
FRAMES = list(framed(smooth_pictures(40, size=SIZE)))


class DrawnUnits:
    """An encoder of units without content, which fails while it is told to."""

    fails, mean_qp = False, 30.0

    def encode(self, frame, *, keyframe=False, regions=()):
        del regions
        if self.fails:
            raise RuntimeError("out of memory")
        return AccessUnit(frame.index, frame.capture_ns, bytes(200), keyframe)


class Flight:
    """A loop whose every outcome is decided from outside; time stands still."""

    def __init__(self, source: str, *, decimation: int) -> None:
        lockstep = source == "lockstep"
        self.counts, self.has_viewer, self.held_by = FrameCounts(), True, None
        self.unreadable = self.passed_over = self.missed = 0
        keyframes, inbox = Keyframes(), FeedbackInbox()
        self.stage = make_base_stage(
            DrawnUnits(),
            make_transmitter(Puts(), budget=(8_000_000, 4_000_000), lockstep=lockstep),
            keyframes=keyframes,
            frame_skip=FrameSkip(decimation),
            admits=lambda _now_ns, _line_bytes, _coding_ns: self.held_by is None,
            holder=lambda _now_ns: self.held_by,
            open_again=DrawnUnits,
            failures=Failures(time.time_ns),
        )
        common = {"inbox": inbox, "fps": 15, "counts": self.counts, "has_viewer": lambda: self.has_viewer}
        common["stop"] = threading.Event()
        self.now_ns = FRAMES[0].capture_ns
        if lockstep:
            common |= {"keyframes": keyframes, "clock": LoopClock(lambda: 0, lockstep=True)}
            self.pace = LockstepPace(self.stage, QuietStills(), has_ground=lambda: False, **common)
        else:
            common |= {"clock": lambda: self.now_ns, "live": source == "camera"}
            self.pace = RealtimePace(self.stage, QuietStills(), failures=Failures(time.time_ns), **common)
        self.counts.begin(self)

    @property
    def account(self) -> FrameAccount:
        return self.counts.account(coded_fps=7.5, auto_fps=True)


STEPS = st.lists(
    st.tuples(
        st.sampled_from([None, None, None, "budget", "link", "closer_look"]),
        st.booleans(),
        st.sampled_from([False] * 12 + [True]),
        st.integers(0, 3),
        st.integers(0, 2),
        st.integers(0, 2),
        st.sampled_from([0, 0, 40, 100, 400, 3000]),
    ),
    min_size=1,
    max_size=len(FRAMES),
)


@settings(max_examples=60)
@given(steps=STEPS, source=st.sampled_from(["lockstep", "camera", "clip"]), decimation=st.integers(1, 3))
def test_every_source_frame_is_in_one_group(steps, source, decimation):
    """The end would say "71 of 220" and be silent about the others; it may come at any frame, as by Ctrl-C."""
    flight = Flight(source, decimation=decimation)
    before_missed = came = 0
    failed_ns = -(2**62)
    with flight.pace as pace:
        for frame, (held_by, has_viewer, may_fail, missed, damaged, beyond, late_ms) in zip(
            FRAMES, steps, strict=False
        ):
            # Three failures within ten seconds end the flight.
            fails = may_fail and frame.capture_ns - failed_ns > 6 * 10**9
            failed_ns = frame.capture_ns if fails else failed_ns
            flight.held_by, flight.has_viewer = held_by, has_viewer
            DrawnUnits.fails = fails
            flight.missed += missed if source == "camera" else 0
            flight.unreadable += damaged
            flight.passed_over += beyond
            before = flight.account.groups
            flight.now_ns = max(flight.now_ns, frame.capture_ns + late_ms * 10**6)
            pace.step(frame, missed=flight.missed)
            flight.counts.note_source(flight)
            newly = 0 if not came else flight.missed - before_missed
            before_missed, came = flight.missed, came + 1 + newly + damaged + beyond
            account = flight.account
            assert account.came == came
            assert all(account.groups.get(name, 0) >= count for name, count in before.items())
            said = [int(one.split()[0]) for one in str(account).partition(": ")[2].split(", ")]
            assert sum(said) == came == int(str(account).split()[0]), str(account)
            written = account.as_dict()
            assert sum(written[group] for group in FRAME_GROUPS) == written["came"] == came
            assert FrameAccount.of_counts(account.as_counts(), coded_fps=7.5, auto_fps=True) == account
    sent = account.groups.get("sent", 0) + account.groups.get("nobody_listened", 0)
    assert sent == flight.counts.encoded


@pytest.mark.parametrize(
    ("decision", "given", "group"),
    [
        (FrameDecision(Action.SKIP), {"coded": False}, "frame_rate"),
        (FrameDecision(Action.HOLD), {"coded": False}, "budget"),
        (FrameDecision(Action.HOLD, held_by="link"), {"coded": False}, "link"),
        (FrameDecision(Action.HOLD, held_by="closer_look"), {"coded": False}, "closer_look"),
        (FrameDecision(Action.CODE, to_link=True), {"coded": False}, "encoder"),
        (FrameDecision(Action.CODE, to_link=True), {"coded": True}, "sent"),
        (FrameDecision(Action.CODE, to_link=True), {"coded": True, "has_viewer": False}, "nobody_listened"),
        (FrameDecision(Action.CODE, to_store=True), {"coded": True, "has_viewer": False}, "stored"),
        (FrameDecision(Action.CODE, to_store=True, to_link=True), {"coded": True}, "sent"),
        (FrameDecision(Action.CODE, to_store=True), {"coded": True, "taken": False}, "link"),
    ],
)
def test_the_group_of_a_frame(decision, given, group):
    """A thin budget would be called a thin link, and somebody buy another modem."""
    counts = FrameCounts()
    counts.settle(decision, **given)
    assert counts.groups == {group: 1}


def test_the_sentence_names_every_group():
    """A group without words would be missing from the sum that a reader makes."""
    account = FrameAccount(dict.fromkeys(FRAME_GROUPS, 2), coded_fps=7.5, auto_fps=True)
    assert str(account) == (
        "20 frames came: 2 sent, 2 coded while nobody listened, 2 stored for later, 2 left out by auto's 7.5 a "
        "second, 2 had no room in the budget, 2 the link did not carry, 2 the processor had no time for, "
        "2 left out for a closer look, 2 damaged at the source, 2 the encoder failed on"
    )
    assert account.as_dict()["came"] == 20
    assert str(FrameAccount()) == "no frame came"


def burn(seconds: float) -> None:
    """One core."""
    until = time.process_time() + seconds
    while time.process_time() < until:
        pass


@dataclass
class Machine:
    """Processor 0, the only one, as it is told to this process; time goes by where a test says so."""

    stat: Path
    wall_s: float = 0.0
    own_s: float = 0.0
    others_s: float = 0.0

    def passes(self, seconds: float, *, own_s: float, others_s: float = 0.0) -> None:
        """This process takes so much of it, and others so much."""
        self.wall_s += seconds
        self.own_s += own_s
        self.others_s += others_s
        hertz = os.sysconf("SC_CLK_TCK")
        own, others = round(self.own_s * hertz), round(self.others_s * hertz)
        self.stat.write_text(
            f"cpu 9 9 9 9 9 9 9 9 0 0\ncpu0 {own} 0 0 {7 * hertz} {8 * hertz} 0 0 {others} 0 0\n"
        )


@pytest.fixture
def machine(tmp_path, monkeypatch) -> Machine:
    made = Machine(tmp_path / "stat")
    made.passes(0.0, own_s=0.0)
    clocks = SimpleNamespace(monotonic=lambda: made.wall_s, process_time=lambda: made.own_s)
    for name, part in {"STAT": made.stat, "time": clocks, "usable_cores": lambda: {0}}.items():
        monkeypatch.setattr(counts, name, part)
    return made


def test_what_was_left_out_counts_as_needed(machine):
    """The summary would say that there was time enough, after it dropped half of the frames."""
    meter = CpuMeter()
    machine.passes(1.0, own_s=0.4)
    meter.measure(scale=3.0, short=True)
    assert (meter.now.needed, meter.now.taken) == pytest.approx((1.2, 0.4))
    short = meter.short
    assert short == meter.now
    machine.passes(1.0, own_s=0.2)
    meter.measure(scale=1.0, short=False)
    assert meter.now.needed == pytest.approx(0.2)
    assert meter.short == short, "only times of want count for the summary"


def test_a_core_that_another_process_takes_is_not_free(machine):
    """The summary would call cores free that the autopilot uses."""
    meter = CpuMeter()
    machine.passes(2.0, own_s=0.3, others_s=1.5)
    meter.measure(scale=1.0, short=True)
    assert meter.now.free == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("groups", "files", "processors"),
    [
        ("0::/", {"cpu.max": "50000 100000\n"}, 0.5),
        ("0::/a.slice/x", {"a.slice/x/cpu.max": "max 100000", "a.slice/cpu.max": "30000 100000"}, 0.3),
        (
            "1:cpu:/docker/ab\n0::/docker/ab",
            {"cpu/cpu.cfs_quota_us": "25000", "cpu/cpu.cfs_period_us": "100000"},
            0.25,
        ),
        (
            "4:cpu,cpuacct:/",
            {"cpu,cpuacct/cpu.cfs_quota_us": "-1\n", "cpu,cpuacct/cpu.cfs_period_us": "100000\n"},
            None,
        ),
        ("0::/", {"cpu.max": "max 100000"}, None),
        ("4:memory:/x", {"cpu.max": "1000 100000"}, None),
        (None, {}, None),
    ],
)
def test_a_containers_limit_is_known(tmp_path, monkeypatch, groups, files, processors):
    """Perception would take half of the host's processors, and video would have nothing left of half a one."""
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    if groups is not None:
        (tmp_path / "groups").write_text(groups)
    given = counts.quota(tmp_path / "groups", tmp_path)
    assert given == (processors or math.inf)
    monkeypatch.setattr(counts, "quota", lambda: given)
    every = len(os.sched_getaffinity(0))
    assert counts.processors() == (processors or every)
    meter = CpuMeter()
    burn(0.12)
    meter.measure(scale=1.0, short=False)
    assert meter.now.free <= (processors or every)


def test_video_and_perception_count_by_what_each_took(machine):
    """A detector that skipped half of its frames would count as if it had seen all."""
    came = Counter({"sent": 100})
    skipping = FrameCounts(groups=came, unanalyzed=50, encode_ns=1_000)
    whole = FrameCounts(groups=came, encode_ns=1_000)
    machine.passes(1.0, own_s=0.3)
    skipping.measure_cpu(perception_ns=3_000)
    whole.measure_cpu(perception_ns=3_000)
    assert skipping.cpu.now.needed / whole.cpu.now.needed == pytest.approx((1 + 2 * 3) / 4)
    assert skipping.cpu.short.needed > 0
    assert whole.cpu.short.needed == 0
