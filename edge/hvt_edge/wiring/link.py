"""The link and its budget, from the settings."""

from __future__ import annotations

from hvt_common.protocol.channels import DELIVERIES, Channel, Direction
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_common.values import View
from hvt_edge.config import LEAST_FPS, EdgeConfig
from hvt_edge.link.budget import BudgetSettings, RollingBudget
from hvt_edge.link.pacer import Pacer
from hvt_edge.link.rate_control import RateController
from hvt_edge.perception.auto import AutoSettings
from hvt_edge.video.encoder import least_base_bps
from hvt_edge.video.reconfigure import Split
from hvt_edge.wiring.perception import shows_details
from hvt_edge.wiring.video import Camera, least_rate_bps

_AUTO_STILL_SHARE = 0.15
"""Share of the budget, at most, for stills that are not known to pay: the base loses .015 of F1 by it."""
SPARSE_SHARE = 0.9
"""Largest share of the budget for a base of which not all frames are coded. Each has more bits then; at 7.5 a second
it still arrives within 1.5 times the delay of 15 a second with the whole budget."""
_AUTO_REST_S = 8.0
"""Least seconds between two keyframes that only change the split."""


def make_link_settings(config: EdgeConfig) -> LinkSettings:
    return LinkSettings(
        role="edge",
        listen=config.listen,
        connect=config.connect,
        zenoh_config=config.zenoh_config,
        insecure=config.insecure,
        name=config.edge_id,
        links=2 if config.links == 2 else 1,
    )


def channels_of(config: EdgeConfig, *, live: bool) -> tuple[Channel, ...]:
    """The channels on which the edge may send; ``live``: its source is live."""
    optional = {
        Channel.TRACKS: config.send_tracks,
        Channel.POSE: config.pose is not None,
        Channel.BACKLOG: config.store_bytes(live=live) > 0,
    }
    sent = (one for one, delivery in DELIVERIES.items() if delivery.direction is Direction.EDGE_TO_GROUND)
    return tuple(one for one in sent if optional.get(one, True))


def make_budget(config: EdgeConfig, *, base_bps: int, decimation: int) -> RollingBudget:
    return RollingBudget(
        BudgetSettings(
            total_bps=config.budget_bps,
            base_bps=base_bps,
            fps=config.nominal_fps / decimation,
            window_ns=round(config.window * SECOND_NS),
            metadata_bps=config.metadata_bps,
            borrow_unused=config.borrow_unused,
            yields=not config.passes_through,
        )
    )


def make_split(config: EdgeConfig, size: tuple[int, int], *, first_share: float) -> Split | None:
    """The control of the base's share of the budget; None where the share is fixed."""
    if not isinstance(config.video_share, str):
        return None
    fps = LEAST_FPS if config.auto_fps else config.nominal_fps
    split = Split(
        total_bps=config.budget_bps,
        least_base_bps=least_base_bps(size, fps, edge_id=config.edge_id),
        metadata_bps=config.metadata_bps,
        share=first_share,
    )
    if config.measures:  # stills have to earn more
        split.most_still_share, split.most_sparse_share = _AUTO_STILL_SHARE, SPARSE_SHARE
        split.own_rest_s = _AUTO_REST_S
    return split


def auto_settings(config: EdgeConfig, view: View) -> AutoSettings:
    return AutoSettings(tracks_bps=config.metadata_bps, finer=shows_details(config, view))


def make_pacer(config: EdgeConfig, camera: Camera | None, size: tuple[int, int]) -> Pacer | None:
    """The pacer, which tracks the link's rate; None where the budget stays as it is.

    The rate is never below the need of a passed-through ``camera``.
    """
    if not config.adapts:
        return None
    floor_bps = max(least_rate_bps(config, size), 0 if camera is None else camera.needed_bps)
    floor_bps = min(config.budget_bps, floor_bps)
    return Pacer(RateController(ceiling_bps=config.budget_bps, floor_bps=floor_bps))
