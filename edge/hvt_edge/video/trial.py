"""Measures a scene: its first second is coded once before the flight."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from hvt_common.values import AccessUnit, Frame
from hvt_edge.video.encoders.contract import Encoder

_TRIAL_S = 0.85
"""The time of two comparisons of the shadow ground."""
_LAST = 3
"""The last so many count: those before still pay for the keyframe."""


def trial_frames(fps: float) -> int:
    """Number of coded frames of a trial, at so many a second; as many as count, at least."""
    return max(_LAST, 1 + math.floor(_TRIAL_S * fps))


def trial_quantiser(
    encoder: Encoder, scene: Iterable[Frame], *, count: int, on_unit: Callable[[Frame, AccessUnit], object]
) -> float:
    """Mean quantiser (0…51) of the last of ``count`` frames; NaN for a shorter scene, or an encoder that tells none.

    ``on_unit`` takes each frame with its unit.
    """
    quantisers = []
    for number, frame in enumerate(scene):
        unit = encoder.encode(frame, keyframe=number == 0)
        quantisers.append(encoder.mean_qp)
        on_unit(frame, unit)
    return sum(quantisers[-_LAST:]) / _LAST if len(quantisers) == count else math.nan
