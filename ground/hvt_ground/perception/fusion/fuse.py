"""Track-to-track fusion: one list from the ground's own tracker on the base, the edge's tracks, and stills.

An *entity* is one object of the world, with an id that never changes. Up to three sources observe it: a track of
the ground's own, a track of the edge, and stills in which it was found. It is *ground-only*, *edge-only* or
*matched*.

**Association.** Sources stay with their entity. If a ground-only and an edge-only entity (or one that only a still
has shown) overlap by `PAIR_IOU`, they are matched: the assignment of the most overlap in sum, and the older id
stays. A new track of the edge where another has just ended is the same under a new number. Two matched tracks that
lie apart (`APART_IOU`) at two steps in a row are split. Ids are one sequence for all, so without an edge's report
they are the order in which tracks were listed first.

**Box.** A reported box is moved from its frame by the camera's motion (`CameraPath`) and by the object's own
velocity over its last steps; a matched one also by the motion of our box since. The fused box is the mean of both,
weighted by confidence and age: the weight halves every `HALF_LIFE_S`, and the edge's counts `EDGE_BOX_WEIGHT`
times.

**Class.** Each side has one vote, the class that its own tracker has settled on; its weight is the confidence,
smoothed over some detections. The edge's counts `EDGE_CLASS_WEIGHT` times, and as often more as its source is finer
than the base. The classes of stills come after, in `refine`, and stand above both.

**Expiry.** All entities end where another scene begins. An edge's track ends when two steps in a row do not list it,
or when nothing is reported of it for `PATIENCE_S`, or for twice the time from one step to the next where that is
longer. An entity that only a still has shown ends `PATIENCE_S` after the still. A box of the edge whose way since is
not known, for it came once, is moving or leaves the picture, is not listed after `REACH_S`: it would stand on an
empty road.

**Missed-detection evidence.** An edge-only entity is listed from a sure confidence on. If a step shows nothing at a
ground-only one, of a class that the edge can name, it must be the surer the larger the share of objects is that the
edge usually reports (`MissedDetections`). That ends when nothing is reported for `PATIENCE_S`, and does not hold
for `FORGET_S` after a still has shown it.

**Duplicates.** A box of one side on top of one of the other is listed once (`SAME_IOU`); so are two boxes of
different class that are almost one (`TWIN_IOU`; less, and riders vanish on their motorcycles), which class-wise
suppression lets pass. Without an edge's report the list is the tracker's, box for box.

The constants were tried out on a 90-pixel and a 15-pixel scene at 200 and 800 kbit/s, steps three times a second
and 0.2 s late, against the list of one side alone. F1 does not depend on them much (0.01); the class agreement
gains 0.01 where the edge's class counts double.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.association import assign
from hvt_common.values import Detections, Tracks, iou
from hvt_ground.perception.fusion.entity import (
    MISSED_STEPS,
    CameraPath,
    Entity,
    MissedDetections,
    Observation,
)
from hvt_ground.perception.fusion.object_list import FusedTracks, FusionRules, list_entities, reported_boxes

__all__ = ["FusedTracks", "Fusion", "unified_names"]

PAIR_IOU = 0.3
"""Lower than the usual half: boxes of 15 pixels from two detectors, some frames apart, seldom reach that."""
APART_IOU = 0.1
CLASS_BONUS = 0.05
"""Bonus for the same class, to choose between two partners that fit equally well."""
PATIENCE_S = 2.0
REACH_S = 1.0
"""For how long the motion of an object is extrapolated."""
HALF_LIFE_S = 0.3
EDGE_CLASS_WEIGHT = 0.85
"""At equal size nearly as much as ours: the drone's network is often the smaller one. A small object in the base is
surely called a car: on drawn scenes at 640x360, a third of the source, 8 of 94 objects were."""
FORGET_S = 10.0
"""How long an entity that nothing observes keeps its id for a track that is found again."""
MAX_ENTITIES = 2048
_REMEMBERED_OWN = 64


def unified_names(own: Sequence[str], edge: Sequence[str]) -> tuple[tuple[str, ...], npt.NDArray[np.int32]]:
    """Our detector's names and those that only the edge's has, and the place there of each of the edge's."""
    names = list(own)
    places = {name.strip().casefold(): place for place, name in reversed(list(enumerate(own)))}
    lookup = []
    for name in edge:
        key = name.strip().casefold()
        if key not in places:
            places[key] = len(names)
            names.append(name)
        lookup.append(places[key])
    return tuple(names), np.array(lookup, np.int32)


