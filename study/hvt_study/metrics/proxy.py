"""The pilot's proxy metrics: what one model says of an object on the base, and of the same object in a still.

They need no labels and prove nothing about right or wrong: a model may be surer and wrong. They are here to be set
beside the pilot's printed table. For each pair of opinions:

gain
    confidence in the still minus confidence on the base, each of the class that was named there.
positive
    the gain is above 0.
changed
    the two name another class.
entropy gain
    entropy of the posterior on the base minus that in the still, in nats.
small
    the box covers less than a share of the base frame, 0.015 in three of the pilot's four selectors and 0.020 in
    ``strict_small_only``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hvt_study.metrics.observed import Opinion, RefinedObject

SMALL_SHARE = 0.015


@dataclass(frozen=True, slots=True)
class ProxyScore:
    """Means over some pairs; NaN where there is none."""

    pairs: int
    confidence_base: float
    confidence_still: float
    gain: float
    positive_rate: float
    change_rate: float
    entropy_gain_nats: float


@dataclass(frozen=True, slots=True)
class Proxies:
    """Of one run."""

    every: ProxyScore
    small: ProxyScore
    unpaired: int
    """Objects in stills of which one of the two opinions is missing; they are in neither score."""


def proxies(objects: Iterable[RefinedObject], *, small_share: float = SMALL_SHARE) -> Proxies:
    """Score all objects in stills, matched with a track or not; ``small_share`` is a share of the base frame."""
    everything = list(objects)
    pairs = [
        (one.base, one.still, one.area_share)
        for one in everything
        if one.base is not None and one.still is not None
    ]
    return Proxies(
        every=_score([(base, still) for base, still, _ in pairs]),
        small=_score([(base, still) for base, still, share in pairs if share < small_share]),
        unpaired=len(everything) - len(pairs),
    )


def score_entropy_nats(confidence: float, classes: int) -> float:
    """Entropy of a detector's answer: its score p for one of ``classes``, the rest spread evenly over the others.

    -p ln p - (1-p) ln((1-p)/(classes-1)), which is what re-detection of a still without a second opinion has too.
    """
    p = min(max(confidence, 0.0), 1.0)
    rest = 1 - p
    known = -p * math.log(p) if p > 0 else 0.0
    return known - (rest * math.log(rest / (classes - 1)) if rest > 0 and classes > 1 else 0.0)


def _score(pairs: Sequence[tuple[Opinion, Opinion]]) -> ProxyScore:
    if not pairs:
        return ProxyScore(0, *[math.nan] * 6)
    base = np.array([(one.confidence, one.entropy_nats) for one, _ in pairs])
    still = np.array([(one.confidence, one.entropy_nats) for _, one in pairs])
    gains = still[:, 0] - base[:, 0]
    return ProxyScore(
        pairs=len(pairs),
        confidence_base=float(base[:, 0].mean()),
        confidence_still=float(still[:, 0].mean()),
        gain=float(gains.mean()),
        positive_rate=float((gains > 0).mean()),
        change_rate=sum(one.class_name != other.class_name for one, other in pairs) / len(pairs),
        entropy_gain_nats=float((base[:, 1] - still[:, 1]).mean()),
    )
