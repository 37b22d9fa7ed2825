"""One frame of the base stream after the other: real encoder, real budget, real file."""

import sys
import time
import weakref
from dataclasses import replace
from itertools import product

import av
import cv2
import numpy as np
import pytest

from hvt_archive.local_copy import LocalCopy
from hvt_common.errors import FlightError, UserError
from hvt_common.protocol.ledger import Ledger
from hvt_common.runtime.failures import Failures
from hvt_common.values import AccessUnit, Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.backlog.stage import State
from hvt_edge.config import EdgeConfig, check, least_budget_bps
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.operating import Keyframes, KeyframeSettings, Rates
from hvt_edge.video.encoder import CheckedEncoder, Encoder, EncoderPlan, EncoderSettings, encoder_settings
from hvt_edge.video.rate_model import FrameSkip, MeasuredFrameSkip
from hvt_edge.video.reconfigure import encoder_opener
from hvt_edge.video.stage import Action, FrameDecision, FrameInputs, decide
from hvt_edge.video.x265 import BaseEncoder, encoder_context
from hvt_edge.wiring.video import encoder_plan
from media.clips import START_NS, framed, hard_pictures, smooth_pictures
from rigs.world import Puts, make_base_stage, make_operating, make_transmitter

SIZE = (320, 192)
SECOND_NS = 1_000_000_000
SETTINGS = EncoderSettings(size=SIZE, fps=15.0, bitrate_bps=50_000, preset="ultrafast")


