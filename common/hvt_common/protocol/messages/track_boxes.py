"""Codes the boxes of a track step: prediction with constant velocity, the residual range-coded.

Both sides hold the same list of `CodedTrack` in whole numbers and bring it forward in the same way, so that nothing
drifts apart. Positions and sizes count 1/16 of a base pixel; each track has a step of its own for either axis, a
power of two near a twentieth of its side (`_FINENESS`): an object of 10 pixels moves in halves of a pixel, one of 80
in fours. Velocities count 1/4096 of a pixel a frame.

The syntax is written once (`_Walk`), for writer and reader alike: see `range_coder`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median_low
from typing import Final

from hvt_common.protocol.messages.fields import U32, WireError
from hvt_common.protocol.messages.range_coder import Coder, Context, Decoder, Encoder, NumberContexts

MOST_BOXES: Final = 1024
"""Limit of one step."""
MOST_CLASSES: Final = 2048
PER_PX: Final = 16
"""Positions and sizes are in sixteenths of a base pixel."""
CONFIDENCE_STEPS: Final = 15

_FAR: Final = 32_767 * PER_PX
_FAST: Final = 1 << 24
_VELOCITY_BITS: Final = 8
"""A velocity counts 2^-8 of a position's count a frame."""
_FINENESS: Final = 18
"""A side has 18 to 36 steps when its track is first listed."""
_COARSEST: Final = 11
_PATIENCE: Final = 6
"""Steps for which a track that is not listed is remembered: it comes back cheaper than a new one."""
_SHARED_STEP: Final = 4
_UNSURE: Final = 2
"""A confidence is sent again when it is off by 2 of its steps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CodedTrack:
    """One track as both sides know it: centre, size and velocity of its box, in the counts above."""

    track_id: int
    class_id: int
    confidence: int
    """0…15 for 0…1."""
    x: int
    y: int
    width: int
    height: int
    velocity_x: int = 0
    velocity_y: int = 0
    scale_x: int = 0
    """The step of x and width is 2 to the power of this."""
    scale_y: int = 0
    missed: int = 0
    """Steps since it was last listed; 0 for listed now."""

    def moved(self, frames: int) -> tuple[int, int]:
        """The box ``frames`` later, at constant velocity."""
        half = 1 << _VELOCITY_BITS - 1
        return (
            self.x + (self.velocity_x * frames + half >> _VELOCITY_BITS),
            self.y + (self.velocity_y * frames + half >> _VELOCITY_BITS),
        )


def write_tracks(
    listed: Iterable[CodedTrack], *, reference: Sequence[CodedTrack] | None, frames: int
) -> tuple[bytes, list[CodedTrack]]:
    """Code the tracks of a step; return the bytes and the list as the reader will have it.

    ``reference`` is the list that the step ``frames`` before left; None for a step that stands by itself, whose
    velocities are coded too.
    """
    encoder = Encoder()
    wanted = {track.track_id: track for track in listed}
    state = _Walk(encoder, frames).all(reference, wanted)
    return encoder.finish(), state


def read_tracks(data: bytes, *, reference: Sequence[CodedTrack] | None, frames: int) -> list[CodedTrack]:
    """The list that `write_tracks` left; `WireError` for any bytes that it did not write."""
    decoder = Decoder(data)
    state = _Walk(decoder, frames).all(reference, None)
    decoder.finish()
    return state


class _Walk:
    # The order in which a step's numbers come. ``wanted`` is None where they are read.

    def __init__(self, coder: Coder, frames: int) -> None:
        self._coder = coder
        self._frames = frames
        self._present = Context(), Context()
        self._shared = NumberContexts(), NumberContexts()
        self._move = NumberContexts(), NumberContexts()
        self._grow = NumberContexts(), NumberContexts()
        self._changed = Context()
        self._count, self._id = NumberContexts(), NumberContexts()
        self._same_class, self._class = Context(), NumberContexts()
        self._confidence = NumberContexts()
        self._scale = NumberContexts(), NumberContexts()
        self._side = NumberContexts(), NumberContexts()
        self._place = NumberContexts(), NumberContexts()
        self._drift = NumberContexts(), NumberContexts()

    def all(
        self, reference: Sequence[CodedTrack] | None, wanted: dict[int, CodedTrack] | None
    ) -> list[CodedTrack]:
        """Old tracks in order of id, then new ones in order of id; the answer is in order of id."""
        state = self._old(reference or (), wanted)
        common = _common_velocity(track for track in state if not track.missed)
        known = {track.track_id for track in state}
        new = None if wanted is None else [wanted[one] for one in sorted(wanted) if one not in known]
        if reference is None:
            common = self._first_velocity(new)
        listed = len(state) - sum(track.missed > 0 for track in state)
        count = self._coder.unsigned(self._count, 0 if new is None else len(new))
        if listed + count > MOST_BOXES:
            raise WireError(f"{listed + count} boxes where at most {MOST_BOXES} are allowed")
        before = CodedTrack(
            track_id=0, class_id=0, confidence=8, x=0, y=0, width=640, height=640, scale_x=5, scale_y=5
        )
        for index in range(count):
            before = self._born(before, common, None if new is None else new[index], moving=reference is None)
            if before.track_id in known:
                raise WireError(f"track {before.track_id} is new and known at once")
            state.append(before)
        return sorted(state, key=lambda track: track.track_id)

    # Tracks of the reference

    def _old(self, reference: Sequence[CodedTrack], wanted: dict[int, CodedTrack] | None) -> list[CodedTrack]:
        state: list[CodedTrack] = []
        goals = [None if wanted is None else wanted.get(track.track_id) for track in reference]
        here = [
            self._coder.bit(self._present[track.missed > 0], int(goal is not None))
            for track, goal in zip(reference, goals, strict=True)
        ]
        shared = self._shared_motion(reference, goals) if any(here) else (0, 0)
        for track, goal, present in zip(reference, goals, here, strict=True):
            if present:
                state.append(self._continued(track, goal, shared))
            elif track.missed < _PATIENCE:
                x, y = track.moved(self._frames)
                state.append(
                    replace(track, x=_near(x + shared[0]), y=_near(y + shared[1]), missed=track.missed + 1)
                )
        return state

    def _shared_motion(
        self, reference: Sequence[CodedTrack], goals: Sequence[CodedTrack | None]
    ) -> tuple[int, int]:
        # The camera's motion beyond the prediction: the median over all tracks.
        off = [(0, 0)]
        pairs = [(track, goal) for track, goal in zip(reference, goals, strict=True) if goal is not None]
        if pairs:
            moved = [track.moved(self._frames) for track, _ in pairs]
            off = [(goal.x - x, goal.y - y) for (_, goal), (x, y) in zip(pairs, moved, strict=True)]
        middle = (median_low(x for x, _ in off), median_low(y for _, y in off))
        x, y = (
            self._coder.signed(numbers, _nearest(value, _SHARED_STEP)) * _SHARED_STEP
            for numbers, value in zip(self._shared, middle, strict=True)
        )
        return x, y

    def _continued(self, track: CodedTrack, goal: CodedTrack | None, shared: tuple[int, int]) -> CodedTrack:
        x, y = track.moved(self._frames)
        x, y = x + shared[0], y + shared[1]
        step_x, step_y = 1 << track.scale_x, 1 << track.scale_y
        to = goal or track
        off_x = self._coder.signed(self._move[0], _nearest(to.x - x, step_x)) * step_x
        off_y = self._coder.signed(self._move[1], _nearest(to.y - y, step_y)) * step_y
        wider = self._coder.signed(self._grow[0], _nearest(to.width - track.width, step_x)) * step_x
        taller = self._coder.signed(self._grow[1], _nearest(to.height - track.height, step_y)) * step_y
        class_id, confidence = self._words(track, to)
        return replace(
            track,
            class_id=class_id,
            confidence=confidence,
            x=_near(x + off_x),
            y=_near(y + off_y),
            width=_sized(track.width + wider),
            height=_sized(track.height + taller),
            velocity_x=self._faster(track.velocity_x, off_x + shared[0]),
            velocity_y=self._faster(track.velocity_y, off_y + shared[1]),
            missed=0,
        )

    def _words(self, track: CodedTrack, goal: CodedTrack) -> tuple[int, int]:
        off = goal.confidence - track.confidence
        changed = goal.class_id != track.class_id or abs(off) >= _UNSURE
        if not self._coder.bit(self._changed, int(changed)):
            return track.class_id, track.confidence
        class_id = self._called(track.class_id, goal.class_id)
        return class_id, _confidence(track.confidence + self._coder.signed(self._confidence, off))

    def _called(self, before: int, goal: int) -> int:
        if not self._coder.bit(self._same_class, int(goal != before)):
            return before
        class_id = self._coder.unsigned(self._class, goal)
        if class_id >= MOST_CLASSES:
            raise WireError(f"class {class_id} where {MOST_CLASSES} are allowed")
        return class_id

    def _faster(self, velocity: int, off: int) -> int:
        # Take half of the prediction's error for a change of velocity.
        changed = velocity + (off << _VELOCITY_BITS - 1) // self._frames
        return min(max(changed, -_FAST), _FAST)

    # Tracks that the reference does not have

    def _first_velocity(self, new: Sequence[CodedTrack] | None) -> tuple[int, int]:
        # The median velocity, which a step without a reference sends in 1/64 of a pixel a frame.
        x, y = _common_velocity(new or ())
        step = 1 << _VELOCITY_BITS - 2
        return (
            _bounded(self._coder.signed(self._shared[0], _nearest(x, step)) * step),
            _bounded(self._coder.signed(self._shared[1], _nearest(y, step)) * step),
        )

    def _born(
        self, before: CodedTrack, common: tuple[int, int], goal: CodedTrack | None, *, moving: bool
    ) -> CodedTrack:
        # A new track; its numbers are coded as differences from the track ``before`` it.
        coder, to = self._coder, goal or before
        track_id = (
            before.track_id + 1 + coder.unsigned(self._id, to.track_id - before.track_id - 1 if goal else 0)
        )
        if track_id > U32:
            raise WireError(f"track id {track_id} is too large")
        class_id = self._called(before.class_id, to.class_id)
        confidence = _confidence(
            before.confidence + coder.signed(self._confidence, to.confidence - before.confidence)
        )
        scale_x, width = self._side_of(0, before.scale_x, before.width, to.width)
        scale_y, height = self._side_of(1, before.scale_y, before.height, to.height)
        x = _near(coder.signed(self._place[0], _nearest(to.x, 1 << scale_x)) << scale_x)
        y = _near(coder.signed(self._place[1], _nearest(to.y, 1 << scale_y)) << scale_y)
        velocity_x, velocity_y = common
        if moving:
            velocity_x += self._own_velocity(0, scale_x, to.velocity_x - velocity_x)
            velocity_y += self._own_velocity(1, scale_y, to.velocity_y - velocity_y)
        return CodedTrack(
            track_id=track_id,
            class_id=class_id,
            confidence=confidence,
            x=x,
            y=y,
            width=width,
            height=height,
            velocity_x=_bounded(velocity_x),
            velocity_y=_bounded(velocity_y),
            scale_x=scale_x,
            scale_y=scale_y,
        )

    def _side_of(self, axis: int, scale: int, side: int, goal: int) -> tuple[int, int]:
        wanted = min(max((goal // _FINENESS).bit_length() - 1, 0), _COARSEST)
        scale += self._coder.signed(self._scale[axis], wanted - scale)
        if not 0 <= scale <= _COARSEST:
            raise WireError(f"a step of 2 to the power of {scale}")
        # Counted in the new step, so that a side of another scale costs no more.
        base = side >> scale
        return scale, _sized(
            base + self._coder.signed(self._side[axis], _nearest(goal, 1 << scale) - base) << scale
        )

    def _own_velocity(self, axis: int, scale: int, off: int) -> int:
        step = 1 << scale + _VELOCITY_BITS - 1
        return self._coder.signed(self._drift[axis], _nearest(off, step)) * step


def _common_velocity(tracks: Iterable[CodedTrack]) -> tuple[int, int]:
    # The median velocity of some tracks: that of the ground as the camera passes over it.
    velocities = [(track.velocity_x, track.velocity_y) for track in tracks]
    if not velocities:
        return 0, 0
    return median_low(x for x, _ in velocities), median_low(y for _, y in velocities)


def _nearest(value: int, step: int) -> int:
    return (value + step // 2) // step


def _near(place: int) -> int:
    return min(max(place, -_FAR), _FAR)


def _sized(side: int) -> int:
    return min(max(side, 1), _FAR)


def _bounded(velocity: int) -> int:
    return min(max(velocity, -_FAST), _FAST)


def _confidence(steps: int) -> int:
    return min(max(steps, 0), CONFIDENCE_STEPS)
