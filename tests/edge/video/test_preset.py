"""``--preset auto``: what the machine has time for is measured; it steps at keyframes alone, and seldom."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hvt_common.values import Frame
from hvt_common.video.hevc import BaseDecoder
from hvt_edge.config import EdgeConfig, check
from hvt_edge.operating import Operating
from hvt_edge.video.encoder import EncoderPlan
from hvt_edge.video.rate_model import PresetControl, choose_preset, share_of
from hvt_edge.video.reconfigure import encoder_opener
from hvt_edge.video.x265 import BaseEncoder
from hvt_edge.wiring.video import encoder_plan, make_reconfiguration

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


def test_a_machine_of_many_processors_need_not_give_up_quality():
    """A workstation would fly like a board."""
    assert share_of(1) == share_of(2) == MOST
    assert share_of(16) > 3


def test_of_a_part_of_a_processor_encoding_takes_half():
    """In a container that is given half of one nothing would be left to decode, track and send with."""
    assert share_of(0.5) == 0.25


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


def test_it_steps_where_the_load_has_changed_for_long():
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