class Rig:
    """A base stage with all that it needs."""

    def __init__(
        self,
        *,
        frame_skip=None,
        recorder=None,
        interval_s=10.0,
        reconfigures=True,
        reopens=True,
        total_bps=800_000,
    ) -> None:
        self.kept, self.failures, self.reopened = Puts(), Failures(time.time_ns), 0
        self.opened: list[int] = []
        self.ledger = Ledger()
        self.frame_skip = frame_skip or FrameSkip()
        self.keyframes = Keyframes(KeyframeSettings(interval_ns=round(interval_s * SECOND_NS)))
        budget = (total_bps, total_bps // 2)
        self.stage = make_base_stage(
            BaseEncoder(replace(SETTINGS, fps=15.0 / self.frame_skip.decimation)),
            make_transmitter(self.kept, ledger=self.ledger, budget=budget, lockstep=True),
            keyframes=self.keyframes,
            local_copy=recorder,
            frame_skip=self.frame_skip,
            reconfigure=self._reconfigure if reconfigures else None,
            open_again=self._open_again if reopens else None,
            failures=self.failures,
        )

    def _open_again(self) -> BaseEncoder:
        self.reopened += 1
        return BaseEncoder(SETTINGS)

    def play(self, pictures, *, asks=()) -> list[int]:
        return stepped(self.stage, framed(pictures), asks=asks)

    def _reconfigure(self, decimation: int, now_ns: int) -> BaseEncoder | None:
        assert now_ns >= START_NS
        if decimation == (self.opened or [1])[-1]:
            return None
        self.opened.append(decimation)
        return BaseEncoder(replace(SETTINGS, fps=15.0 / decimation))


def stepped(stage, frames, *, asks=()) -> list[int]:
    """Indices of the frames that were coded; a ground requests a keyframe at ``asks``."""
    coded = []
    for frame in frames:
        if frame.index in asks:
            stage.keyframes.request(frame.capture_ns)
        decision = stage.decide(frame, now_ns=frame.capture_ns)
        if (unit := stage.encode(frame, decision, now_ns=frame.capture_ns)) is not None:
            assert unit.frame_index == frame.index
            stage.send(unit, decision, now_ns=frame.capture_ns)
            coded.append(frame.index)
    return coded


def test_frames_that_are_not_coded_cost_nothing_and_a_keyframe_waits_for_no_turn():
    """``--fps auto`` would save no bit, or a ground that joins look at nothing for longer than promised."""
    rig = Rig(frame_skip=FrameSkip(8))
    rig.opened.append(8)
    assert rig.play(smooth_pictures(30, size=SIZE), asks=(10,)) == [0, 8, 10, 18, 26]
    assert len(rig.kept.units) == 5
    assert BaseDecoder().decode(rig.kept.units[2]) is not None, "it is a keyframe"


def starving() -> MeasuredFrameSkip:
    """Decides after a second; the clip below never reaches a fine quantiser."""
    return MeasuredFrameSkip(1, most_decimation=5, rest_frames=15, window_frames=15)


def test_the_rate_changes_with_a_keyframe_and_every_decoder_follows():
    """The picture would freeze, or turn to garbage, as soon as ``--fps auto`` decides."""
    rig = Rig(frame_skip=starving(), interval_s=2.0)
    pictures = hard_pictures(150, size=SIZE)
    coded = rig.play(pictures)
    assert rig.opened
    assert rig.frame_skip.decimation > 1
    assert len(coded) < 150
    decoder = BaseDecoder()
    for index, data in zip(coded, rig.kept.units, strict=True):
        decoded = decoder.decode(data)
        assert decoded is not None
        assert np.abs(decoded.astype(np.float64) - pictures[index]).mean() < 40
    gaps = np.diff(coded)
    changed = int(np.argmax(gaps > 1))
    later = BaseDecoder()
    assert all(later.decode(data) is not None for data in rig.kept.units[changed:]), "a ground may join there"


def test_a_recording_keeps_its_times_across_a_change(tmp_path):
    """The flight's video on the drone would run at the wrong speed after the first change."""
    path = tmp_path / "base.mkv"
    with LocalCopy(path, failures=Failures(time.time_ns)) as recorder:
        rig = Rig(frame_skip=starving(), recorder=recorder, interval_s=2.0)
        coded = rig.play(hard_pictures(90, size=SIZE))
    assert rig.opened
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    assert len(frames) == len(coded)
    shown_s = [float(frame.pts * frame.time_base) for frame in frames]
    np.testing.assert_allclose(shown_s, np.array(coded) / 15, atol=0.002)


def test_a_change_without_a_new_encoder_is_a_bug_that_shows():
    """x265 would go on as if all frames came, and spend a third of its bits."""
    rig = Rig(frame_skip=starving(), interval_s=2.0, reconfigures=False, reopens=False)
    with pytest.raises(AssertionError, match="another encoder"):
        rig.play(hard_pictures(120, size=SIZE))


BROKEN = np.zeros((4, 4), np.uint8)
"""A picture without colours: PyAV refuses it."""


def test_an_encoder_that_fails_is_opened_again_on_a_keyframe():
    """One bad picture would end the flight, or leave grounds with frames that nothing they have explains."""
    rig, frames = Rig(), list(framed(smooth_pictures(12, size=SIZE)))
    frames[5] = replace(frames[5], base_bgr=BROKEN)
    assert stepped(rig.stage, frames) == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    assert rig.reopened == 1
    decoder = BaseDecoder()
    assert decoder.decode(rig.kept.units[5]) is not None, "who joins there sees a picture"
    (failed,) = rig.failures.parts
    assert (failed.part, failed.count, failed.working) == ("encoder", 1, True)
    assert rig.keyframes.sent == 2


def test_three_failures_in_ten_seconds_end_the_process_with_a_sentence():
    """An edge without video would look alive for hours."""
    rig, frames = Rig(), list(framed(smooth_pictures(12, size=SIZE)))
    for index in (3, 5, 7):
        frames[index] = replace(frames[index], base_bgr=BROKEN)
    with pytest.raises(
        FlightError, match=r"x265 failed 3 times within 10 s .*: there is no video without it"
    ):
        stepped(rig.stage, frames)
    rig = Rig()
    slow = [replace(frame, capture_ns=START_NS + frame.index * 4 * SECOND_NS) for frame in frames]
    assert stepped(rig.stage, slow) == [0, 1, 2, 4, 6, 8, 9, 10, 11], "three in a minute do not"


def test_the_device_of_an_encoder_that_failed_is_free_before_each_try_to_open_another(monkeypatch):
    """A board whose encoder stumbled once, and takes one at a time, would end the flight."""
    there: weakref.WeakSet[Encoder] = weakref.WeakSet()
    busy: list[int] = []

    class Broken:
        mean_qp = 30.0

        def __init__(self) -> None:
            there.add(self)

        def encode(self, frame, *, keyframe=False, regions=()):
            sys.exit("the device hangs")

    def make(*_given, **_settings) -> Encoder:
        busy.append(len(there))
        if len(busy) == 2:
            raise UserError("not at this moment")
        return CheckedEncoder(Broken()) if len(busy) == 1 else BaseEncoder(SETTINGS)

    monkeypatch.setattr(EncoderPlan, "open", make)
    config = check(EdgeConfig(source="demo"))
    operating, rates = make_operating(config), Rates(800_000, 400_000, 1)
    opened = encoder_opener(encoder_plan(config, SIZE), operating)
    rig = Rig()
    rig.stage.encoder, rig.stage.open_again = opened(rates), lambda: opened(rates)
    assert stepped(rig.stage, framed(smooth_pictures(3, size=SIZE))) == [1, 2]
    assert busy == [0, 0, 0]


def test_in_lockstep_a_failing_encoder_is_an_error():
    """A study would compare a clip with holes in it."""
    rig = Rig(reopens=False)
    with pytest.raises(ValueError, match="ndim"):
        stepped(
            rig.stage, [replace(frame, base_bgr=BROKEN) for frame in framed(smooth_pictures(1, size=SIZE))]
        )


def test_no_encoder_at_all_is_one_sentence():
    """A build of PyAV without x265 would end in a traceback."""
    with pytest.raises(UserError, match=r"PyAV .* has no encoder libx265-lost"):
        encoder_context("libx265-lost", SETTINGS, pixel_format="yuv420p")


def test_a_keyframe_that_no_window_holds_is_coded_again_with_less_detail():
    """It would break the budget, or there would be no picture of a scene with much texture."""
    small = np.random.default_rng(1).integers(0, 256, (SIZE[1] // 3, SIZE[0] // 3, 3), np.uint8)
    pictures = [cv2.resize(small, SIZE, interpolation=cv2.INTER_CUBIC)] * 30
    plain = Rig()
    plain.play(pictures[:1])
    tight = Rig(total_bps=round(0.85 * 8 * len(plain.kept.units[0])))
    tight.play(pictures)
    assert tight.kept.units
    assert BaseDecoder().decode(tight.kept.units[0]) is not None
    assert tight.ledger.worst_window_bps.total <= tight.stage.transmitter.budget.total_bps
    assert tight.failures.parts == ()


def test_what_has_room_nowhere_is_left_out_said_and_followed_by_a_keyframe():
    """The edge would end, or a ground show what builds on a picture that it never got."""
    rig = Rig(total_bps=4_000)
    pictures = smooth_pictures(6, size=SIZE)
    rig.play(pictures[:3])
    assert rig.kept.units == []
    (part,) = rig.failures.parts
    assert (part.part, part.working, part.count) == ("video", False, 3)
    assert "raise --budget, or lower --size" in part.reason
    rig.stage.transmitter.budget.set_total(800_000, 400_000, 15, now_ns=START_NS)
    rig.play(pictures)
    assert BaseDecoder().decode(rig.kept.units[0]) is not None, "it begins with a keyframe"
    assert rig.failures.parts[0].working


@pytest.mark.parametrize(
    "size", [(160, 128), (320, 192), pytest.param((640, 360), marks=pytest.mark.nightly)]
)
@pytest.mark.parametrize("fps", [2, pytest.param(5, marks=pytest.mark.nightly), 15])
@pytest.mark.parametrize("above", [1.0, 1.5])
def test_the_least_budget_that_is_accepted_holds_in_every_second_to_the_byte(size, fps, above):
    """A thin link would get twice what it carries with each keyframe."""
    config = EdgeConfig(source="demo", method="M0", fps=fps, size=size, video_share=1.0)
    total_bps = round(above * least_budget_bps(config, size, share=1.0))
    kept, ledger, failures = Puts(), Ledger(), Failures(time.time_ns)
    settings = encoder_settings(
        size=size, fps=fps, preset="ultrafast", total_bps=total_bps, base_bps=total_bps, edge_id="edge-1"
    )
    budget = RollingBudget(BudgetSettings(total_bps, total_bps, fps=fps))
    stage = make_base_stage(
        BaseEncoder(settings),
        make_transmitter(kept, ledger=ledger, budget=budget, edge_id="edge-1", lockstep=True),
        first_keyframe_bytes=total_bps // 40,
        failures=failures,
    )
    pictures = hard_pictures(12 * fps, size=size)
    stepped(stage, framed(pictures, fps=fps), asks=range(fps, 12 * fps, 4 * fps))
    assert ledger.worst_window_bps.total <= total_bps
    assert len(kept.units) > 0.9 * len(pictures), "and there is a picture"


class SizedEncoder:
    """As many bytes as it is told to."""

    mean_qp = 30.0

    def encode(self, frame: Frame, *, keyframe: bool, regions: list[object]) -> AccessUnit:
        assert not regions
        return AccessUnit(frame.index, frame.capture_ns, bytes(20_000 if keyframe else 6_200), keyframe)


def test_a_keyframe_that_a_ground_waits_for_has_the_room_of_the_frames_before_it():
    """Video that fills its budget would keep it waiting for 0.6 s, with frames that the ground cannot show."""
    kept, keyframes = Puts(), Keyframes(KeyframeSettings(interval_ns=0))
    transmitter = make_transmitter(kept, budget=(800_000, 790_000), lockstep=True)
    stage = make_base_stage(SizedEncoder(), transmitter, keyframes=keyframes, first_keyframe_bytes=20_500)
    stepped(stage, framed([np.zeros((2, 2, 3), np.uint8)] * 60), asks=(30,))
    first, second = (one.frame_index for one in kept.base if one.keyframe)
    assert first == 0
    assert second <= 33


LIVE, OFFLINE, RETURNING = State.LIVE, State.OFFLINE, State.RETURNING
SKIP, HOLD = FrameDecision(Action.SKIP), FrameDecision(Action.HOLD)
TO_LINK = FrameDecision(Action.CODE, to_link=True)
KEY_TO_LINK = FrameDecision(Action.CODE, keyframe=True, to_link=True, meets_plan=True)
RESUME = FrameDecision(Action.CODE, keyframe=True, to_link=True, meets_plan=True, resumes=True)
TO_STORE = FrameDecision(Action.CODE, to_store=True)
KEY_TO_STORE = FrameDecision(Action.CODE, keyframe=True, to_store=True, meets_plan=True)
SEGMENT = FrameDecision(Action.CODE, keyframe=True, to_store=True)
PROBE = FrameDecision(Action.CODE, to_link=True, to_store=True)
ANY = (False, True)
NO, YES = (False,), (True,)

# link, keyframe due, frame due, admitted, segment due, probe due: what is decided. ANY: it does not matter.
TABLE = [
    (LIVE, NO, NO, ANY, ANY, ANY, SKIP),
    (LIVE, NO, YES, NO, ANY, ANY, HOLD),
    (LIVE, NO, YES, YES, ANY, ANY, TO_LINK),
    (LIVE, YES, ANY, NO, ANY, ANY, HOLD),
    (LIVE, YES, ANY, YES, ANY, ANY, KEY_TO_LINK),
    (OFFLINE, NO, NO, ANY, NO, ANY, SKIP),
    (OFFLINE, NO, YES, ANY, NO, NO, TO_STORE),
    (OFFLINE, NO, YES, NO, NO, YES, TO_STORE),
    (OFFLINE, NO, YES, YES, NO, YES, PROBE),
    (OFFLINE, YES, ANY, ANY, ANY, NO, KEY_TO_STORE),
    (OFFLINE, NO, ANY, ANY, YES, NO, KEY_TO_STORE),
    (OFFLINE, YES, ANY, NO, ANY, YES, KEY_TO_STORE),
    (OFFLINE, NO, ANY, NO, YES, YES, KEY_TO_STORE),
    (OFFLINE, YES, ANY, YES, ANY, YES, FrameDecision(Action.CODE, True, True, True, True)),
    (OFFLINE, NO, ANY, YES, YES, YES, FrameDecision(Action.CODE, True, True, True, True)),
    (RETURNING, YES, ANY, YES, ANY, ANY, RESUME),
    (RETURNING, YES, NO, NO, NO, ANY, SKIP),
    (RETURNING, YES, YES, NO, NO, ANY, TO_STORE),
    (RETURNING, YES, ANY, NO, YES, ANY, SEGMENT),
    (RETURNING, NO, NO, ANY, NO, ANY, SKIP),
    (RETURNING, NO, YES, ANY, NO, ANY, TO_STORE),
    (RETURNING, NO, ANY, ANY, YES, ANY, SEGMENT),
]


@pytest.mark.parametrize("row", TABLE, ids=[str(number) for number in range(len(TABLE))])
def test_each_row_of_the_table(row):
    """A frame would be missing between what was sent and what was stored, or a ground be shown what it cannot."""
    link, keyframe_due, due, admitted, segment_due, probe_due, expected = row
    for one in product(due, keyframe_due, admitted, segment_due, probe_due):
        inputs = FrameInputs(*one[:3], link=link, segment_due=one[3], probe_due=one[4])
        assert decide(inputs) == expected, inputs


def test_the_table_leaves_no_case_out_and_decides_none_twice():
    """One combination in flight that nobody thought of would be decided by accident."""
    seen = [
        (link, *one)
        for link, keyframe_due, due, admitted, segment_due, probe_due, _ in TABLE
        for one in product(keyframe_due, due, admitted, segment_due, probe_due)
    ]
    assert len(seen) == len(set(seen)) == 3 * 2**5


def test_rates_change_at_keyframes_for_the_link_alone():
    """What is stored would change its quality, or the stream on the link its parameters in mid-GOP."""
    assert [one.reconfigures for one in (TO_LINK, KEY_TO_LINK, RESUME, TO_STORE, KEY_TO_STORE, SEGMENT)] == [
        False, True, True, False, False, False,
    ]  # fmt: skip
    assert [one.codes for one in (SKIP, HOLD, TO_LINK, SEGMENT)] == [False, False, True, True]
