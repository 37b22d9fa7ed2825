"""What became of each source frame: the loop's account against the frames that it was given."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hvt_common.protocol.edge_words import FRAME_GROUPS, FrameAccount
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.loop.counts import FrameCounts
from hvt_edge.loop.lockstep import LockstepPace
from hvt_edge.loop.realtime import RealtimePace
from hvt_edge.operating import Keyframes, LoopClock
from hvt_edge.perception.cpu_budget import CpuBudget
from hvt_edge.stills.outbox import Outbox
from hvt_edge.video.rate_model import FrameSkip
from hvt_edge.video.stage import Action, FrameDecision
from media.clips import framed, smooth_pictures
from rigs.world import Puts, make_base_stage, make_transmitter

SIZE = (128, 96)
FRAMES = list(framed(smooth_pictures(40, size=SIZE)))


class Unmoved:
    """Perception that finds nothing."""

    latest_tracks, outbox, analyzer = None, Outbox(), SimpleNamespace(cpu_budget=CpuBudget())

    def capture(self, frame):
        """Nobody asks for a still of it."""

    def is_used(self, capture_ns):
        """Somebody looks at what comes of it."""
        return True

    def analyze(self, frame, unit, skipped=()):
        """Nothing."""
        return frame.index

    def send_requested(self, *, now_ns, held):
        """Nothing."""
        return set()

    def step(self, seen, *, now_ns, held=None):
        """Nothing."""
        return set()

    def on_results(self, results, *, detected=None):
        """Nothing."""


class DrawnUnits:
    """An encoder of units without content, which fails while it is told to."""

    fails, mean_qp = False, 30.0

    def encode(self, frame, *, keyframe=False, regions=()):
        """One frame."""
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
        self.now_ns = FRAMES[0].capture_ns
        self.pace = (
            LockstepPace(
                self.stage, Unmoved(), keyframes=keyframes, clock=LoopClock(lambda: 0, lockstep=True),
                has_ground=lambda: False, stop=threading.Event(), **common,
            )
            if lockstep
            else RealtimePace(
                self.stage, Unmoved(), clock=lambda: self.now_ns, live=source == "camera", stop=threading.Event(),
                failures=Failures(time.time_ns), **common,
            )
        )  # fmt: skip
        self.counts.begin(self)

    @property
    def account(self) -> FrameAccount:
        """What is said now."""
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


@settings(max_examples=60, deadline=None)
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
