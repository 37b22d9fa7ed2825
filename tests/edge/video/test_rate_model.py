"""From a rate, a quantiser and processor time to size, frame rate and preset of the base stream."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvt_common.errors import UserError
from hvt_common.values import Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.config import EdgeConfig, check
from hvt_edge.operating import Operating
from hvt_edge.video.encoder import EncoderPlan
from hvt_edge.video.rate_model import (
    PROMPT,
    FrameSkip,
    MeasuredFrameSkip,
    PresetControl,
    better_decimation,
    choose_base,
    choose_preset,
    most_decimation,
    share_of,
    sizes_of,
)
from hvt_edge.video.reconfigure import encoder_opener
from hvt_edge.video.x265 import BaseEncoder
from hvt_edge.wiring.video import encoder_plan, make_reconfiguration

CAMERA = (1920, 1080)


def chosen(payload_bps, *, source=CAMERA, size=None, fps=None, most_fps=15.0):
    """Size and n."""
    return choose_base(payload_bps, source, size=size, fps=fps, most_fps=most_fps)


def test_what_the_user_sets_stays_as_it_is():
    """``--size`` and ``--fps`` would be ignored."""
    assert chosen(100_000, size=(640, 360), fps=30.0) == ((640, 360), 1)
    assert chosen(100_000, size=(4000, 3000), fps=5.0)[0] == (4000, 3000)
    assert chosen(10_000_000, size=(640, 360)) == ((640, 360), 1)


def test_fewer_bits_mean_fewer_frames():
    """At a thin rate each frame would be mud; at a rich one motion would be lost for nothing."""
    steps = [chosen(kbps * 1000, size=(1280, 720))[1] for kbps in (60, 100, 150, 200, 300, 400, 800, 1400)]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] >= 3
    assert steps[-1] == 1


def test_fewer_bits_never_mean_a_larger_picture():
    """The rate of a better link would buy a worse picture."""
    areas = [
        wide * high for wide, high in (chosen(kbps * 1000)[0] for kbps in (20, 60, 100, 200, 400, 800, 4000))
    ]
    assert areas == sorted(areas)
    assert areas[0] < areas[-1]


@given(
    payload_bps=st.floats(1_000, 50_000_000),
    source=st.tuples(st.integers(64, 8192), st.integers(64, 8192)),
    most_fps=st.floats(0.5, 60),
    fps=st.none() | st.floats(0.5, 60),
)
def test_what_is_chosen_can_be_coded(payload_bps, source, most_fps, fps):
    """The edge would refuse, or distort, what it has chosen itself."""
    (width, height), decimation = choose_base(payload_bps, source, size=None, fps=fps, most_fps=most_fps)
    assert (width % 2, height % 2) == (0, 0)
    assert 64 <= width <= source[0]
    assert 64 <= height <= source[1]
    assert abs(width / height - source[0] / source[1]) < 0.04 * source[0] / source[1]
    assert decimation == 1 or (fps is None and most_fps / decimation >= 2)


def test_the_ladder_keeps_the_source_s_shape():
    """A circle would become an egg, or black bars would be coded."""
    assert sizes_of((1920, 1080)) == [(1280, 720), (960, 540), (640, 360), (480, 270), (320, 180)]
    assert sizes_of((1280, 720))[0] == (1280, 720)
    assert sizes_of((1100, 720))[0] == (1100, 720)
    assert sizes_of((3840, 2160))[0] == (1280, 720)
    assert sizes_of((64, 64)) == [(64, 64)]


def test_a_source_too_small_is_one_sentence():
    """A traceback out of x265."""
    with pytest.raises(UserError, match="the source has 60x40 pixels"):
        sizes_of((60, 40))


def test_the_quantiser_moves_the_rate_the_right_way():
    """A starved scene would get more frames still."""
    for before, mean_qp, after in ((1, 34, 2), (1, 45, 3), (5, 45, 5), (3, 29, 3), (3, 22, 2), (1, 20, 1)):
        assert better_decimation(before, mean_qp=mean_qp, most_decimation=5) == after


def test_two_frames_a_second_are_left():
    """A budget's window of a second would be empty, or filled by a single frame."""
    assert [most_decimation(fps) for fps in (15, 30, 4, 1)] == [5, 15, 2, 1]


def coded(frame_skip: FrameSkip, frames, *, keyframes=(), qp=40.0) -> list[int]:
    """The frames that are coded; at keyframes the decimation may change."""
    taken = []
    for index in frames:
        keyframe = index in keyframes
        if keyframe:
            frame_skip.at_keyframe(index)
        if keyframe or frame_skip.codes(index):
            frame_skip.coded(index, keyframe=keyframe, mean_qp=qp(index) if callable(qp) else qp)
            taken.append(index)
    return taken


