"""The makers and choosers of stills, from the settings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hvt_common.errors import UserError
from hvt_common.values import View
from hvt_common.video.still_codecs import still_codec
from hvt_edge.config import EdgeConfig
from hvt_edge.stills.maker import StillMaker
from hvt_edge.stills.policy.base import Method
from hvt_edge.stills.policy.registry import METHODS, method, tuning
from hvt_edge.stills.scheduler import Suppression

_TRIAL_PX = 48
_LEAST_STILL_BYTES = 400
_DETAIL = "detail_weight"
_FINER = 0.5
"""Limit of `_hidden_pixels`."""
_DETAIL_WEIGHT = 5.0
"""If the base has none of the source's pixels, details count for more than a class (docs/legibility.md)."""


def check_codecs(config: EdgeConfig) -> None:
    """Code a picture once: `UserError` if a library behind a codec does not do its part."""
    ramp = np.arange(_TRIAL_PX, dtype=np.uint8)
    crop = np.stack(np.broadcast_arrays(4 * ramp[:, None], 4 * ramp, np.uint8(90)), axis=2)
    for flag, name in (("still-codec", config.still_codec), ("fallback-codec", config.fallback_codec)):
        codec = still_codec(name)
        base = crop // 2 if codec.needs_base else None
        try:
            coded = codec.encode(crop, quality_pct=config.jpeg_quality, base_bgr=base)
            codec.decode(coded.data, size=(_TRIAL_PX, _TRIAL_PX), parameters=coded.parameters, base_bgr=base)
        except Exception as error:  # the codec may be anybody's
            raise UserError(
                f"--{flag} {name} does not work here ({error}): choose another, such as jpeg"
            ) from error
        if not still_codec(config.still_codec).needs_base:
            return  # no fallback is used


def make_method(config: EdgeConfig, view: View, *, name: str | None = None) -> Method:
    """The method of the settings, or another by its name.

    With auto details count as far as the base has no pixels for them. Raises `UserError` for an unknown name.
    """
    own = method(config.method)
    policy = own if name is None else method(name)
    parameters = tuning(config.tune) if policy.name == own.name else {}
    if config.measures and _DETAIL in METHODS[policy.name].parameters:
        parameters.setdefault(_DETAIL, _DETAIL_WEIGHT * _hidden_pixels(view))
    return method(policy.name, **parameters)


def shows_details(config: EdgeConfig, view: View) -> bool:
    """Whether stills are worth sending for pixels that the base does not have."""
    return _hidden_pixels(view) > _FINER and getattr(make_method(config, view), _DETAIL, 0) > 0


def _hidden_pixels(view: View) -> float:
    # 0…1: the share of the source's pixels that the base has no pixel of its own for.
    return max(0.0, 1 - view.scale**2)


def make_suppression(config: EdgeConfig) -> Suppression:
    """Make the rule that says which tracks pause, and for how long."""
    return Suppression.for_cooldown(config.cooldown, min_gain=config.min_gain)


def make_maker(config: EdgeConfig, *, readable: Callable[[str], bool]) -> StillMaker:
    """Who crops and codes; for ``readable`` see there."""
    codec = still_codec(config.still_codec)
    return StillMaker(
        codec=codec,
        fallback=still_codec(config.fallback_codec) if codec.needs_base else None,
        quality_pct=config.jpeg_quality,
        fidelity_db=config.fidelity,
        padding=config.padding,
        # Others have a lowest quality; what builds on the base would be made to fit whatever there is.
        least_bytes=_LEAST_STILL_BYTES if codec.needs_base else 0,
        readable=readable,
    )
