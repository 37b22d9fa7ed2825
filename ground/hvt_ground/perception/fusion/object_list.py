"""The list of one frame out of all entities: boxes, classes and sources."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_common.tracking.recall import EDGE_ONLY_CONFIDENCE
from hvt_common.values import Tracks, iou
from hvt_ground.events import Origin
from hvt_ground.perception.fusion.entity import CameraPath, Entity, Observation

_Floats = npt.NDArray[np.float64]


SAME_IOU = 0.5
TWIN_IOU = 0.85
EDGE_BOX_WEIGHT = 4.0
"""A box from the source overlaps the truth better than ours on a base of 200 kbit/s even when it is 0.5 s old."""
CORRECTION_WEIGHT = 0.5
"""A still's box stands against one box of ours at that frame, and each is off by a little."""


@dataclass(frozen=True, slots=True)
class FusionRules:
    """Rules that fuse two opinions on one object, where they depend on the session; `fuse` has the reasons."""

    patience: int
    """For how many frames an edge-only track holds."""
    reach: int
    """For how many frames its own motion is extrapolated."""
    half_life: float
    """After how many frames a box counts half."""
    edge_class_weight: float


@dataclass(frozen=True, slots=True)
class FusedTracks:
    """The tracks of one frame and the sources of each."""

    tracks: Tracks
    """Ids are those of the entities; class ids index the unified names."""
    origins: tuple[Origin, ...]
    means: npt.NDArray[np.float32]
    """(N,) of the confidences of both sides; that of the tracks is the surer one's."""


@dataclass(frozen=True, slots=True)
class _Line:
    entity: Entity
    origin: Origin
    row: int | None
    """Row of our own list."""

    @property
    def observed(self) -> Observation | None:
        """The reported box, while it holds."""
        return None if self.origin == "base" else self.entity.reported


def list_entities(
    entities: Sequence[Entity], own: Tracks, *, path: CameraPath, rules: FusionRules, doubting: bool = False
) -> FusedTracks:
    """The list at the frame of ``own``, our tracker's list there; changes nothing.

    ``doubting``: the edge reports at present, and tracks that it suppresses are left out.
    """
    lines = _lines(entities, own, rules, doubting=doubting)
    boxes = _boxes(lines, own, path, rules)
    classes, confidences, means = _classes(lines, own, rules)
    listed = _once_each(lines, boxes, classes, confidences)
    lines = [line for line, is_listed in zip(lines, listed, strict=True) if is_listed]
    born = [line.entity.born for line in lines]
    tracks = Tracks(
        frame_index=own.frame_index,
        ids=np.array([line.entity.id for line in lines], np.int64),
        boxes_xyxy_px=boxes[listed],
        confidences=confidences[listed],
        class_ids=classes[listed],
        born_frames=np.array(born, np.int64),
        seen_frames=np.array([_seen_frame(line, own) for line in lines], np.int64),
        started=np.array([_started(line, own) for line in lines], np.bool_),
    )
    return FusedTracks(tracks, tuple(line.origin for line in lines), means[listed])


def reported_boxes(entities: Sequence[Entity], frame_index: int, *, path: CameraPath, reach: int) -> _Floats:
    """(N, 4) float64: the reported boxes of entities, moved to a frame, base pixels."""
    boxes = np.empty((len(entities), 4))
    by_start: dict[int, list[int]] = {}
    for place, entity in enumerate(entities):
        assert entity.reported is not None
        boxes[place] = entity.reported.box
        by_start.setdefault(entity.reported.frame_index, []).append(place)
    for start, places in by_start.items():
        velocities = np.array(
            [observed.velocity for place in places if (observed := entities[place].reported) is not None]
        )
        moved = velocities * np.clip(frame_index - start, -reach, reach)
        boxes[places] = path.carry(boxes[places], start=start, end=frame_index) + np.tile(moved, 2)
    return boxes


def _lines(entities: Sequence[Entity], own: Tracks, rules: FusionRules, *, doubting: bool) -> list[_Line]:
    rows: Mapping[int | None, int] = {own_id: row for row, own_id in enumerate(own.ids.tolist())}
    lines = []
    for entity in entities:
        origin = entity.origin(rows, own.frame_index, patience=rules.patience, reach=rules.reach)
        unsure = (origin == "edge" and entity.edge_vote.confidence < EDGE_ONLY_CONFIDENCE) or (
            origin == "base" and doubting and entity.is_doubted
        )
        if origin is not None and entity.id and not unsure:
            lines.append(_Line(entity, origin, rows.get(entity.own_id)))
    return sorted(lines, key=lambda line: line.entity.id)


