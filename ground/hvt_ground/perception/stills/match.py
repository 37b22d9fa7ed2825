"""Which track of the ground a still of the edge belongs to, at the still's own frame.

Evidence is the IoU of the still's box with the track's box at that frame, and the matches of earlier stills:
a track that this edge track was matched to before gains 0.10, one that belongs to another edge track loses
0.25. Evidence of at least the threshold is needed. So two objects that stand close do not exchange their
stills when the ground misses one of them for a moment, and yet a clear overlap corrects an old posterior.

Several stills of one frame are assigned together, one to one, for the greatest sum. If a free track fits
nearly as well as the chosen one and is not merely a second box on the same object, the still is ambiguous and
goes to neither; the detector's class only breaks ties.

A track that the ground's detector saw by that frame, but confirmed only later, is compared at the first frame
that has it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.association import assign
from hvt_common.values import Boxes, Posterior, Tracks, iou
from hvt_ground.events import Refinement
from hvt_ground.perception.stills.decode import Box

KNOWN_BONUS = 0.10
OTHERS_PENALTY = 0.25
CLASS_BONUS = 0.05
AMBIGUITY_MARGIN = 0.08  # below KNOWN_BONUS: an earlier still decides between equals
SAME_OBJECT_IOU = 0.70
_REMEMBERED_TRACKS = 1024
_REMEMBERED_FRAMES = 256

Floats = npt.NDArray[np.float64]


Outcome = Literal["matched", "superseded", "no track", "ambiguous", "frame lost", "late", "overflow", "ended"]
"""The outcome of a still:

matched
    it spoke on the class of ``track_id``.
superseded
    it belongs to ``track_id``, but a still of a later frame has already replaced the class.
no track
    no track of the ground overlaps its box enough at its frame.
ambiguous
    two tracks of the ground fit its box about equally well.
frame lost
    the ground never decoded its frame.
late
    its frame is older than the history, or was not reached within the hold time.
overflow
    more stills wait than are held; the oldest goes.
ended
    it still waited when the stream or its session ended.
"""


@dataclass(frozen=True, slots=True)
class StillSeen:
    """One object of a still that was decoded and read; it may wait for its track."""

    event: Refinement
    """As it is known so far: unmatched it has no track, the class of the edge's detector and that of the still alone.
    Until it is given out it bears the frame and the time of its own picture."""
    posterior: Posterior
    """Its class posterior, over `Vocabulary.names`."""
    side_px: float
    """The shorter side of the object, source pixels."""
    news: float = 1.0
    """How much the still shows that the base did not, 0…1."""
    part: int = 0
    """Number of the object in the still: each is matched by itself, under the still's sequence number."""
    found_base_px: Box | None = None
    """The reader's box of the object."""
    outcome: Outcome | None = None
    """None while it waits."""

    @property
    def key(self) -> tuple[int, int]:
        return self.event.still_sequence, self.part


TrackMatch = tuple[Tracks, int] | Outcome
"""The match of a still: a row of tracks, or why there is none."""


