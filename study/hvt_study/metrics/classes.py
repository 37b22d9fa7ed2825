"""Classes of tracks over time: every track at every frame, before and after refinement.

Boxes and labels are matched at each frame (`judged.matched_rows`), whatever their classes; then the names of each
pair are compared. A still that names one track right for the rest of its life counts at every frame from then on, and
a track that was never refined counts as often as one that was.

Named F1 is the headline of the study: a box is right where it is matched with a label and bears its class, every
other box is false and every other label missed, so that nothing is won by listing more.

Macro-F1 is scikit-learn's ``f1_score(average="macro")`` over the classes of the labels.

How long an object is there before the ground shows it with its right class.

A true track is watched from the capture of its first judged frame until the list of its last one is shown. One that
is never shown right is *censored*: it would have taken longer than it was watched. Quantiles are those of the
Kaplan-Meier estimate (Kaplan and Meier 1958), which leaves out neither the censored ones (that would flatter every
method that misses much) nor the time that they waited.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import CensoredData, ecdf

from hvt_study.datasets.labels import NO_ID
from hvt_study.metrics.judged import LIMITS_PX2, SIZES, Judged, Size, matched_rows, of_size

_NOBODY = -1
"""Stands for the class of an object without a partner."""

_Codes = npt.NDArray[np.int64]
"""Classes as numbers, the same for labels and boxes."""


@dataclass(frozen=True, slots=True)
class ClassCounts:
    """Labels over some frames."""

    right: int = 0
    """Found, and shown with their class."""
    found: int = 0
    """Matched with a box that is shown."""
    labels: int = 0

    @property
    def top1_found(self) -> float:
        """Share of those found that have their class; NaN where nothing was found."""
        return self.right / self.found if self.found else math.nan

    @property
    def top1_all(self) -> float:
        """Share of all labels, missed ones included, that are shown with their class; NaN without labels."""
        return self.right / self.labels if self.labels else math.nan


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Score of one sequence, for the names before or after refinement."""

    counts: ClassCounts
    boxes: int
    """Shown, as judged, over all frames."""
    frames: int
    """Judged, also those that show nothing."""
    macro_f1_found: float
    """Over the matched pairs alone: how well the classes are told apart. NaN where nothing was found."""
    macro_f1_all: float
    """A missed label is a false negative of its class, a box on nothing a false positive of its own. NaN without
    labels."""
    by_size: Mapping[Size, ClassCounts]
    """By the label's area in source pixels."""

    @property
    def recall(self) -> float:
        """Share of the labels that were found, whatever the class; NaN without labels."""
        return self.counts.found / self.counts.labels if self.counts.labels else math.nan

    @property
    def precision(self) -> float:
        """Share of the boxes that are on a label; NaN without boxes."""
        return self.counts.found / self.boxes if self.boxes else math.nan

    @property
    def f1(self) -> float:
        """2 found / (labels + boxes), whatever the classes; NaN without labels."""
        return self._f1(self.counts.found)

    @property
    def named_f1(self) -> float:
        """2 right / (labels + boxes); NaN without labels."""
        return self._f1(self.counts.right)

    def _f1(self, hits: int) -> float:
        return 2 * hits / (self.counts.labels + self.boxes) if self.counts.labels else math.nan

    @property
    def false_per_frame(self) -> float:
        """Boxes on no label, or of another class than theirs, a frame; NaN without frames."""
        return (self.boxes - self.counts.right) / self.frames if self.frames else math.nan


@dataclass(frozen=True, slots=True)
class _Pairs:
    """All labels of a sequence, and all boxes on nothing."""

    true: _Codes
    """(L,) class of each label."""
    said: _Codes
    """(L,) class of its box, `_NOBODY` where it was missed."""
    areas_px2: npt.NDArray[np.float64]
    stray: _Codes
    """(S,) classes of the boxes without a label."""

    def counts(self, rows: npt.NDArray[np.bool_]) -> ClassCounts:
        true, said = self.true[rows], self.said[rows]
        return ClassCounts(int((true == said).sum()), int((said != _NOBODY).sum()), len(true))


def class_score(
    frames: Sequence[Judged], *, refined: bool = True, limits_px2: tuple[float, float] = LIMITS_PX2
) -> ClassScore:
    """Count right classes over every frame of a sequence.

    ``refined`` takes names as shown; False those before refinement, of the very same boxes. ``limits_px2`` are areas
    in source pixels between small and medium, and between medium and large.
    """
    pairs = _paired(frames, refined=refined)
    every = np.ones(len(pairs.true), np.bool_)
    return ClassScore(
        counts=pairs.counts(every),
        boxes=sum(len(one.view) for one in frames),
        frames=len(frames),
        macro_f1_found=_macro_f1(pairs, everything=False),
        macro_f1_all=_macro_f1(pairs, everything=True),
        by_size={size: pairs.counts(of_size(size, pairs.areas_px2, limits_px2=limits_px2)) for size in SIZES},
    )


def _paired(frames: Sequence[Judged], *, refined: bool) -> _Pairs:
    code_of: dict[str, int] = {}
    true: list[_Codes] = [np.empty(0, np.int64)]
    said, stray, areas = list(true), list(true), [np.empty(0)]
    for one in frames:
        labels = _codes(one.class_names, code_of)
        shown = _codes(one.view.class_names if refined else one.view.names_before, code_of)
        rows, columns = matched_rows(one.boxes_xyxy_px, one.view.boxes_xyxy_px).T
        partners = np.full(len(labels), _NOBODY, np.int64)
        partners[rows] = shown[columns]
        true.append(labels)
        said.append(partners)
        stray.append(np.delete(shown, columns))
        areas.append(one.areas_px2)
    return _Pairs(np.concatenate(true), np.concatenate(said), np.concatenate(areas), np.concatenate(stray))


def _macro_f1(pairs: _Pairs, *, everything: bool) -> float:
    found = pairs.said != _NOBODY
    if everything:
        nobody = np.full(len(pairs.stray), _NOBODY)
        true, said = np.concatenate((pairs.true, nobody)), np.concatenate((pairs.said, pairs.stray))
        wanted = np.unique(pairs.true)
    else:
        true, said = pairs.true[found], pairs.said[found]
        wanted = np.unique(true)
    if not len(wanted):
        return math.nan
    from sklearn.metrics import f1_score  # noqa: PLC0415 - a second of processor, before a study says a word

    return float(f1_score(true, said, labels=wanted, average="macro", zero_division=0.0))


def _codes(names: Sequence[str], code_of: dict[str, int]) -> _Codes:
    return np.array([code_of.setdefault(name, len(code_of)) for name in names], np.int64)


@dataclass(frozen=True, slots=True)
class FirstCorrect:
    """First correct names of the true tracks of one sequence."""

    waits_s: npt.NDArray[np.float64]
    """(N,) from the first frame's capture until the first list with the right class is shown, or the last list where
    there was none."""
    censored: npt.NDArray[np.bool_]
    """(N,) never shown right."""

    @property
    def tracks(self) -> int:
        return len(self.waits_s)

    @property
    def never(self) -> int:
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
        return self.quantile_s(0.5)

    @property
    def p90_s(self) -> float:
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
