"""How long an object is there before the ground shows it with its right class.

A true track is watched from the capture of its first judged frame until the list of its last one is shown. One that
is never shown right is *censored*: it would have taken longer than it was watched. Quantiles are those of the
Kaplan-Meier estimate (Kaplan and Meier 1958), which leaves out neither the censored ones (that would flatter every
method that misses much) nor the time that they waited.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import CensoredData, ecdf

from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.judged import Judged, matched_rows


@dataclass(frozen=True, slots=True)
class FirstCorrect:
    """Of the true tracks of one sequence."""

    waits_s: npt.NDArray[np.float64]
    """(N,) from the first frame's capture until the first list with the right class is shown, or the last list where
    there was none."""
    censored: npt.NDArray[np.bool_]
    """(N,) never shown right."""

    @property
    def tracks(self) -> int:
        """True tracks."""
        return len(self.waits_s)

    @property
    def never(self) -> int:
        """How many of them were censored."""
        return int(self.censored.sum())

    def quantile_s(self, share: float) -> float:
        """Wait after which this share (0…1) of the tracks is right, by Kaplan-Meier.

        Infinite where that share was not reached as long as anything was watched; NaN without tracks.
        """
        if not self.tracks:
            return math.nan
        seen, never = self.waits_s[~self.censored], self.waits_s[self.censored]
        survival = ecdf(CensoredData(uncensored=seen, right=never)).sf
        done = np.flatnonzero(survival.probabilities <= 1 - share + 1e-12)
        if len(done):
            return float(survival.quantiles[done[0]])
        return math.inf

    @property
    def median_s(self) -> float:
        """See `quantile_s`."""
        return self.quantile_s(0.5)

    @property
    def p90_s(self) -> float:
        """See `quantile_s`."""
        return self.quantile_s(0.9)


def first_correct(
    frames: Sequence[Judged], *, fps: float, shown_s: Sequence[float] | None = None
) -> FirstCorrect:
    """Watch every true track; labels without ids are of none.

    ``fps`` is that of frames; ``shown_s`` says of each when its list was shown, from the capture of the first: who
    waits for a second pass waits for its classes. None: with its capture.
    """
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    right: dict[int, int] = {}
    for frame_index, one in enumerate(frames):
        there = [track for track in one.ids.tolist() if track != NO_ID]
        first = dict.fromkeys(there, frame_index) | first
        last |= dict.fromkeys(there, frame_index)
        right = dict.fromkeys(_right_ids(one), frame_index) | right
    if shown_s is None:
        shown_s = [frame_index / fps for frame_index in range(len(frames))]
    end_s = [shown_s[right.get(track, last[track])] for track in first]
    waits_s = np.array(end_s, np.float64) - np.array(list(first.values()), np.float64) / fps
    return FirstCorrect(waits_s, np.array([track not in right for track in first], np.bool_))


def _right_ids(one: Judged) -> list[int]:
    """True tracks that this frame shows with their class."""
    pairs = matched_rows(one.boxes_xyxy_px, one.view.boxes_xyxy_px).tolist()
    hits = [row for row, column in pairs if one.view.class_names[column] == one.class_names[row]]
    return [track for track in one.ids[hits].tolist() if track != NO_ID]
