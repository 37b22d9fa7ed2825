"""Refinement: stills decide the class of a ground track.

A still names a frame and a box of the edge. Which of the ground's own tracks that is, is decided by `match`
at that very frame (`Tracks` of the frame, from the history), never by position on the screen of now: a lost
base packet must not refine the wrong object. A still that cannot be matched yet is held, and given out as
unmatched when it never can be.

``replace`` is the paper's rule: the newest still's prediction is the class. ``fuse`` multiplies the opinions of all
stills of the track (see `TrackPosterior`). Either way a track that is *nothing of mine* is doubted. Frames are the
only clock here.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from hvt_common.inference.class_names import VEHICLE_KINDS, are_apart, is_nothing, kind_of
from hvt_common.values import Tracks
from hvt_ground.events import Origin, Overlay, Refinement
from hvt_ground.perception.history import History
from hvt_ground.perception.stills.match import Matcher, Outcome, StillSeen, TrackMatch
from hvt_ground.perception.stills.posterior import SURE, ClassEstimate, TrackPosterior
from hvt_ground.perception.stills.vocabulary import Vocabulary

Mode = Literal["replace", "fuse"]

MAX_HELD = 256
MAX_TRACK_POSTERIORS = 1024
_REMEMBERED_STILLS = 4096


class Refiner:
    """Holds stills until their track is known, and the classes that came of them. One for each session.

    ``mode`` is ``replace`` or ``fuse``. A still waits ``hold_s`` for its frame to be tracked, and ``confirm_s`` for
    a track that was detected but not confirmed then. A track's class is remembered for ``forget_s`` after its last
    frame, more than a lost track may take to be found again. ``iou`` is the least overlap of a still's box with a
    track's: half is the usual threshold of benchmarks, and boxes of two similar neighbours rarely reach it both.
    ``calibrated``: the scores of the reader of stills are probabilities; else nothing is ever sure.
    """

    def __init__(
        self,
        mode: Mode,
        *,
        fps: float,
        vocabulary: Vocabulary,
        calibrated: bool = False,
        tilt: ViewTilt | None = None,
        hold_s: float = 3.0,
        confirm_s: float = 1.0,
        forget_s: float = 10.0,
        iou: float = 0.5,
    ) -> None:
        self.tracks_refined = 0
        self.class_changes = 0
        self.tilt = tilt or ViewTilt()
        """No kind of vehicle is sure unless the view is known to be steep."""
        self._mode = mode
        self.vocabulary = vocabulary
        self._calibrated = calibrated
        self._hold_frames = round(hold_s * fps)
        self._confirm_frames = round(confirm_s * fps)
        self._forget_frames = round(forget_s * fps)
        self._matcher = Matcher(least_iou=iou, owned_frames=self._forget_frames)
        self._held: dict[tuple[int, int], tuple[StillSeen, int]] = {}
        """By still sequence and part, oldest offer first; each waits no longer once the stream is past the frame."""
        self._seen: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._track_posteriors: OrderedDict[int, TrackPosterior] = OrderedDict()
        """By ground track id, longest unseen first."""

    def offer(self, still: StillSeen, *, now_frame: int) -> list[StillSeen]:
        """Take a still; returns stills that had to make room for it (almost always none).

        ``now_frame`` is the newest frame that was decoded. A part of a still that was here before is ignored.
        """
        if still.key in self._seen:
            return []
        self._seen[still.key] = None
        if len(self._seen) > _REMEMBERED_STILLS:
            self._seen.popitem(last=False)
        self._held[still.key] = still, now_frame + self._hold_frames
        if len(self._held) <= MAX_HELD:
            return []
        oldest = next(iter(self._held))
        return [self._unmatched(self._held.pop(oldest)[0], "overflow")]

    def settle(
        self, history: History, *, now_frame: int, known_as: Callable[[int], int | None] = lambda _id: None
    ) -> list[StillSeen]:
        """Match stills where that is possible and give up those that never will be, oldest frame first.

        Call it after each frame was tracked, with the newest frame that was decoded. ``known_as`` gives the ground's
        track for one of the edge, where the edge has reported it.
        """
        by_frame: dict[int, list[StillSeen]] = {}
        for still, _ in self._held.values():
            by_frame.setdefault(still.event.shown_at[0], []).append(still)
        newest = history.newest_tracked
        resolved: list[StillSeen] = []
        for frame_index in sorted(by_frame):
            held, tracks = by_frame[frame_index], history.tracks(frame_index)
            if tracks is None:
                gone = self._gone(frame_index, history)
                for still in held:
                    if gone or now_frame > self._held[still.key][1]:
                        named = self._by_name(still, history, known_as) if still.event.stored else None
                        resolved.append(named or self._unmatched(still, gone or "late"))
                continue
            found = self._match(held, tracks, history)
            confirmed = newest is not None and newest >= frame_index + self._confirm_frames
            for still in sorted(held, key=lambda still: still.key):
                match = found[still.key]
                if not isinstance(match, str):
                    resolved.append(self._apply(still, *match))
                elif confirmed or now_frame > self._held[still.key][1]:
                    resolved.append(self._unmatched(still, match))
        for done in resolved:
            del self._held[done.key]
        return resolved

    def end(self) -> list[StillSeen]:
        """Give out all that still waits, as unmatched: the stream or its session is over."""
        ended = [self._unmatched(still, "ended") for still, _ in self._held.values()]
        self._held.clear()
        return ended

    def merge(self, survivor_id: int, merged_id: int) -> None:
        """Two tracks have turned out to be one: the posterior of the one that is gone holds for the other.

        Where both were refined, the track that stays keeps its own posterior.
        """
        class_posterior = self._track_posteriors.pop(merged_id, None)
        if class_posterior is not None:
            self._track_posteriors.setdefault(survivor_id, class_posterior)
        self._matcher.merge(survivor_id, merged_id)

    def shown(self, tracks: Tracks, *, capture_ns: int = 0, origins: tuple[Origin, ...] = ()) -> Overlay:
        """The tracks of one frame with the classes to show; frames must not go back."""
        for row, track_id in enumerate(tracks.ids.tolist()):
            class_posterior = self._track_posteriors.get(track_id)
            if class_posterior is not None and self._is_of_another(class_posterior, tracks, row):
                del self._track_posteriors[track_id]
            elif class_posterior is not None:
                self._touch(track_id, class_posterior, tracks.frame_index)
        self._forget(tracks.frame_index)
        return self.preview(tracks, capture_ns=capture_ns, origins=origins)

    def preview(self, tracks: Tracks, *, capture_ns: int = 0, origins: tuple[Origin, ...] = ()) -> Overlay:
        """The overlay that these tracks would have; changes nothing, so any frame may be requested."""
        names = self.vocabulary.names
        base_classes = tuple(names[class_id] for class_id in tracks.class_ids)
        classes = list(base_classes)
        confidences = tracks.confidences.astype(np.float32)  # a copy
        refined, sure = (np.zeros(len(tracks), np.bool_) for _ in range(2))
        doubted = np.array([is_nothing(name) for name in classes], np.bool_)
        vague = np.array([self.tilt.is_vague(name) for name in classes], np.bool_)
        for row, track_id in enumerate(tracks.ids.tolist()):
            class_posterior = self._track_posteriors.get(track_id)
            if class_posterior is None:
                continue
            reading = self._read(class_posterior, tracks, row)
            classes[row], confidences[row], refined[row] = names[reading.class_id], reading.confidence, True
            doubted[row] = self._is_doubted(reading, base_classes[row])
            sure[row] = self._is_sure(reading)
            vague[row] = self.tilt.is_vague(classes[row], known=reading.sure)
        return Overlay(
            frame_index=tracks.frame_index,
            capture_ns=capture_ns,
            track_ids=tracks.ids,
            boxes_base_px=tracks.boxes_xyxy_px,
            base_classes=base_classes,
            classes=tuple(classes),
            confidences=confidences,
            refined=refined,
            origins=origins,
            doubted=doubted,
            sure=sure,
            vague=vague,
        )

    # One frame's stills.

    @staticmethod
    def _gone(frame_index: int, history: History) -> Outcome | None:
        # Tracks come in the order of frames: once a later frame is there, an absent one never will be.
        oldest, newest = history.oldest_tracked, history.newest_tracked
        if oldest is None or newest is None or frame_index > newest:
            return None
        return "late" if frame_index < oldest else "frame lost"

    def _by_name(
        self, still: StillSeen, history: History, known_as: Callable[[int], int | None]
    ) -> StillSeen | None:
        # Apply a still of long ago to the track that its edge track is known as now; None where it is not known.
        edge_id = still.event.edge_track_id
        if edge_id < 0 or history.newest_tracked is None:
            return None
        track_id, tracks = known_as(edge_id), history.tracks(history.newest_tracked)
        if track_id is None:
            track_id = self._matcher.known_as(edge_id)
        if track_id is None or tracks is None or track_id not in tracks.ids:
            return None
        return self._apply(still, tracks, int(np.flatnonzero(tracks.ids == track_id)[0]))

    def _match(
        self, held: Sequence[StillSeen], tracks: Tracks, history: History
    ) -> dict[tuple[int, int], TrackMatch]:
        last = min(tracks.frame_index + self._confirm_frames, history.newest_tracked or 0)
        later = (history.tracks(frame_index) for frame_index in range(tracks.frame_index + 1, last + 1))
        return self._matcher.match(
            held, tracks, later=(t for t in later if t is not None), class_names=self.vocabulary.names
        )

    def _apply(self, still: StillSeen, tracks: Tracks, row: int) -> StillSeen:
        track_id = int(tracks.ids[row])
        class_posterior = self._track_posteriors.get(track_id)
        if class_posterior is None:
            before = ClassEstimate(int(tracks.class_ids[row]), 0.0)
            class_posterior = self._track_posteriors[track_id] = TrackPosterior(tracks.frame_index)
            self.tracks_refined += 1
            if len(self._track_posteriors) > MAX_TRACK_POSTERIORS:
                self._track_posteriors.popitem(last=False)
        else:
            before = self._read(class_posterior, tracks, row)
        newest = class_posterior.update(
            still.posterior,
            order=(still.event.shown_at[0], still.event.still_sequence),
            side_px=still.side_px,
            news=still.news,
        )
        if newest:
            class_posterior.base_class_id = int(tracks.class_ids[row])
        self._touch(track_id, class_posterior, still.event.shown_at[0])
        after = self._read(class_posterior, tracks, row)
        self.class_changes += after.class_id != before.class_id
        names = self.vocabulary.names
        event = replace(
            still.event,
            track_id=track_id,
            class_before=names[before.class_id],
            class_after=names[after.class_id],
            confidence=after.confidence,
            doubted=self._is_doubted(after, names[tracks.class_ids[row]]),
            sure=self._is_sure(after),
        )
        event = replace(event, vague=self.tilt.vague_of(event, sure=(before.sure, after.sure)))
        outcome: Outcome = "matched" if newest or self._mode == "fuse" else "superseded"
        return replace(still, event=event, outcome=outcome)

    def _unmatched(self, still: StillSeen, outcome: Outcome) -> StillSeen:
        event = still.event
        event = replace(event, doubted=self.tilt.doubts(event), vague=self.tilt.vague_of(event))
        return replace(still, event=event, outcome=outcome)

    # The posterior of each track.

    def _read(self, class_posterior: TrackPosterior, tracks: Tracks, row: int) -> ClassEstimate:
        if self._mode == "replace":
            return class_posterior.newest(self.vocabulary, class_id=int(tracks.class_ids[row]))
        return class_posterior.fused(
            self.vocabulary, class_id=int(tracks.class_ids[row]), confidence=float(tracks.confidences[row])
        )

    def _is_of_another(self, class_posterior: TrackPosterior, tracks: Tracks, row: int) -> bool:
        # The tracker asks for no class: a person who takes the place of a car has its track, and would have its name.
        names, now = self.vocabulary.names, self.vocabulary.names[tracks.class_ids[row]]
        if not are_apart(now, names[class_posterior.base_class_id]):
            return False
        return are_apart(now, names[self._read(class_posterior, tracks, row).class_id])

    def _is_doubted(self, reading: ClassEstimate, base_class: str) -> bool:
        contradicts = are_apart(base_class, self.vocabulary.names[reading.class_id])
        return reading.class_id == self.vocabulary.nothing or (contradicts and not self._is_believed(reading))

    def _is_sure(self, reading: ClassEstimate) -> bool:
        nothing = reading.class_id == self.vocabulary.nothing
        return self._calibrated and not nothing and self._is_believed(reading)

    def _is_believed(self, reading: ClassEstimate) -> bool:
        # Stills are right about vehicles only from straight above: aslant a hydrant was a truck, at .91.
        steep = self.tilt.aslant is False
        return reading.sure and (
            steep or kind_of(self.vocabulary.names[reading.class_id]) not in VEHICLE_KINDS
        )

    def _touch(self, track_id: int, class_posterior: TrackPosterior, frame_index: int) -> None:
        class_posterior.last_frame = max(class_posterior.last_frame, frame_index)
        self._track_posteriors.move_to_end(track_id)

    def _forget(self, now_frame: int) -> None:
        # Drop the posteriors of tracks that ended; the longest unseen stand first.
        while self._track_posteriors:
            track_id, class_posterior = next(iter(self._track_posteriors.items()))
            if now_frame - class_posterior.last_frame <= self._forget_frames:
                return
            del self._track_posteriors[track_id]


_ASLANT_FROM, _STEEP_BELOW = 0.75, 0.65
_MOST_BOXES, _LEAST_BOXES = 150, 12
_APART = 0.1
"""Share of the picture's height that the quartiles must lie apart: nearer boxes differ by their kinds."""


