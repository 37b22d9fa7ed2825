"""The start of ``auto``, profile or preset: the first second of the scene is coded before the flight."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from hvt_common.inference.detect import FailingDetector
from hvt_common.runtime.log import START_LOGGER
from hvt_common.units import SECOND_NS
from hvt_common.values import View
from hvt_edge.config import EdgeConfig
from hvt_edge.loop.counts import processors
from hvt_edge.operating import FIRST_SHARE
from hvt_edge.perception.shadow import UNMEASURED, Shadow
from hvt_edge.source.contract import Source
from hvt_edge.stills.policy.registry import method
from hvt_edge.video.encoder import X265, least_base_bps
from hvt_edge.video.rate_model import PresetChoice, choose_preset, share_of
from hvt_edge.video.x265 import BaseEncoder
from hvt_edge.wiring.link import SPARSE_SHARE, auto_settings
from hvt_edge.wiring.perception import make_analyzer, make_shadow
from hvt_edge.wiring.video import first_decimation, first_rates, make_encoder, scene

_FINE = 33.5
"""Mean quantiser (0…51) of the last frames below which all frames are coded. Measured as for `PROMPT`."""
_MOST_NS = 3 * SECOND_NS
"""Time after which comparing ends on a slow machine: a flight must not wait for its detector."""
_TRIAL_S = 0.85
"""The time of two comparisons of the shadow ground."""
_LAST = 3
"""Number of last frames that count: earlier ones still pay for the keyframe."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """The decisions at the beginning of a flight."""

    decimation: int
    share: float
    """The base stream's share of the budget."""
    preset: PresetChoice
    shadow: Shadow = UNMEASURED
    """The shadow ground's comparison of that second."""


def try_scene(
    config: EdgeConfig,
    source: Source,
    *,
    detector: FailingDetector,
    clock: Callable[[], int],
    stop: threading.Event,
) -> Beginning:
    """Code the first second, if its result may matter; else the settings alone decide."""
    size = source.view.base_size
    decimation = first_decimation(config, size)
    fps = config.nominal_fps / decimation
    feasible = config.base_bps >= least_base_bps(size, fps, edge_id=config.edge_id)
    measures = config.measures and feasible and config.encoder == X265
    shadow = make_shadow(config, detector) if measures else None
    rates = measures and (shadow is not None or (config.auto_fps and decimation > 1))
    if not (rates or config.auto_preset):  # no decision depends on the trial
        return Beginning(decimation, _share(config, source.view, decimation), PresetChoice(config.preset))
    count = max(_LAST, 1 + math.floor(_TRIAL_S * fps))
    analyzer = make_analyzer(config, detector=detector, view=source.view)
    until_ns = None if config.pace == "lockstep" else clock() + _MOST_NS

    encoder = make_encoder(config, first_rates(config, decimation), size=size)
    assert isinstance(encoder, BaseEncoder), "x265 alone is tried"
    spent: list[tuple[int, int]] = []
    quantisers: list[float] = []
    for frame in scene(source, decimation=decimation, count=count, clock=clock, stop=stop):
        unit = encoder.encode(frame, keyframe=not quantisers)
        quantisers.append(encoder.mean_qp)
        spent.append(encoder.spent)
        if shadow is not None and (until_ns is None or clock() < until_ns):
            shadow.compare(analyzer.analyze(frame, unit))
    # A shorter scene, or an encoder that reports no quantiser, gives no measurement.
    fine = len(quantisers) == count and sum(quantisers[-_LAST:]) / _LAST < _FINE
    if rates and config.auto_fps and fine:
        decimation = _most_frames(config, size, decimation)
    seen = UNMEASURED if shadow is None else shadow.now
    preset = PresetChoice(config.preset)
    if config.auto_preset:
        preset = _preset(spent, fps=config.nominal_fps / decimation)
    return Beginning(decimation, _share(config, source.view, decimation, seen), preset, seen)


def _preset(spent: Sequence[tuple[int, int]], *, fps: float) -> PresetChoice:
    # By the cost of the frames after the keyframe; a scene of one frame gives no cost.
    if len(spent) < 2:
        return PresetChoice()
    frame_ns = (spent[-1][0] - spent[0][0]) / (spent[-1][1] - spent[0][1])
    choice = choose_preset(frame_ns / SECOND_NS * fps, most_cores=share_of(processors()))
    if choice.says:
        logging.getLogger(START_LOGGER).info("%s", choice.says)
    return choice


def _most_frames(config: EdgeConfig, size: tuple[int, int], decimation: int) -> int:
    # All frames, or the most at which x265 can still follow the rate.
    for fewer in range(1, decimation):
        if config.base_bps >= least_base_bps(size, config.nominal_fps / fewer, edge_id=config.edge_id):
            return fewer
    return decimation


def _share(config: EdgeConfig, view: View, decimation: int, seen: Shadow = UNMEASURED) -> float:
    # Where the base hides objects, stills find more than video would; false objects of the base they do not change.
    if not config.measures or config.fixed_share is not None:
        return config.share
    share = min(config.share, SPARSE_SHARE) if decimation > 1 else config.share
    seen = replace(seen, suppressed=0.0, suppressed_p=0.0)
    pay = auto_settings(config, view).tracks_pay(seen.measured, total_bps=config.budget_bps)
    return FIRST_SHARE if pay and not method(config.method).video_only else share
