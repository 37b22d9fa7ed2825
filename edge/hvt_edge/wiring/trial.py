"""What ``--profile auto`` begins with: the first second of the scene is coded before the flight, and looked at."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from hvt_common.units import SECOND_NS
from hvt_common.values import AccessUnit, Frame, View
from hvt_edge.config import EdgeConfig
from hvt_edge.perception.analyzer import FailingDetector
from hvt_edge.perception.shadow import UNMEASURED, Shadow
from hvt_edge.source.contract import Source
from hvt_edge.stills.policy.registry import method
from hvt_edge.video.encoder_settings import least_base_bps
from hvt_edge.video.encoders.registry import X265
from hvt_edge.video.share import FIRST_SHARE
from hvt_edge.video.trial import trial_frames, trial_quantiser
from hvt_edge.wiring.link import SPARSE_SHARE, lever_settings
from hvt_edge.wiring.perception import make_analyzer, make_shadow
from hvt_edge.wiring.video import first_decimation, make_encoder, scene

__all__ = ["Beginning", "try_scene"]

_FINE = 33.5
"""Of `trial_quantiser`: below it all frames are coded. Measured as `PROMPT` was."""
_MOST_NS = 3 * SECOND_NS
"""On a slow machine comparing ends after so long: a flight is not to wait for its detector."""


@dataclass(frozen=True, slots=True)
class Beginning:
    """How a flight begins."""

    decimation: int
    """Each n-th source frame is coded."""
    share: float
    """Of the budget, for the base stream."""
    shadow: Shadow = UNMEASURED
    """What the base stream showed of the source."""


def try_scene(
    config: EdgeConfig,
    source: Source,
    *,
    detector: FailingDetector,
    clock: Callable[[], int],
    stop: threading.Event,
) -> Beginning:
    """Code the first second, where what comes of it may matter; else the settings alone decide."""
    size = source.view.base_size
    decimation = first_decimation(config, size)
    fps = config.nominal_fps / decimation
    feasible = config.base_bps >= least_base_bps(size, fps, edge_id=config.edge_id)
    if not (config.measures and feasible) or config.encoder != X265:
        return Beginning(decimation, _share(config, source.view, decimation))
    shadow = make_shadow(config, detector)
    if shadow is None and not (config.auto_fps and decimation > 1):  # nothing would come of it
        return Beginning(decimation, _share(config, source.view, decimation))
    count = trial_frames(fps)
    analyzer = make_analyzer(config, detector=detector, view=source.view)
    until_ns = None if config.pace == "lockstep" else clock() + _MOST_NS

    def compare(frame: Frame, unit: AccessUnit) -> None:
        if shadow is not None and (until_ns is None or clock() < until_ns):
            shadow.compare(analyzer.analyze(frame, unit))

    quantiser = trial_quantiser(
        make_encoder(
            config, size=size, decimation=decimation, total_bps=config.budget_bps, base_bps=config.base_bps
        ),
        scene(source, decimation=decimation, count=count, clock=clock, stop=stop),
        count=count,
        on_unit=compare,
    )
    if config.auto_fps and quantiser < _FINE:
        decimation = _most_frames(config, size, decimation)
    seen = UNMEASURED if shadow is None else shadow.now
    return Beginning(decimation, _share(config, source.view, decimation, seen), seen)


def _most_frames(config: EdgeConfig, size: tuple[int, int], decimation: int) -> int:
    """All frames, or as many as x265 can follow the rate with."""
    for fewer in range(1, decimation):
        if config.base_bps >= least_base_bps(size, config.nominal_fps / fewer, edge_id=config.edge_id):
            return fewer
    return decimation


def _share(config: EdgeConfig, view: View, decimation: int, seen: Shadow = UNMEASURED) -> float:
    """Where the base hides objects, stills find more of them than the video would by the same bits.

    What it shows in error they do not change: their share would go unused.
    """
    if not config.measures or config.fixed_share is not None:
        return config.share
    share = min(config.share, SPARSE_SHARE) if decimation > 1 else config.share
    seen = replace(seen, denied=0.0, denied_p=0.0)
    pay = lever_settings(config, view).tracks_pay(seen.measured, total_bps=config.budget_bps)
    return FIRST_SHARE if pay and not method(config.method).video_only else share