class Matcher:
    """Remembers which edge track is which ground track, for one session and in bounded memory.

    ``least_iou`` is the threshold of the evidence; for ``owned_frames`` after a still a ground track counts as the
    edge track's own.
    """

    def __init__(self, *, least_iou: float, owned_frames: int) -> None:
        self._iou = least_iou
        self._owned_frames = owned_frames
        self._ground_of: OrderedDict[int, tuple[int, int]] = OrderedDict()
        # edge track → (ground track, frame)
        self._edge_of: OrderedDict[int, tuple[int, int]] = OrderedDict()  # ground track → (edge track, frame)
        self._claims: OrderedDict[int, dict[int, int]] = OrderedDict()  # frame → ground track → edge track

    def match(
        self,
        wanted: Sequence[StillSeen],
        tracks: Tracks,
        *,
        later: Iterable[Tracks],
        class_names: Sequence[str],
    ) -> dict[tuple[int, int], TrackMatch]:
        """A `TrackMatch` for each key of ``wanted``, all of which are stills of the frame of ``tracks``.

        ``later`` are the tracks of the following frames, in order, as far as a late confirmation counts.
        ``class_names`` are those of ``tracks.class_ids``. Stills of one edge track go to one ground track.
        """
        groups = _by_edge_track(wanted)
        frame_index = tracks.frame_index
        found = self._assign(groups, tracks, np.arange(len(tracks)), frame_index, class_names)
        known = tracks.ids
        for after in later:
            left = [group for group in groups if isinstance(found[group[0].key], str)]
            if not left:
                break
            fresh = ~np.isin(after.ids, known) & (after.born_frames <= frame_index)
            if fresh.any():
                found |= self._assign(left, after, np.flatnonzero(fresh), frame_index, class_names)
            known = np.union1d(known, after.ids)
        return {want.key: found[group[0].key] for group in groups for want in group}

    def known_as(self, edge_track_id: int) -> int | None:
        """The ground track that the newest still of this edge track went to; None for none."""
        known = self._ground_of.get(edge_track_id)
        return None if known is None else known[0]

    def merge(self, survivor_id: int, merged_id: int) -> None:
        """Two ground tracks have turned out to be one, which goes on under the first id."""
        for edge_id, (ground_id, frame_index) in self._ground_of.items():
            if ground_id == merged_id:
                self._ground_of[edge_id] = (survivor_id, frame_index)
        owner = self._edge_of.pop(merged_id, None)
        if owner is not None:
            self._edge_of.setdefault(survivor_id, owner)

    def _assign(
        self,
        groups: Sequence[Sequence[StillSeen]],
        tracks: Tracks,
        rows: npt.NDArray[np.intp],
        frame_index: int,
        class_names: Sequence[str],
    ) -> dict[tuple[int, int], TrackMatch]:
        # One to one among the tracks in ``rows``, by the key of each group's first; finds are remembered.
        heads = [group[0] for group in groups]
        found: dict[tuple[int, int], TrackMatch] = {head.key: "no track" for head in heads}
        if not heads or not len(rows):
            return found
        boxes = tracks.boxes_xyxy_px[rows]
        preference = self._preference(heads, tracks, rows, frame_index, class_names)
        pairs = assign(-preference, limit=0.0)
        chosen = {int(r): int(c) for r, c in zip(*pairs, strict=True)}
        for r, c in chosen.items():
            taken = [column for row, column in chosen.items() if row != r]
            if _ambiguous(preference[r], c, taken, boxes):
                found[heads[r].key] = "ambiguous"
                continue
            found[heads[r].key] = tracks, int(rows[c])
            self._remember(heads[r].event.edge_track_id, int(tracks.ids[rows[c]]), frame_index)
        return found

    def _preference(
        self,
        heads: Sequence[StillSeen],
        tracks: Tracks,
        rows: npt.NDArray[np.intp],
        frame_index: int,
        class_names: Sequence[str],
    ) -> Floats:
        # (heads, rows) how much each pair is preferred; 0 where the evidence does not reach the threshold.
        wanted_px = np.array([head.event.box_base_px for head in heads], np.float32)
        evidence = iou(wanted_px, tracks.boxes_xyxy_px[rows])
        same_class = np.zeros(evidence.shape, np.bool_)
        claims = self._claims.get(frame_index, {})
        for column, row in enumerate(rows):
            ground_id, name = int(tracks.ids[row]), class_names[tracks.class_ids[row]]
            claimed_by = claims.get(ground_id)
            for line, head in enumerate(heads):
                if claimed_by not in (None, head.event.edge_track_id):
                    evidence[line, column] = -np.inf
                elif evidence[line, column] > 0:
                    evidence[line, column] += self._known(head.event.edge_track_id, ground_id, frame_index)
                same_class[line, column] = head.event.class_before == name
        evidence[evidence < self._iou] = 0.0
        return evidence + CLASS_BONUS * (same_class & (evidence > 0))

    def _known(self, edge_id: int, ground_id: int, frame_index: int) -> float:
        # The bonus or penalty of earlier stills for the overlap of this pair.
        if edge_id >= 0 and self._ground_of.get(edge_id, (None, 0))[0] == ground_id:
            return KNOWN_BONUS
        owner, since = self._edge_of.get(ground_id, (edge_id, frame_index))
        still_owned = self._ground_of.get(owner, (None, 0))[0] == ground_id
        recent = abs(frame_index - since) <= self._owned_frames
        return -OTHERS_PENALTY if owner != edge_id and still_owned and recent else 0.0

    def _remember(self, edge_id: int, ground_id: int, frame_index: int) -> None:
        if edge_id < 0:
            return
        self._claims.setdefault(frame_index, {})[ground_id] = edge_id
        if len(self._claims) > _REMEMBERED_FRAMES:
            self._claims.popitem(last=False)
        for known, key, value in ((self._ground_of, edge_id, ground_id), (self._edge_of, ground_id, edge_id)):
            if frame_index >= known.get(key, (0, -1))[1]:  # an older still does not overrule a newer one
                known[key] = (value, frame_index)
                known.move_to_end(key)
            if len(known) > _REMEMBERED_TRACKS:
                known.popitem(last=False)


def _by_edge_track(wanted: Sequence[StillSeen]) -> list[list[StillSeen]]:
    groups: dict[Hashable, list[StillSeen]] = {}
    for want in wanted:
        edge_id = want.event.edge_track_id
        groups.setdefault(edge_id if edge_id >= 0 else want.key, []).append(want)
    return list(groups.values())


def _ambiguous(preference: Floats, chosen: int, taken: Sequence[int], boxes: Boxes) -> bool:
    # Whether a free track fits nearly as well and is another object.
    near = (preference > 0) & (preference >= preference[chosen] - AMBIGUITY_MARGIN)
    near[[chosen, *taken]] = False
    apart = iou(boxes[chosen : chosen + 1], boxes)[0] < SAME_OBJECT_IOU
    return bool((near & apart).any())