class ViewTilt:
    """Whether the camera looks aslant, told by the vehicles of one video; for one thread.

    Seen from straight above they have one size wherever they are; seen aslant those higher up in the picture are
    farther away, and smaller. The median slope over pairs (Theil 1950, Sen 1968) of the logarithm of their size over
    the height in the picture is -.22 to .14 in nine views from above, 1.5 to 5.0 in four aslant; one more between
    trees had .06 to .49, and two told nothing, their vehicles far away in a narrow band. No network here
    tells kinds of vehicle well aslant; ``vague_kinds``: the detector's word alone settles none
    (`hvt_ground.perception.guesses`).
    """

    def __init__(self, *, vague_kinds: bool = False) -> None:
        self._vague_kinds = vague_kinds
        self._seen: npt.NDArray[np.float64] = np.empty((0, 2))
        """(N, 2) height in the picture, 0 to 1, and logarithm of the size, oldest first."""
        self.aslant: bool | None = None
        """None while too few vehicles were seen to tell."""

    def take(self, tracks: Tracks, class_names: Sequence[str], *, height_px: int) -> None:
        """Take the tracks at the next picture, of which the vehicles that the detector has just seen count."""
        seen = np.array([kind_of(class_names[one]) in VEHICLE_KINDS for one in tracks.class_ids], np.bool_)
        seen &= tracks.seen_frames == tracks.frame_index
        boxes = tracks.boxes_xyxy_px[seen].astype(np.float64)
        sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
        new = np.column_stack(((boxes[:, 1] + boxes[:, 3]) / 2 / height_px, np.log(sides.prod(axis=1)) / 2))
        self._seen = np.concatenate((self._seen, new))[-_MOST_BOXES:]
        if len(self._seen) < _LEAST_BOXES:
            return
        low, high = np.percentile(self._seen[:, 0], (25, 75))
        if high - low <= _APART:
            return
        one, other = np.triu_indices(len(self._seen), 1)
        apart, larger = (self._seen[one] - self._seen[other]).T
        far = np.abs(apart) > _APART
        slope = float(np.median(larger[far] / apart[far]))
        self.aslant = slope >= (_STEEP_BELOW if self.aslant else _ASLANT_FROM)

    def is_vague(self, name: str, *, known: bool = False) -> bool:
        """Whether this is a vehicle, and its class rather a guess; ``known`` where stills agree on it."""
        return self._vague_kinds and not known and kind_of(name) in VEHICLE_KINDS

    def doubts(self, still: Refinement) -> bool:
        """Whether a still by itself says that the object is nothing, or no such thing as it was before."""
        known = self.aslant is False and still.confidence > SURE
        apart = are_apart(still.class_before, still.class_after) and not known
        return is_nothing(still.class_after) or apart

    def vague_of(self, still: Refinement, *, sure: tuple[bool, bool] | None = None) -> tuple[bool, bool]:
        """`Refinement.vague`; by default of a still of no track, which speaks for itself."""
        was_known, known = (False, still.confidence > SURE) if sure is None else sure
        before, after = still.class_before, still.class_after
        return (
            self.is_vague(before, known=was_known or before == "car"),
            self.is_vague(after, known=known or after == "car"),
        )
