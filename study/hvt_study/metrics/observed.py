"""The records of a flight's ground at every frame and of its stills, the views that metrics take, and proxies.

The pilot's proxy metrics compare one model's opinions on an object in the base and on the same object in a still.
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

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from hvt_study.datasets.labels import FrameLabels
from hvt_study.metrics.judged import FrameView, LabelledFrame, no_numbers


@dataclass(frozen=True, slots=True)
class StillArrival:
    """One still at the ground. Times are media time, from the first frame's capture."""

    sequence: int
    """The edge's sequence number; it names the still."""
    capture_s: float
    """Capture of the frame that it was cut from."""
    sent_s: float
    """When it was handed to the link."""
    arrived_s: float
    size_bytes: int
    line_bytes: int
    reason: str
    """Why the edge's method sent it."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """A model's opinion on one crop."""

    class_name: str
    confidence: float
    entropy_nats: float


@dataclass(frozen=True, slots=True)
class RefinedObject:
    """One object in a still, and the ground's result; a still that shows several has one of these for each."""

    still_sequence: int
    track_id: int
    """The ground's; `NO_ID` of `hvt_study.datasets.labels` where no track matched."""
    at_s: float
    """Media time at which the ground knew."""
    name_before: str
    """Shown for the track until then."""
    name_after: str
    area_share: float
    """Area of the object's box as a share of the base frame's, 0…1."""
    base: Opinion | None = None
    """Opinion on the object as the decoded base shows it; None where that was not asked or gave no answer."""
    still: Opinion | None = None
    """Opinion on the object as the still shows it, by the same model."""


def still_delays_ms(stills: Sequence[StillArrival]) -> tuple[float, float]:
    """(median, 95th percentile) from the capture of a still's frame to its arrival; NaN without stills."""
    if not stills:
        return math.nan, math.nan
    p50, p95 = np.percentile([1e3 * (one.arrived_s - one.capture_s) for one in stills], (50, 95)).tolist()
    return p50, p95


@dataclass(frozen=True, slots=True)
class ObservedFrame(FrameView):
    """The ground's list at one source frame, as it was shown, with all that metrics need of it; N tracks."""

    confidences_before: npt.NDArray[np.float32] = field(default_factory=no_numbers)
    """(N,) of the last detection that was matched."""
    origins: tuple[str, ...] = ()
    """N words of `hvt_ground.events.Origin`: who knows of the track."""
    detections: FrameView | None = None
    """The boxes of the ground's detector in this decoded frame, from the tracker's weak confidence on, before any
    tracking; None at frames that were not coded or not detected on."""
    stills: tuple[StillArrival, ...] = ()
    """Arrived since the frame before; those after the last frame stand with it."""
    shown_s: float = math.nan
    """When the list was there for somebody to look at, from the capture of the flight's first frame."""
    refined: tuple[RefinedObject, ...] = ()
    """Objects that were named since the frame before."""

    def base_view(self) -> FrameView:
        """The tracks that the base stream knows of, with names and confidences as without stills.

        Where the edge reports its tracks too, a box is fused from both. That no still was sent does not give
        their bits back to the video: the fair video-only figure is that of M0 at equal bits.
        """
        known = np.array([origin in ("base", "edge+base") for origin in self.origins], np.bool_)
        names, sure = self.names_before, self.confidences_before
        return FrameView(self.boxes_xyxy_px, self.ids, names, sure, names).rows(known)


def refined_frames(lists: Sequence[ObservedFrame], labels: Iterable[FrameLabels]) -> list[LabelledFrame]:
    """Every frame of a flight (``FlightReport.lists``) as it was shown, with its labels."""
    return list(zip(labels, lists, strict=True))


def detected_frames(lists: Sequence[ObservedFrame], labels: Iterable[FrameLabels]) -> list[LabelledFrame]:
    """The base frames that the ground detected on, with plain detections, for mAP."""
    pairs = [(truth, one.detections) for one, truth in zip(lists, labels, strict=True)]
    return [(truth, found) for truth, found in pairs if found is not None]


def arrivals(lists: Iterable[ObservedFrame]) -> list[StillArrival]:
    return [still for one in lists for still in one.stills]


def refined_objects(lists: Iterable[ObservedFrame]) -> list[RefinedObject]:
    return [done for one in lists for done in one.refined]


SMALL_SHARE = 0.015


def proxies(objects: Iterable[RefinedObject]) -> dict[str, float]:
    """Means over all objects in stills of which both opinions are known, matched with a track or not.

    The same of the small ones under ``small_…``; NaN where there is none.
    """
    pairs = [
        (one.base, one.still, one.area_share)
        for one in objects
        if one.base is not None and one.still is not None
    ]
    small = [(base, still) for base, still, share in pairs if share < SMALL_SHARE]
    return {
        "proxy_pairs": len(pairs),
        "small_pairs": len(small),
        **_means([(base, still) for base, still, _ in pairs]),
        **{f"small_{name}": value for name, value in _means(small).items()},
    }


def score_entropy_nats(confidence: float, classes: int) -> float:
    """Entropy of a detector's answer: its score p for one of ``classes``, the rest spread evenly over the others.

    -p ln p - (1-p) ln((1-p)/(classes-1)), as re-detection of a still without a second opinion has it too.
    """
    p = min(max(confidence, 0.0), 1.0)
    rest = 1 - p
    known = -p * math.log(p) if p > 0 else 0.0
    return known - (rest * math.log(rest / (classes - 1)) if rest > 0 and classes > 1 else 0.0)


def _means(pairs: Sequence[tuple[Opinion, Opinion]]) -> dict[str, float]:
    base, still = (
        np.array([(one.confidence, one.entropy_nats) for one in side]).reshape(-1, 2)
        for side in (zip(*pairs, strict=True) if pairs else ((), ()))
    )
    gains = still[:, 0] - base[:, 0]
    columns = {
        "confidence_base": base[:, 0],
        "confidence_refined": still[:, 0],
        "confidence_gain": gains,
        "positive_rate": gains > 0,
        "change_rate": np.array([one.class_name != other.class_name for one, other in pairs]),
        "entropy_gain_nats": base[:, 1] - still[:, 1],
    }
    return {name: float(values.mean()) if pairs else math.nan for name, values in columns.items()}