def _boxes(
    lines: Sequence[_Line], own: Tracks, path: CameraPath, rules: FusionRules
) -> npt.NDArray[np.float32]:
    # (N, 4): ours, theirs, or the mean of both, weighted by confidence and age.
    frame_index = own.frame_index
    boxes = np.empty((len(lines), 4))
    observed = [place for place, line in enumerate(lines) if line.observed is not None]
    near = [place for place, line in enumerate(lines) if line.row is not None]
    rows = [line.row for line in lines if line.row is not None]
    boxes[observed] = reported_boxes(
        [lines[place].entity for place in observed], frame_index, path=path, reach=rules.reach
    )
    ours = own.boxes_xyxy_px[rows].astype(np.float64)
    weights = own.confidences[rows] * 0.5 ** ((frame_index - own.seen_frames[rows]) / rules.half_life)
    for place, box, weight in zip(near, ours, weights.tolist(), strict=True):
        entity, reported = lines[place].entity, lines[place].observed
        if reported is None:
            boxes[place] = box if entity.correction is None else box + _correction(entity, frame_index, rules)
            continue
        theirs = _moved_with_ours(entity, reported, box, boxes[place])
        age = abs(frame_index - reported.frame_index)
        against = EDGE_BOX_WEIGHT * reported.confidence * 0.5 ** (age / rules.half_life)
        share = weight / max(weight + against, 1e-9)
        boxes[place] = share * box + (1 - share) * theirs
    return boxes.astype(np.float32)


def _moved_with_ours(entity: Entity, observed: Observation, ours: _Floats, predicted: _Floats) -> _Floats:
    # The edge's box after the way that ours has gone since; the mean of both ways where it has one of its own.
    then = entity.own_then
    if then is None or then[1] != observed.frame_index:
        return predicted
    moved = observed.box + np.tile((ours[:2] + ours[2:]) / 2 - then[0], 2)
    return moved if observed.steps == 1 else (moved + predicted) / 2


def _correction(entity: Entity, frame_index: int, rules: FusionRules) -> _Floats:
    assert entity.correction is not None
    offset, since = entity.correction
    return np.asarray(
        offset * (CORRECTION_WEIGHT * 0.5 ** (max(0, frame_index - since) / rules.half_life)), np.float64
    )


def _classes(
    lines: Sequence[_Line], own: Tracks, rules: FusionRules
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    # (N,) class ids and their confidences: the side that is surer says; and the means of both sides.
    classes, confidences = np.zeros(len(lines), np.int32), np.zeros(len(lines), np.float32)
    means = np.zeros(len(lines), np.float32)
    for place, line in enumerate(lines):
        entity = line.entity
        if line.row is not None:
            classes[place], confidences[place] = own.class_ids[line.row], own.confidences[line.row]
            means[place] = own.confidences[line.row]
        if line.observed is None:
            continue
        means[place] = (means[place] + line.observed.confidence) / (1 + (line.row is not None))
        theirs = rules.edge_class_weight * entity.edge_vote.confidence
        if line.row is None or theirs > entity.own_vote.confidence:
            classes[place] = entity.edge_vote.class_id
        if line.row is None or line.observed.confidence > confidences[place]:
            confidences[place] = line.observed.confidence
    return classes, confidences, means


def _once_each(
    lines: Sequence[_Line],
    boxes: npt.NDArray[np.float32],
    classes: npt.NDArray[np.int32],
    confidences: npt.NDArray[np.float32],
) -> npt.NDArray[np.bool_]:
    # (N,) which to list: of two that are one object the better known, then the surer, then the older.
    listed = np.ones(len(lines), np.bool_)
    if all(line.observed is None for line in lines):
        return listed
    overlaps = iou(boxes, boxes)
    both = np.array([line.origin == "edge+base" for line in lines])
    edge = np.array([line.entity.edge_id is not None and line.observed is not None for line in lines])
    # Two tracks of the edge are two objects to it; tracks that it does not have it cannot tell apart.
    mixed, alike = edge[:, None] != edge[None], classes[:, None] == classes[None]
    order = np.lexsort((np.arange(len(lines)), -confidences, ~both))
    rank = np.empty(len(lines), int)
    rank[order] = np.arange(len(lines))
    clash = np.where(alike, mixed & (overlaps >= SAME_IOU), overlaps >= TWIN_IOU)
    weaker = clash & (rank[None] > rank[:, None])
    for place in order[np.asarray(weaker.any(axis=1))[order]]:
        if listed[place]:
            listed &= ~weaker[place]
    return listed


def _seen_frame(line: _Line, own: Tracks) -> int:
    ours = -1 if line.row is None else int(own.seen_frames[line.row])
    theirs = -1 if line.observed is None else line.observed.frame_index
    return max(ours, min(theirs, own.frame_index))


def _started(line: _Line, own: Tracks) -> bool:
    if line.row is not None:
        return bool(own.started[line.row])
    return (
        line.observed is not None
        and line.observed.steps == 1
        and line.observed.frame_index == own.frame_index
    )
