"""Tracks that are more likely nothing: weak, never moved, and like nothing around them; which kinds are known.

A detector takes a post for a pedestrian, a planter for a bus: its false objects mostly stand still. Where scores are
true, a box of .4 is right four times in ten; better evidence is that it moves over the ground, or that surer ones of
its kind and size stand around it, as in a row of parked cars. Without either it is a guess. People move, and lane
marks stand in rows: a standing person must be surer. A kind of vehicle is known where its detections agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from hvt_common.camera_motion import Affine
from hvt_common.inference.class_names import group_of
from hvt_common.inference.tiles import shared_of_smaller
from hvt_common.values import Boxes, Tracks
from hvt_ground.events import Refinement
from hvt_ground.perception.stills.posterior import LEAST_SURE_PX, SURE

_LIKELY, _LIKELY_ODD = 0.5, 0.7
"""From this mean confidence on it is more likely right than not; a person, one much larger than others or on one."""
_AGREED = {"car": 0.65}
_AGREED_ELSE = 0.94
"""From this mean confidence on, 0 where it was called another kind, nine of ten are right (embedded-models.md)."""
_REACH, _NOISE_PX = 0.5, 4.0
"""It has moved when its middle is half its longer side, and 4 pixels, from where it stood."""
_FORGOTTEN_S = 10.0
"""Where it stood follows it so slowly: the estimate of the camera's motion drifts."""
_ON = 0.7
"""A track that shares this much of the smaller box with a surer one of its group is likely the same object."""
_NEIGHBOURS, _LARGER = 3, 2.0
"""Three surer ones of its group speak for it, unless it is twice as large or half as large as they mostly are."""

_Floats = npt.NDArray[np.float64]


@dataclass(slots=True)
class _Evidence:
    at: _Floats
    moved: bool = False
    seen_frame: int = -1
    count: int = 0
    totals: dict[str, float] = field(default_factory=dict)
    """The sum of its confidences by class."""

    def mean(self, name: str | None = None) -> float:
        total = sum(self.totals.values()) if name is None else self.totals.get(name, 0.0)
        return total / max(1, self.count)


class Guesses:
    """The guesses in one video, whose detector gives probabilities; ``scale`` is base pixels per source pixel.

    Frames rise; for one thread.
    """

    def __init__(self, *, fps: float, scale: float = 1.0) -> None:
        self._fps, self._scale = fps, scale
        self._seen: dict[int, _Evidence] = {}
        self._frame = 0
        self._ids: frozenset[int] = frozenset()

    def update(
        self,
        tracks: Tracks,
        names: Sequence[str],
        step: Affine | None,
        *,
        scores: npt.NDArray[np.float32] | None = None,
    ) -> None:
        """Take the next list, with the class of each, and the camera's motion since the one before, base pixels.

        ``scores`` count in place of the tracks' confidences, which are not true where the surer of two was taken.
        """
        scores = tracks.confidences if scores is None else scores
        share = min(1.0, (tracks.frame_index - self._frame) / self._fps / _FORGOTTEN_S)
        self._frame = tracks.frame_index
        boxes = tracks.boxes_xyxy_px.astype(np.float64)
        centres, sides = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]).max(1, initial=0)
        before, self._seen = self._seen, {}
        for row, track_id in enumerate(tracks.ids.tolist()):
            one = before.get(track_id)
            if one is None:
                one = _Evidence(centres[row])
            elif step is not None:
                one.at = step[:, :2] @ one.at + step[:, 2]
            off = centres[row] - one.at
            one.moved |= bool(np.hypot(*off) > _REACH * sides[row] + _NOISE_PX)
            one.at = one.at + off * share
            if tracks.seen_frames[row] > one.seen_frame:
                one.seen_frame = int(tracks.seen_frames[row])
                one.totals[names[row]] = one.totals.get(names[row], 0.0) + float(scores[row])
                one.count += 1
            self._seen[track_id] = one
        self._ids = self._guessed(tracks.ids.tolist(), names, tracks.boxes_xyxy_px)

    def among(self, ids: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(N,) True for those that were guesses in the newest list."""
        return np.array([one in self._ids for one in ids.tolist()], np.bool_)

    def doubting(self, still: Refinement, *, unlike: bool) -> Refinement:
        """The reading of a still, doubted where it is not sure and has no track or that of a guess.

        All are guesses where the detector does not know the view (``unlike``).
        """
        if still.unread or are_firm([still.box_base_px], [still.confidence], scale=self._scale)[0]:
            return still
        guess = unlike or still.track_id is None or bool(self.among(np.array([still.track_id]))[0])
        return replace(still, doubted=still.doubted or guess)

    def agreed(
        self, ids: npt.NDArray[np.int64], names: Sequence[str], *, aslant: bool | None
    ) -> npt.NDArray[np.bool_]:
        """(N,) True where the detections so far agree on this class; ``aslant`` on none but a car."""
        unknown, otherwise = _Evidence(np.zeros(2)), 2.0 if aslant else _AGREED_ELSE
        means = [
            self._seen.get(one, unknown).mean(name) for one, name in zip(ids.tolist(), names, strict=True)
        ]
        return np.array(means) >= [_AGREED.get(name, otherwise) for name in names]

    def _guessed(self, ids: Sequence[int], names: Sequence[str], boxes: Boxes) -> frozenset[int]:
        sides = (boxes[:, 2:] - boxes[:, :2]).max(1, initial=0)
        groups = np.array([group_of(name) or name for name in names], object)
        means = np.array([self._seen[one].mean() for one in ids])
        likely = np.where(groups == "person", _LIKELY_ODD, _LIKELY)
        found = set()
        for row in np.flatnonzero(means < _LIKELY_ODD).tolist():
            like = sides[(means >= likely) & (groups == groups[row])]
            larger = sides[row] / np.median(like) if len(like) >= _NEIGHBOURS else np.nan
            surer = boxes[(means > means[row]) & (groups == groups[row])]
            on = bool((shared_of_smaller(boxes[row, None], surer) > _ON).any())
            odd = larger >= _LARGER or on
            usual = groups[row] != "person" and not odd and larger > 1 / _LARGER
            weak = means[row] < (_LIKELY_ODD if odd else likely[row])
            moved = self._seen[ids[row]].moved and not on  # a car's bonnet moves with the car
            if weak and not (usual or moved):
                found.add(ids[row])
        return frozenset(found)


def are_firm(
    boxes_base_px: Boxes | Sequence[tuple[float, ...]],
    confidences: npt.NDArray[np.floating] | Sequence[float],
    *,
    scale: float,
) -> npt.NDArray[np.bool_]:
    """(N,) True where stills know them, however weak they are on the base; ``scale`` is base per source pixel."""
    boxes = np.asarray(boxes_base_px)
    sides = (boxes[:, 2:] - boxes[:, :2]).min(axis=1, initial=np.inf)
    return np.asarray((np.asarray(confidences) > SURE) & (sides >= LEAST_SURE_PX * scale))
