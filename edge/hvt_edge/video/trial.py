"""What quantiser a scene needs: its first second is coded once before the flight."""

from __future__ import annotations

import math
from collections.abc import Iterable

from hvt_common.values import Frame
from hvt_edge.video.encoders.contract import Encoder

__all__ = ["TRIAL_FRAMES", "trial_quantiser"]

TRIAL_FRAMES = 7
_LAST = 3
"""The last so many count: those before still pay for the keyframe."""


def trial_quantiser(encoder: Encoder, scene: Iterable[Frame]) -> float:
    """Mean quantiser (0…51) of the last of `TRIAL_FRAMES`; NaN for a shorter scene, or an encoder that tells none."""
    quantisers = []
    for number, frame in enumerate(scene):
        encoder.encode(frame, keyframe=number == 0)
        quantisers.append(encoder.mean_qp)
    return sum(quantisers[-_LAST:]) / _LAST if len(quantisers) == TRIAL_FRAMES else math.nan
