"""The shadow ground: which of the source's objects the ground's detector would miss on the base stream.

The edge decodes its own stream and holds the untouched source, so it can measure instead of guess. Now and then, on a
frame whose source the detector has just searched, it runs the detector on the decoded base frame too, as the ground
does, and compares object by object. The detections on the source are taken for true, each box by its
confidence: with a calibrated detector a box of .6 is real three times in five. So a box that the base does not
show counts as much for being sent as against it.

Expected named F1 of a list (F1 = 2 TP / (listed + true); a box counts only under its class; expectations by the
confidences p, those of base-only boxes after the source's missed detection, `Recall.real`):

    true    = sum of p over source boxes and base-only boxes
    base    = 2 (sum of p over source boxes that the base shows, w of it where it bears another class there,
                and over base-only boxes) / (shown + base-only + true)
    sent    = 2 (sum of p over shown and hidden boxes, 1 - w of it where the base bears another class,
                and over base-only boxes but the suppressed) / (shown + hidden + base-only - suppressed + true)

``hidden`` are the source boxes that the base does not show and the ground would list: from `EDGE_ONLY_CONFIDENCE` on.
``suppressed`` are the base-only boxes that the ground no longer lists once the edge's tracks miss them.
``w`` is 1/3: of two names for one object the finer picture's name is right twice as often (our choice).

The ground's detector may be another, or none. It reports how many objects it shows; where that differs from the count
found on the base here, the difference counts as hidden, or as shown, instead (`Shadow.corrected`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.recall import EDGE_ONLY_CONFIDENCE, Recall
from hvt_common.units import SECOND_NS
from hvt_common.values import Detections, Image, iou
from hvt_edge.perception.analyzer import AnalyzedFrame
from hvt_edge.perception.auto import Measured
from hvt_edge.perception.cpu_budget import CpuBudget

_MOST_OPEN = 32
"""Comparisons that wait for a report: half a minute of them."""
_LEAST_WORTH = 0.5
"""Least weight of comparisons: below it nothing is known; the last one counts for some twenty seconds."""
_LEAST_MORE = 0.5
"""Least difference between the ground's number of objects and the edge's."""
_BASE_NAMES = 1 / 3
"""How often the base's name is right if base and source name an object differently."""
_REST_NS, _QUICK_REST_NS = SECOND_NS, SECOND_NS // 3
"""Least capture time from one comparison to the next, twice as long while `ShadowGround.stable`; the shorter time
applies to the first comparisons, …"""
_QUICK_COMPARISONS = 2.5
"""… up to this weight, because nothing is known yet."""
_MEMORY_S = 8.0
"""Time constant with which earlier comparisons fade."""
_SAME_SHARE = 0.75
"""Share of tracks in common with the comparison before: with fewer it is another view."""
_MATCH_IOU = 0.3
"""The ground's own limit for one object: boxes of 15 pixels from two pictures seldom overlap more."""


@dataclass(frozen=True, slots=True)
class Detected:
    """A ground's report of its own detector."""

    receiver_id: int
    frame_index: int
    """The last frame that it has processed."""
    objects: int
    """Number of objects that it showed at its last detection up to that frame."""