class Fusion:
    """The entities of one session. The ``take_…`` methods update it; `listed` changes nothing.

    ``edge_classes`` maps class ids of the edge to the unified names; ``base_per_source`` is base pixels a source
    pixel (`View.scale`). The caller feeds ``path``.
    """

    def __init__(
        self,
        *,
        fps: float,
        edge_classes: npt.NDArray[np.int32],
        path: CameraPath,
        base_per_source: float = 1.0,
    ) -> None:
        self._edge_classes = edge_classes
        self.path = path
        self._rules = FusionRules(
            patience=max(1, round(PATIENCE_S * fps)),
            reach=max(1, round(REACH_S * fps)),
            half_life=HALF_LIFE_S * fps,
            edge_class_weight=EDGE_CLASS_WEIGHT / base_per_source,
        )
        self._usual_patience = self._rules.patience
        self._forget = max(1, round(FORGET_S * fps))
        self._missed = MissedDetections(edge_classes, fps=fps, still_frames=self._forget)
        self._entities: list[Entity] = []
        self._own: OrderedDict[int, Tracks] = OrderedDict()
        self._next_id = 1
        self._stepped = -1
        self._merged: list[tuple[int, int]] = []

    def known_as(self, edge_track_id: int) -> int | None:
        """The id that a track of the edge is listed under; None while it is not."""
        entity = self._by_edge().get(edge_track_id)
        return None if entity is None else entity.id or None

    def own_at(self, frame_index: int) -> Tracks | None:
        """Our own tracks at that frame, or the newest before it that are remembered."""
        return next((self._own[index] for index in reversed(self._own) if index <= frame_index), None)

    def take_merged(self) -> list[tuple[int, int]]:
        """Return and forget (id that stays, id that is gone) of listed entities that turned out to be one."""
        merged, self._merged = self._merged, []
        return merged

    def end_scene(self, frame_index: int) -> None:
        """End all entities: another scene began with that frame. Steps of frames before it are ignored."""
        self._entities = []
        if self._stepped >= 0:
            self._stepped = max(self._stepped, frame_index - 1)

    def take_own(self, own: Tracks) -> None:
        """Take our tracker's list of the newest frame; frames rise."""
        self._own[own.frame_index] = own
        if len(self._own) > _REMEMBERED_OWN:
            self._own.popitem(last=False)
        by_own = self._by_own()
        for row, own_id in enumerate(own.ids.tolist()):
            entity = by_own.get(own_id)
            if entity is None:
                entity = self._add(Entity(own_id=own_id, born=int(own.born_frames[row])))
            entity.born = min(entity.born, int(own.born_frames[row]))
            entity.last_frame = max(entity.last_frame, own.frame_index)
            if own.seen_frames[row] > entity.voted_frame:  # the detector may have searched an earlier picture
                entity.voted_frame = int(own.seen_frames[row])
                entity.own_vote.update(int(own.class_ids[row]), float(own.confidences[row]))
        self._update(own, own.frame_index)

    def take_step(self, step: Tracks, *, own: Tracks | None) -> bool:
        """Take the list of the edge's tracker at one frame, which may be before or after our newest frame.

        ``own`` are our tracks at that frame, as far as they are known. False for a step that is not newer than the
        last one: it is ignored.
        """
        frame_index = step.frame_index
        if frame_index <= self._stepped:
            return False
        if self._stepped >= 0:
            self._rules = replace(self._rules, patience=self._patience(frame_index - self._stepped))
        self._stepped = frame_index
        listed = {int(step.ids[row]): row for row in _usable(step, classes=len(self._edge_classes))}
        for edge_id, entity in self._by_edge().items():
            row = listed.pop(edge_id, None)
            entity.missed = entity.missed + 1 if row is None else 0
            if row is not None:
                self._update_edge(entity, step, row)
        self._associate(step, list(listed.values()))
        if own is not None:
            self._split(own, frame_index)
        self._update(own, frame_index)
        if own is not None:
            by_own = self._by_own()
            self._note_own(own, frame_index, by_own)
            self._missed.take(step, own, by_own=by_own)
        return True

    def take_found(self, found: Detections, *, known: Tracks) -> None:
        """Take objects that stills of one frame show and that nobody named; class ids unified, boxes base pixels.

        ``known`` is the list at that frame: an object that overlaps one of it is not new.
        """
        frame_index = known.frame_index
        boxes = np.concatenate((known.boxes_xyxy_px, found.boxes_xyxy_px))
        for row in range(len(found)):
            place = len(known) + row
            if (iou(boxes[place : place + 1], boxes[:place]) >= PAIR_IOU).any():
                continue
            confidence = float(found.confidences[row])
            entity = self._add(Entity(born=frame_index, still_frame=frame_index, last_frame=frame_index))
            entity.reported = Observation(
                found.boxes_xyxy_px[row].astype(np.float64), frame_index, confidence
            )
            entity.edge_vote.update(int(found.class_ids[row]), confidence)
        self._update(self._own.get(frame_index), frame_index)

    def take_box(self, track_id: int, box_base_px: Sequence[float], *, frame_index: int) -> None:
        """Take the box of a listed entity in a still, at the still's frame.

        It confirms one that only stills know, and moves it. Where we have a track of our own its box is corrected by
        the same amount from then on, less with time. A box of the edge is as good as the still's.
        """
        entity = next((one for one in self._entities if one.id == track_id), None)
        if entity is None:
            return
        box = np.array(box_base_px, np.float64)
        entity.still_frame, entity.is_doubted = max(entity.still_frame, frame_index), False
        observed, own = entity.reported, self._own.get(frame_index)
        if entity.edge_id is None and observed is not None and frame_index > observed.frame_index:
            entity.reported = observed.updated(box, frame_index, observed.confidence, path=self.path)
            entity.last_frame = max(entity.last_frame, frame_index)
        if own is not None and entity.own_id in own.ids:
            row = int(np.flatnonzero(own.ids == entity.own_id)[0])
            entity.correction = (box - own.boxes_xyxy_px[row], frame_index)

    def listed(self, own: Tracks) -> FusedTracks:
        """The list at the frame of ``own``: our tracker's list of a frame, or moved on from the newest."""
        reporting = own.frame_index - self._stepped <= self._rules.patience
        return list_entities(self._entities, own, path=self.path, rules=self._rules, doubting=reporting)

    # Learning

    def _patience(self, gap: int) -> int:
        # How long a step counts, in frames, if the one before it came ``gap`` frames earlier.
        usual = self._usual_patience
        return usual if 2 * gap <= usual else min(2 * gap, max(usual, self._forget))

    def _add(self, entity: Entity) -> Entity:
        self._entities.append(entity)
        return entity

    def _by_own(self) -> dict[int, Entity]:
        return {one.own_id: one for one in self._entities if one.own_id is not None}

    def _by_edge(self) -> dict[int, Entity]:
        return {one.edge_id: one for one in self._entities if one.edge_id is not None}

    def _update_edge(self, entity: Entity, step: Tracks, row: int) -> None:
        frame_index, confidence = step.frame_index, float(step.confidences[row])
        box, observed = step.boxes_xyxy_px[row].astype(np.float64), entity.reported
        if observed is None or frame_index - observed.frame_index > self._rules.patience:
            entity.reported = Observation(box, frame_index, confidence)
        else:
            entity.reported = observed.updated(box, frame_index, confidence, path=self.path)
        entity.last_frame = max(entity.last_frame, frame_index)
        entity.edge_vote.update(int(self._edge_classes[step.class_ids[row]]), confidence)

    def _associate(self, step: Tracks, fresh: Sequence[int]) -> None:
        # Find which of the edge's new tracks continue one that it no longer lists; the others are new entities.
        frame_index = step.frame_index
        merged = [
            entity
            for entity in self._entities
            if (entity.edge_id is None or entity.missed) and self._is_edge_only(entity, frame_index)
        ]
        continued: dict[int, Entity] = {}
        if merged and fresh:
            overlaps = iou(self._reported_boxes(merged, frame_index), step.boxes_xyxy_px[fresh])
            continued = {fresh[column]: merged[line] for line, column in _pairs(overlaps)}
        for row in fresh:
            edge_id = int(step.ids[row])
            entity = continued.get(row)
            if entity is None:
                entity = self._add(Entity(edge_id=edge_id, born=min(frame_index, int(step.born_frames[row]))))
            else:
                entity.edge_id, entity.missed = edge_id, 0
            self._update_edge(entity, step, row)

    def _split(self, own: Tracks, frame_index: int) -> None:
        rows = {own_id: row for row, own_id in enumerate(own.ids.tolist())}
        for entity in list(self._entities):
            row = rows.get(entity.own_id) if entity.own_id is not None else None
            if row is None or entity.reported is None or entity.reported.frame_index != frame_index:
                continue
            if frame_index - int(own.seen_frames[row]) > self._rules.half_life:
                continue  # ours is a guess by now and says nothing against the edge's
            overlap = iou(entity.reported.box[None], own.boxes_xyxy_px[row : row + 1])[0, 0]
            entity.apart = entity.apart + 1 if overlap < APART_IOU else 0
            if entity.apart >= MISSED_STEPS:
                other = Entity(own_id=entity.own_id, born=int(own.born_frames[row]), last_frame=frame_index)
                other.own_vote = entity.own_vote
                self._add(other)
                entity.part_from_own()

    def _note_own(self, own: Tracks, frame_index: int, by_own: Mapping[int, Entity]) -> None:
        # Remember where our own boxes are at this frame: how they move from here moves the edge's box too.
        centres = (own.boxes_xyxy_px[:, :2] + own.boxes_xyxy_px[:, 2:]).astype(np.float64) / 2
        for row, own_id in enumerate(own.ids.tolist()):
            entity = by_own.get(own_id)  # a step that comes late finds tracks merged away since
            if entity is not None:
                entity.own_then = (centres[row], frame_index)

    # After news

    def _update(self, own: Tracks | None, frame_index: int) -> None:
        if own is not None:
            self._pair(own, frame_index)
        self._forget_old(frame_index)
        for entity in self._entities:
            if not entity.id:
                entity.id = self._next_id
                self._next_id += 1

    def _pair(self, own: Tracks, frame_index: int) -> None:
        rows = {own_id: row for row, own_id in enumerate(own.ids.tolist())}
        theirs = [
            one for one in self._entities if one.own_id not in rows and self._is_edge_only(one, frame_index)
        ]
        if not theirs:
            return
        ours = [
            one for one in self._entities if one.own_id in rows and not self._is_edge_only(one, frame_index)
        ]
        places = [rows[one.own_id] for one in ours if one.own_id is not None]
        overlaps = iou(own.boxes_xyxy_px[places], self._reported_boxes(theirs, frame_index))
        classes = np.array([one.edge_vote.class_id for one in theirs])
        same = own.class_ids[places][:, None] == classes[None]
        for line, column in _pairs(overlaps, bonus=CLASS_BONUS * same):
            self._merge(ours[line], theirs[column])

    def _merge(self, ours: Entity, theirs: Entity) -> None:
        # One entity of two; the one with the older id stays.
        if ours.id and theirs.id:
            self._merged.append((min(ours.id, theirs.id), max(ours.id, theirs.id)))
        survivor, merged = (
            (theirs, ours) if theirs.id and (not ours.id or theirs.id < ours.id) else (ours, theirs)
        )
        survivor.born = min(survivor.born, merged.born)
        survivor.last_frame = max(survivor.last_frame, merged.last_frame)
        survivor.still_frame = max(survivor.still_frame, merged.still_frame)
        survivor.own_id, survivor.own_vote, survivor.correction = ours.own_id, ours.own_vote, ours.correction
        survivor.own_then = ours.own_then
        survivor.edge_id, survivor.edge_vote = theirs.edge_id, theirs.edge_vote
        survivor.reported, survivor.missed, survivor.apart = theirs.reported, theirs.missed, 0
        survivor.unlisted, survivor.is_doubted = 0, False
        self._entities.remove(merged)

    def _forget_old(self, frame_index: int) -> None:
        self._entities = [one for one in self._entities if frame_index - one.last_frame <= self._forget]
        for old in sorted(self._entities, key=lambda one: one.last_frame)[:-MAX_ENTITIES]:
            self._entities.remove(old)

    def _is_edge_only(self, entity: Entity, frame_index: int) -> bool:
        return entity.is_report_live(frame_index, patience=self._rules.patience)

    def _reported_boxes(self, entities: Sequence[Entity], frame_index: int) -> npt.NDArray[np.float64]:
        return reported_boxes(entities, frame_index, path=self.path, reach=self._rules.reach)


def _usable(step: Tracks, *, classes: int) -> list[int]:
    # Rows with a class that the edge has named and a box with an area.
    boxes = step.boxes_xyxy_px
    usable = (step.class_ids >= 0) & (step.class_ids < classes) & np.isfinite(boxes).all(axis=1)
    usable &= (boxes[:, 2:] > boxes[:, :2]).all(axis=1)
    rows: list[int] = np.flatnonzero(usable).tolist()
    return rows


def _pairs(
    overlaps: npt.NDArray[np.float64], *, bonus: npt.NDArray[np.float64] | float = 0.0
) -> list[tuple[int, int]]:
    # (row, column) of those that belong together, one to one, none below `PAIR_IOU`.
    cost = np.where(overlaps >= PAIR_IOU, 1 - overlaps - bonus, 2.0)
    rows, columns = assign(cost, limit=1.5)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