@pytest.mark.parametrize(
    ("decimation", "frames", "keyframes", "taken"),
    [
        (1, range(5), (), [0, 1, 2, 3, 4]),
        (3, range(10), (), [0, 3, 6, 9]),
        (3, [0, 1, 2, 4, 5, 6, 7, 8, 9, 17, 18, 19], (), [0, 4, 6, 9, 17, 18]),  # a missed one is made up for
        (5, range(20), (0, 7), [0, 5, 7, 12, 17]),  # a keyframe may come at any frame
    ],
)
def test_each_nth_frame_is_coded(decimation, frames, keyframes, taken):
    """The rate would be another than was asked for, creep up, or let a ground that joins wait for a second."""
    assert coded(FrameSkip(decimation), frames, keyframes=keyframes) == taken


@given(decimation=st.integers(1, 20), frames=st.sets(st.integers(0, 300), min_size=1))
def test_the_rate_is_kept_whatever_is_missed(decimation, frames):
    """More frames than asked for would overspend the budget, fewer would show less than it could."""
    taken = coded(FrameSkip(decimation), sorted(frames))
    slots = [(index - taken[0]) // decimation for index in taken]
    assert slots == sorted({(index - taken[0]) // decimation for index in frames}), "one frame for each turn"


def measured(decimation: int = 1) -> MeasuredFrameSkip:
    return MeasuredFrameSkip(decimation, most_decimation=7, rest_frames=150, window_frames=150)


def test_a_starved_stream_gets_fewer_frames_and_a_rich_one_more():
    """``--fps auto`` would never change anything."""
    starved, rich = measured(), measured(5)
    coded(starved, range(151), keyframes=(0, 150), qp=49.0)
    coded(rich, range(151), keyframes=(0, 150), qp=22.0)
    assert starved.decimation > 1
    assert rich.decimation < 5


def test_it_changes_at_keyframes_and_not_too_often():
    """Grounds that ask for keyframes would make the frame rate flutter, with a new encoder each time."""
    frame_skip = measured()
    coded(frame_skip, range(149), keyframes=(0, 30, 60, 90, 120), qp=50.0)
    assert frame_skip.decimation == 1
    coded(frame_skip, range(149, 160), keyframes=(155,), qp=50.0)
    assert frame_skip.decimation > 1


def test_the_frame_rate_settles():
    """A scene that gives the same quality again and again would be shown at one rate and another in turn."""
    for start in (1, 2, 3, 5):
        for ease in (30.0, 36.0, 40.0, 44.0, 48.0, 52.0):
            frame_skip = measured(start)
            seen = []
            for keyframe in range(0, 3000, 150):
                qp = min(51.0, ease - 3 * math.log2(frame_skip.decimation))  # fewer frames, finer ones
                coded(frame_skip, range(keyframe, keyframe + 150), keyframes=(keyframe,), qp=qp)
                seen.append(frame_skip.decimation)
            assert len(set(seen[8:])) == 1, (start, ease, seen)


def test_keyframes_and_unknown_quantisers_do_not_count():
    """The first, coarse keyframe would decide for ten seconds."""
    frame_skip = measured()
    coded(frame_skip, range(150), keyframes=range(150), qp=51.0)
    assert frame_skip.at_keyframe(150) == 1
    frame_skip = measured()
    coded(frame_skip, range(150), qp=math.nan)
    assert frame_skip.at_keyframe(150) == 1


def prompt(decimation: int) -> MeasuredFrameSkip:
    """As ``--profile auto`` at 15 frames a second."""
    return MeasuredFrameSkip(
        decimation, most_decimation=2, rest_frames=150, window_frames=15, band=PROMPT, own_keyframes=True
    )


@pytest.mark.parametrize(
    ("decimation", "later_qp", "other"), [(2, 26.0, 1), (1, 37.0, 2), (2, 31.0, 2), (1, 31.0, 1)]
)
def test_auto_asks_for_a_keyframe_of_its_own_for_another_rate(decimation, later_qp, other):
    """An easy scene would be shown at half its rate until somebody asks for a keyframe, a minute on a thin link."""
    frame_skip = prompt(decimation)

    def qp(index: int) -> float:  # what is long ago does not count
        return 45.0 if index < 100 else later_qp

    coded(frame_skip, range(149), keyframes=(0,), qp=qp)
    assert not frame_skip.wants_keyframe(148)
    coded(frame_skip, range(149, 152), qp=qp)
    assert frame_skip.wants_keyframe(151) == (other < decimation), "fewer frames wait for one that comes"
    assert frame_skip.at_keyframe(152) == other
    coded(frame_skip, range(152, 290), keyframes=(152,), qp=50.0)
    assert not frame_skip.wants_keyframe(289), "it rests"
    assert not measured(2).wants_keyframe(1000), "--fps auto alone waits for one that comes"


SECOND = 1_000_000_000
MOST = 0.4


@pytest.mark.parametrize(
    ("cores", "preset"),
    [(0.05, "veryfast"), (0.4, "veryfast"), (0.45, "superfast"), (0.6, "ultrafast"), (3.0, "ultrafast")],
)
def test_the_slowest_preset_that_there_is_time_for(cores, preset):
    """Two small cores would show one frame of three, or a large machine a worse picture than it could."""
    choice = choose_preset(cores, most_cores=MOST)
    assert choice.preset == preset
    took = "3.0 cores" if cores == 3 else f"{cores:.2g} of a core"
    assert choice.says == ("" if preset == "veryfast" else f"preset {preset}: veryfast would take {took}")


def test_the_share_of_encoding_grows_with_the_processors():
    """A workstation would fly like a board; in a container of half a processor nothing would be left to send with."""
    assert (share_of(0.5), share_of(1), share_of(2)) == (0.25, MOST, MOST)
    assert share_of(16) > 3


class Clockwork:
    """A control of 15 frames a second whose encoder takes ``frame_ms`` for each; a keyframe each ten seconds."""

    def __init__(self, preset: str) -> None:
        self.operating = Operating(
            budget_bps=1, video_share=None, base_bps=1, method="M0", decimation=1, preset=preset
        )
        self.control = PresetControl(self.operating, nominal_fps=15, most_cores=MOST)
        self.now_ns = 0
        self.open()

    def open(self) -> None:
        """Another encoder, which has taken nothing yet."""
        spent = self.spent = [0, 0]
        self.control.watch(lambda: (spent[0], spent[1]))

    def fly(self, seconds: int, *, frame_ms: float) -> list[str]:
        """The presets that it steps to meanwhile."""
        seen = []
        for _ in range(seconds // 10):
            self.now_ns += 10 * SECOND
            self.spent[:] = self.spent[0] + round(150 * frame_ms * 1e6), self.spent[1] + 150
            if self.control.wants_another(self.now_ns):
                seen.append(self.operating.now.preset)
                self.open()
        return seen


def test_the_preset_steps_where_the_load_has_changed_for_long():
    """A hotter processor or a busier scene would cost frames for the rest of the flight."""
    flight = Clockwork("veryfast")
    assert flight.fly(60, frame_ms=25) == []
    assert flight.fly(10, frame_ms=35) == [], "a moment says nothing"
    assert flight.fly(60, frame_ms=60) == ["ultrafast"]
    assert flight.operating.now.preset_says == "preset ultrafast: veryfast would take 0.9 of a core"
    assert flight.fly(120, frame_ms=5) == ["veryfast"]
    assert flight.operating.now.preset_says == ""


@pytest.mark.parametrize(("preset", "frame_ms"), [("veryfast", 29), ("superfast", 22), ("superfast", 26.9)])
def test_it_does_not_step_to_and_fro(preset, frame_ms):
    """Each step costs a keyframe of another look."""
    assert Clockwork(preset).fly(600, frame_ms=frame_ms) == []


def test_a_step_opens_x265_at_the_same_rates_and_video_goes_on(monkeypatch):
    """Video would stop, or the step would never reach the encoder."""
    config = check(EdgeConfig(source="demo", method="M0", size=(320, 192), budget=300_000))
    operating = Operating(
        budget_bps=300_000, video_share=1.0, base_bps=280_000, method="M0", decimation=1, preset="veryfast"
    )
    control = PresetControl(operating, nominal_fps=15, most_cores=1e-9)
    reconfiguration = make_reconfiguration(
        config,
        operating,
        (320, 192),
        open_encoder=encoder_opener(encoder_plan(config, (320, 192)), operating, presets=control),
        budget=SimpleNamespace(set_total=lambda *_rates, **_when: None),
        split=None,
        presets=control,
    )
    first = reconfiguration.open_again()
    ended_first = []

    real = EncoderPlan.open

    def opened(*given, **settings):
        with pytest.raises(AssertionError, match="it is open"):
            first.encode(Frame(1, 0, picture, picture))
        ended_first.append(True)
        return real(*given, **settings)

    monkeypatch.setattr(EncoderPlan, "open", opened)
    decoder, picture = BaseDecoder(), np.full((192, 320, 3), 90, np.uint8)
    assert reconfiguration(1, 0) is None
    assert decoder.decode_yuv(first.encode(Frame(0, 0, picture, picture), keyframe=True).data) is not None
    second = reconfiguration(1, 31 * SECOND)
    assert isinstance(second, BaseEncoder)
    assert isinstance(first, BaseEncoder)
    assert first.spent[1] == 1
    assert ended_first == [True], "two at a time are 20 MB more at 1280x720"
    assert operating.now.preset == "ultrafast"
    assert (operating.now.base_bps, operating.now.total_bps) == (280_000, 300_000)
    unit = second.encode(Frame(1, 0, picture, picture), keyframe=True)
    assert unit.keyframe
    assert decoder.decode_yuv(unit.data) is not None
    assert second.spent[0] > 0
    assert second.spent[1] == 1
    assert reconfiguration(1, 32 * SECOND) is None


@pytest.mark.parametrize(
    ("settings", "preset"),
    [({}, "auto"), ({"pace": "lockstep"}, "veryfast"), ({"preset": "fast", "pace": "realtime"}, "fast")],
)
def test_lockstep_measures_nothing(settings, preset):
    """The same input would give other bytes on another machine."""
    assert check(EdgeConfig(source="demo", **settings)).preset == preset