class GroundDifference:
    """Mean surplus of objects at the ground over the edge, the newest counting most. Deterministic; not thread-safe.

    The counts are of about the same frame, so that a scene which fills or empties makes no difference.
    """

    def __init__(self) -> None:
        self._receiver_id: int | None = None
        self.forget()

    def forget(self) -> None:
        """The scene has changed: reports of the one before say nothing of it."""
        self._open: deque[tuple[int, int, float]] = deque(maxlen=_MOST_OPEN)
        """(frame, capture time, number of objects here) of comparisons that no report has covered."""
        self._mean, self._worth = 0.0, 0.0
        self._worth_ns: int | None = None
        self._first_ns: int | None = None

    @property
    def mean(self) -> float | None:
        """The mean; below 0 where the ground shows fewer. None where it has not reported, or not for a while."""
        return self._mean if self._worth >= _LEAST_WORTH else None

    def expect(self, frame_index: int, objects: float, *, capture_ns: int) -> None:
        """Note the number of objects found here on the base picture of this frame."""
        self._fade(capture_ns)
        self._open.append((frame_index, capture_ns, objects))

    def take(self, report: Detected) -> None:
        """Compare a report with the number found here on the newest frame that it covers."""
        if report.receiver_id != self._receiver_id:  # another model, perhaps
            self._receiver_id = report.receiver_id
            self._mean, self._worth, self._first_ns = 0.0, 0.0, None
        covered = None
        while self._open and self._open[0][0] <= report.frame_index:
            covered = self._open.popleft()
        if covered is None:
            return
        _, capture_ns, objects = covered
        self._first_ns = capture_ns if self._first_ns is None else self._first_ns
        if capture_ns - self._first_ns < _REST_NS:
            return  # the first picture of a ground or a scene is coarser than others
        self._worth += 1
        self._mean += (report.objects - objects - self._mean) / self._worth

    def _fade(self, now_ns: int) -> None:
        if self._worth_ns is not None:
            self._worth *= math.exp(-max(0, now_ns - self._worth_ns) / SECOND_NS / _MEMORY_S)
        self._worth_ns = now_ns


@dataclass(frozen=True, slots=True)
class Shadow:
    """The measured gains as means per picture, the newest counting most; see the module for ``p``."""

    comparisons: float = 0.0
    """Weight of the comparisons behind the means."""
    source_p: float = 0.0
    """Sum of the confidences of all boxes of the source."""
    shown: float = 0.0
    """Source boxes that the base shows too."""
    shown_p: float = 0.0
    hidden: float = 0.0
    """Source boxes that the base does not show and the ground would list."""
    hidden_p: float = 0.0
    misnamed: float = 0.0
    misnamed_p: float = 0.0
    false: float = 0.0
    """Boxes of the base where the source has none."""
    false_p: float = 0.0
    suppressed: float = 0.0
    """False boxes that the ground would not list if it were sent tracks."""
    suppressed_p: float = 0.0

    @property
    def misnamed_share(self) -> float:
        return self.misnamed / self.shown if self.shown else 0.0

    @property
    def gain(self) -> float:
        """The gain in expected named F1 of the ground's list from the source's boxes; 0 at first."""
        return self._gain(1.0)

    @property
    def sure_gain(self) -> float:
        """The same without one standard error of the tracks' changes (Poisson).

        Pictures of one second show the same objects, and on two or three of them the detector may just be wrong.
        """
        changed = self.hidden + self.misnamed + self.suppressed
        return self._gain(1 - 1 / math.sqrt(changed)) if changed > 1 else 0.0

    def corrected(self, more: float, *, sure: bool) -> Shadow:
        """The same for a ground whose own detector shows ``more`` objects than were found here; below 0: fewer.

        With ``sure`` one standard error of the count is subtracted (Poisson). Less than half an object counts as
        none. The report names no objects: each is taken to be as sure as the others of its kind here.
        """
        found = self.shown + self.false
        error = math.sqrt(max(found, found + more)) if sure else 0.0
        moved = math.copysign(max(0.0, abs(more) - error), more) if abs(more) >= _LEAST_MORE else 0.0
        # With fewer objects each kind that is shown here loses the same share.
        left = 1 + max(-1.0, min(0.0, moved) / found) if found else 1.0
        moved = min(self.hidden, moved) if moved > 0 else (left - 1) * self.shown
        moved_p = moved * (_per(self.hidden_p, self.hidden) if moved > 0 else _per(self.shown_p, self.shown))
        return replace(
            self,
            shown=self.shown + moved,
            shown_p=self.shown_p + moved_p,
            hidden=self.hidden - moved,
            hidden_p=self.hidden_p - moved_p,
            **{name: getattr(self, name) * left for name in _SHOWN_OR_FALSE},
        )

    @property
    def measured(self) -> Measured:
        return Measured(
            comparisons=self.comparisons,
            gain=self.gain,
            sure_gain=self.sure_gain,
            hidden=self.hidden,
            suppressed=self.suppressed,
            misnamed=self.misnamed,
            misnamed_share=self.misnamed_share,
        )

    def _gain(self, share: float) -> float:
        # The gain of F1 if only this share of the tracks' changes is true.
        true = self.source_p + self.false_p
        if not true:
            return 0.0
        hidden, suppressed = share * self.hidden, share * self.suppressed
        hidden_p, misnamed_p, suppressed_p = (
            share * p for p in (self.hidden_p, self.misnamed_p, self.suppressed_p)
        )
        named_p = self.shown_p + self.false_p - (1 - _BASE_NAMES) * misnamed_p
        sent_p = self.shown_p + self.false_p - suppressed_p + hidden_p - _BASE_NAMES * misnamed_p
        listed = self.shown + self.false
        return 2 * sent_p / (listed + hidden - suppressed + true) - 2 * named_p / (listed + true)


