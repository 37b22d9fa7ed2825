"""Whether an encoder keeps to its rate, measured before the flight: real x265 that is asked for too much."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from hvt_common.errors import UserError
from hvt_common.values import AccessUnit, Frame
from hvt_edge.video.encoder import encoder_settings
from hvt_edge.video.qualification import Allowed, allowed, headroom_of, measure, run_frames
from hvt_edge.video.x265 import BaseEncoder
from media.clips import framed, hard_pictures

SIZE, FPS, BASE_BPS, TOTAL_BPS = (640, 360), 15.0, 300_000, 400_000
SCENE = framed(hard_pictures(45, size=SIZE))


def limit() -> Allowed:
    """What a budget of 400 kbps leaves."""
    return allowed(size=SIZE, fps=FPS, total_bps=TOTAL_BPS, base_bps=BASE_BPS, window_s=1.0)


def opened(
    share: float, *, kind: type[BaseEncoder] = BaseEncoder, factor: float = 1.0, least_bps: int = 0
) -> BaseEncoder:
    """X265 that takes ``factor`` of what it is asked for, and never less than ``least_bps``."""
    settings = encoder_settings(
        size=SIZE, fps=FPS, preset="ultrafast", total_bps=TOTAL_BPS, base_bps=BASE_BPS, edge_id="edge-1"
    )
    rate_bps = round(max(settings.bitrate_bps * share * factor, least_bps))
    return kind(replace(settings, bitrate_bps=rate_bps))


class Garbled(BaseEncoder):
    """Loses the end of each unit but the keyframes."""

    def encode(self, frame: Frame, **how: Any) -> AccessUnit:
        unit = super().encode(frame, **how)
        return unit if unit.keyframe else replace(unit, data=unit.data[:3])


def headroom(scene=SCENE, kind: type[BaseEncoder] = BaseEncoder, **behaviour: float) -> float:
    return headroom_of(
        "acme",
        open_at=partial(opened, kind=kind, **behaviour),
        scene=lambda: iter(scene),
        frames=len(SCENE),
        limit=limit(),
        edge_id="edge-1",
    )


def test_what_is_allowed_is_the_budgets_own_rule():
    """An encoder would be refused that flies well, or accepted that makes every picture late."""
    found = limit()
    assert (found.window_frames, found.window_s) == (15, 1.0)
    assert found.window_bytes == 1.15 * BASE_BPS / 8
    assert found.keyframe_bytes == 0.5 * BASE_BPS / 8
    assert run_frames(FPS, found) == 45
    alone = allowed(size=SIZE, fps=FPS, total_bps=BASE_BPS, base_bps=BASE_BPS, window_s=1.0)
    assert alone.window_bytes == BASE_BPS / 8, "where video has the whole budget nothing can yield"
    slow = allowed(size=SIZE, fps=0.5, total_bps=TOTAL_BPS, base_bps=BASE_BPS, window_s=60.0)
    assert (slow.window_frames, slow.window_s, run_frames(0.5, slow)) == (2, 4.0, 4)


def test_the_fullest_window_is_any_window():
    """A burst between two whole seconds would not be found."""
    sizes = [100] * 10 + [5000] * 15 + [100] * 10
    units = [AccessUnit(index, 0, bytes(size), keyframe=index == 12) for index, size in enumerate(sizes)]
    found = measure(units, limit(), edge_id="edge-1")
    header = found.keyframe_bytes - 5000
    assert 50 < header < 400
    assert found.window_bytes == 15 * (5000 + header)


@pytest.mark.parametrize("scene", [SCENE, ()])
def test_an_encoder_that_keeps_to_its_rate_is_taken_as_it_is(scene):
    """Bits that the budget has would stay unused, or Ctrl-C before the first frame blame the encoder."""
    assert headroom(scene=scene) == 1.0


def test_one_that_takes_half_as_much_again_is_asked_for_less():
    """Every picture would wait for the budget's window, and stills find no room."""
    share = headroom(factor=1.5)
    assert 0.5 <= share < 0.85
    encoder = opened(share, factor=1.5)
    units = [encoder.encode(frame, keyframe=frame.index in (0, 22)) for frame in SCENE]
    assert measure(units, limit(), edge_id="edge-1").overshoot(limit()) <= 1


@pytest.mark.parametrize(
    ("behaviour", "says"),
    [
        ({"least_bps": 3_000_000}, "overshoots: its fullest 1 s took .* of the 345 kbps that .* or raise"),
        ({"least_bps": 450_000}, r"overshoots: .*, and too much with its target lowered to \d\d%"),
        (
            {"kind": Garbled},
            r"does not work here \(ValueError: its unit of frame 1 gives no picture.*: take x265",
        ),
    ],
)
def test_one_that_does_not_obey_or_gives_no_pictures_is_refused_with_its_figure(behaviour, says):
    """A flight would begin whose picture is late, or garbage, all the time, and nobody learn why."""
    with pytest.raises(UserError, match=f"--encoder acme {says}"):
        headroom(**behaviour)