_SHOWN_OR_FALSE = ("misnamed", "misnamed_p", "false", "false_p", "suppressed", "suppressed_p")


def _per(total: float, count: float) -> float:
    return total / count if count else 0.0


UNMEASURED = Shadow()


class ShadowGround:
    """Compares source and base now and then, if ``cpu_budget`` admits it.

    ``detect`` runs the detector on a whole picture, as the ground does; it returns None while it does not work. A
    detection of at least ``confidence`` starts a track, at the edge and at the ground.
    It continues from the measurements of the scene ``before``.
    """

    def __init__(
        self,
        detect: Callable[[Image], Detections | None],
        *,
        confidence: float,
        cpu_budget: CpuBudget | None = None,
        before: Shadow = UNMEASURED,
    ) -> None:
        self._detect = detect
        self._confidence = confidence
        self._cpu_budget = cpu_budget or CpuBudget()
        self._next_ns = 0
        self._last_ns: int | None = None
        self._shown_ids = np.empty(0, np.int64)
        """Tracks that the base showed at the comparison before."""
        self._compared_ids = self._shown_ids
        self.stable = False
        """The caller says that another comparison soon would change no decision."""
        self.scene_began = -1
        """The frame with which this scene began."""
        self._moved = 0.0
        self._recall = Recall()
        """The share of the base's sure objects that the source shows too."""
        self.now = before
        """The measurement for a ground with the edge's detector."""
        self._difference = GroundDifference()

    @property
    def measured(self) -> Measured:
        """The measured gains of tracks, corrected by the ground's reports."""
        more = self._difference.mean
        if more is None:
            return replace(self.now.measured, moved=self._moved)
        plain, sure = (self.now.corrected(more, sure=sure) for sure in (False, True))
        reported = plain.hidden > self.now.hidden
        return replace(plain.measured, sure_gain=sure.sure_gain, reported=reported, moved=self._moved)

    def take_detected(self, report: Detected) -> None:
        self._difference.take(report)

    def compare(self, seen: AnalyzedFrame) -> bool:
        """Compare, if this is a decision step on a coded frame and a comparison is due; tell whether it was done."""
        capture_ns = seen.frame.capture_ns
        if seen.scene_began > self.scene_began:
            self.scene_began = seen.scene_began
            self._forget()
        if not seen.detected or seen.base is None or capture_ns < self._next_ns:
            return False
        if self.stable and capture_ns < self._next_ns + _REST_NS and self._same_view(seen):
            return False
        if not self._next_ns:  # the first picture of a stream is coarser than any other
            self._next_ns = capture_ns + _QUICK_REST_NS
            self._last_ns = capture_ns  # earlier measurements have not aged
            return False
        if not self._cpu_budget.admits_comparison(capture_ns):
            return False
        base_bgr = seen.base_bgr
        assert base_bgr is not None, "checked"
        with self._cpu_budget.spending("compare"):
            found = self._detect(base_bgr)
        quick = self.now.comparisons < _QUICK_COMPARISONS
        self._next_ns = capture_ns + (_QUICK_REST_NS if quick else _REST_NS)
        if found is None:
            return False
        one, gain = self._compared(seen, found), self.now.gain
        self._take(one, capture_ns)
        self._moved = abs(self.now.gain - gain)
        self._compared_ids = seen.tracks.ids
        self._difference.expect(seen.frame.index, one.shown + one.false, capture_ns=capture_ns)
        return True

    def _forget(self) -> None:
        # Another scene: measurements of the last one say nothing of it.
        self.now, self._last_ns, self._next_ns, self.stable = UNMEASURED, None, 0, False
        self._difference.forget()
        self._recall = Recall()
        self._shown_ids = np.empty(0, np.int64)

    def _same_view(self, seen: AnalyzedFrame) -> bool:
        then, now = self._compared_ids, seen.tracks.ids
        return len(np.intersect1d(then, now)) >= _SAME_SHARE * max(len(then), len(now))

    def _compared(self, seen: AnalyzedFrame, found: Detections) -> Shadow:
        tracks, least = seen.tracks, self._confidence
        rows = np.flatnonzero(tracks.seen_frames == tracks.frame_index)
        boxes, p = tracks.boxes_xyxy_px[rows], tracks.confidences[rows].astype(float)
        # A track once shown continues with weak detections too, so a weak one is enough to show the object.
        overlaps = iou(found.boxes_xyxy_px, boxes)
        same = overlaps >= _MATCH_IOU
        strong = found.confidences >= least
        began = np.isin(tracks.ids[rows], self._shown_ids)
        shown = (same & (strong[:, None] | began)).any(axis=0)
        self._shown_ids = tracks.ids[rows][shown]
        hidden = ~shown & (p >= EDGE_ONLY_CONFIDENCE)
        in_source = np.any(same, axis=1)
        sure = found.confidences >= EDGE_ONLY_CONFIDENCE
        self._recall.take(
            found.class_ids[sure], reported=in_source[sure], at_s=seen.frame.capture_ns / SECOND_NS
        )
        base_only = strong & ~in_source
        base_only_p, suppressed_p = self._base_only(found, np.flatnonzero(base_only))
        misnamed = np.zeros(len(rows), bool)
        if shown.any():
            best = overlaps[:, shown].argmax(axis=0)
            misnamed[shown] = found.class_ids[best] != tracks.class_ids[rows][shown]
        return Shadow(
            comparisons=1,
            source_p=float(p.sum()),
            shown=int(shown.sum()),
            shown_p=float(p[shown].sum()),
            hidden=int(hidden.sum()),
            hidden_p=float(p[hidden].sum()),
            misnamed=int(misnamed.sum()),
            misnamed_p=float(p[misnamed].sum()),
            false=int(base_only.sum()),
            false_p=sum(base_only_p),
            suppressed=len(suppressed_p),
            suppressed_p=sum(suppressed_p),
        )

    def _base_only(self, found: Detections, rows: npt.NDArray[np.int64]) -> tuple[list[float], list[float]]:
        # The probability that each of these base-only boxes is real, and those of the suppressed ones.
        base_only_p, suppressed_p = [], []
        for confidence, class_id in zip(
            found.confidences[rows].tolist(), found.class_ids[rows].tolist(), strict=True
        ):
            base_only_p.append(self._recall.real(confidence, class_id))
            if confidence < self._recall.least_confidence(class_id):
                suppressed_p.append(base_only_p[-1])
        return base_only_p, suppressed_p

    def _take(self, one: Shadow, capture_ns: int) -> None:
        weight = 0.0
        if self._last_ns is not None:
            weight = math.exp(-max(0, capture_ns - self._last_ns) / SECOND_NS / _MEMORY_S)
        self._last_ns = capture_ns
        worth = weight * self.now.comparisons + 1
        means = {
            field.name: (
                weight * self.now.comparisons * getattr(self.now, field.name) + getattr(one, field.name)
            )
            / worth
            for field in fields(Shadow)
            if field.name != "comparisons"
        }
        self.now = Shadow(comparisons=worth, **means)
