"""Where stills lie in a recording: slots of the gallery, patches on the enhanced picture. Nothing here knows Rerun.

The gallery is a grid of pairs, base crop left, still right, each held for a while; its coordinates are those of its
own canvas, `CANVAS` units wide and high. A recording is read by time: the stills of a slot may come in any order.

A patch rides on its track from the moment it is known. A still is of a frame that has passed when it arrives. It is
put where its object is now: its place at its own frame, moved as the track has moved since. It stays while its object
stands still, and a moving one's for `FRESH_NS`: by then the still and the picture around it no longer agree.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_ground.events import Overlay, Refinement

COLUMNS, ROWS = 2, 4
SLOTS = COLUMNS * ROWS
HOLD_S = 1.5
_CELL = (150.0, 92.0)
"""Width and height of one picture."""
_GAP = 6.0
_MARGIN = 12.0
_CAPTION = 30.0
_PAIR = (2 * _CELL[0] + _GAP, _CELL[1] + _CAPTION)

CANVAS = (COLUMNS * (_PAIR[0] + 2 * _MARGIN), ROWS * (_PAIR[1] + _MARGIN) + _MARGIN)
"""(width, height) of everything."""

_MOST_TIMES = 512
"""Remembered times of a slot: twenty minutes at three stills a second."""
_NEVER_NS = 2**63

Rect = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """The place of a picture on the canvas: ``canvas = picture * scale + (x, y)``."""

    x: float
    y: float
    scale: float


def frame_of(slot: int) -> Rect:
    """x1 y1 x2 y2 of the two pictures of a slot together."""
    column, row = slot % COLUMNS, slot // COLUMNS
    x = _MARGIN + column * (_PAIR[0] + 2 * _MARGIN)
    y = _MARGIN + row * (_PAIR[1] + _MARGIN)
    return x, y, x + _PAIR[0], y + _CELL[1]


def placed(slot: int, size: tuple[int, int], *, right: bool) -> Placement:
    """A picture of ``size`` pixels as large as its half of the slot allows, centred there."""
    x1, y1, _, _ = frame_of(slot)
    left = x1 + (_CELL[0] + _GAP if right else 0.0)
    scale = min(_CELL[0] / size[0], _CELL[1] / size[1])
    return Placement(
        x=left + (_CELL[0] - size[0] * scale) / 2, y=y1 + (_CELL[1] - size[1] * scale) / 2, scale=scale
    )


class Gallery:
    """Hands out slots so that a pair can be looked at: each is held for a while. Not safe for threads.

    ``hold_ns`` is in capture time.
    """

    def __init__(self, slots: int = SLOTS, *, hold_ns: int = round(HOLD_S * 1e9)) -> None:
        self._hold_ns = hold_ns
        self._changed = [False] * slots
        """Whether the still that a slot shows now changed a class."""
        self._times: list[list[tuple[int, int]]] = [[] for _ in range(slots)]
        """(frame index, capture time) of the pairs put into each slot, in their order."""

    def put(self, frame_index: int, capture_ns: int, *, changed: bool) -> int | None:
        """A slot for a still of now; None where all are held.

        ``changed`` says that the still changed the class: then it may replace, before its time, one that did not.
        """
        since_ns = [times[-1][1] if times else -_NEVER_NS for times in self._times]
        slot = min(range(len(since_ns)), key=since_ns.__getitem__)
        if capture_ns - since_ns[slot] < self._hold_ns:
            confirmed = [one for one, was in enumerate(self._changed) if not was]
            if not changed or not confirmed:
                return None
            slot = min(confirmed, key=since_ns.__getitem__)
        self._changed[slot] = changed
        return self._place(slot, frame_index, capture_ns)

    def put_stored(self, frame_index: int, capture_ns: int) -> int | None:
        """A slot that nothing was put into around that time, the one that was so for the longest.

        One that another still came into later is better: an old one should not stand there now. None where all were
        held, or it is too long ago to tell.
        """
        found: tuple[bool, int, int] | None = None
        for slot, times in enumerate(self._times):
            at = bisect_right(times, (frame_index, _NEVER_NS))
            if not at and len(times) >= _MOST_TIMES:
                continue
            since = capture_ns - times[at - 1][1] if at else _NEVER_NS
            until = times[at][1] - capture_ns if at < len(times) else _NEVER_NS
            this = at < len(times), since, -slot
            if min(since, until) >= self._hold_ns and (found is None or this > found):
                found = this
        return None if found is None else self._place(-found[2], frame_index, capture_ns)

    def _place(self, slot: int, frame_index: int, capture_ns: int) -> int:
        times = self._times[slot]
        insort(times, (frame_index, capture_ns))
        del times[: max(0, len(times) - _MOST_TIMES)]
        return slot


PATCHES = 20
"""How many lie on the picture at most. Each is an entity of its own: 2.5 kB of a recording and compaction."""

FRESH_NS = 2_000_000_000
"""For how long the still of a moving object is shown."""

_STEP_PX = 1.0
_STANDS_SHARE = 0.1
"""An object that moved by less of its box's side stands still; base coding and tracking make boxes tremble."""


@dataclass(frozen=True, slots=True)
class Moved:
    """A new place of the patch in a slot; None takes it off."""

    slot: int
    place: Placement | None


@dataclass(slots=True)
class _Patch:
    track_id: int
    since_ns: int
    centre_px: npt.NDArray[np.float64]
    """Centre of the object's box at the still's frame."""
    side_px: float
    """The shorter side of that box."""
    origin: Placement
    """Origin of the picture when the object is at ``centre_px``."""
    shift_px: npt.NDArray[np.float64]
    """The drawn shift."""

    def place(self) -> Placement:
        x, y = self.shift_px.tolist()
        return Placement(self.origin.x + x, self.origin.y + y, self.origin.scale)


class Patches:
    """Hands out slots, one a track, and moves their contents. Frames must not go back."""

    def __init__(self) -> None:
        self._patches: dict[int, _Patch] = {}  # by slot
        self._centres: dict[int, npt.NDArray[np.float64]] = {}  # of the newest overlay, by track

    def put(self, refinement: Refinement, *, size: tuple[int, int]) -> Moved | None:
        """The slot and place for a still of ``size`` pixels; None where its object is not on the screen."""
        crop, box, track_id = refinement.crop_base_px, refinement.box_base_px, refinement.track_id
        if crop is None or track_id is None or track_id not in self._centres:
            return None
        scale = (crop[2] - crop[0]) / size[0]
        patch = _Patch(
            track_id=track_id,
            since_ns=refinement.capture_ns,
            centre_px=np.array([box[0] + box[2], box[1] + box[3]]) / 2,
            side_px=min(box[2] - box[0], box[3] - box[1]),
            origin=Placement(crop[0], crop[1], scale),
            shift_px=np.zeros(2),
        )
        patch.shift_px = self._shift(patch)
        slot = self._slot(track_id)
        self._patches[slot] = patch
        return Moved(slot, patch.place())

    def move(self, overlay: Overlay) -> list[Moved]:
        """The changes by this overlay: patches that move with their tracks, and those that go."""
        boxes = overlay.boxes_base_px.astype(np.float64)
        centres = (boxes[:, :2] + boxes[:, 2:]) / 2
        self._centres = dict(zip(overlay.track_ids.tolist(), centres, strict=True))
        moved = []
        for slot, patch in list(self._patches.items()):
            if not self._stays(patch, overlay.capture_ns):
                del self._patches[slot]
                moved.append(Moved(slot, None))
                continue
            shift = self._shift(patch)
            if np.abs(shift - patch.shift_px).max() > _STEP_PX:
                patch.shift_px = shift
                moved.append(Moved(slot, patch.place()))
        return moved

    def _stays(self, patch: _Patch, now_ns: int) -> bool:
        if patch.track_id not in self._centres:
            return False
        return now_ns - patch.since_ns < FRESH_NS or not self._shift(patch).any()

    def _shift(self, patch: _Patch) -> npt.NDArray[np.float64]:
        # How far the object is from where the still was cut, whole pixels; nothing while it only trembles.
        shift = self._centres[patch.track_id] - patch.centre_px
        if np.abs(shift).max() <= max(_STEP_PX, _STANDS_SHARE * patch.side_px):
            return np.zeros(2)
        return np.asarray(np.rint(shift), np.float64)

    def _slot(self, track_id: int) -> int:
        # The track's own, else a free one, else that of the oldest.
        for slot, patch in self._patches.items():
            if patch.track_id == track_id:
                return slot
        if len(self._patches) < PATCHES:
            return next(slot for slot in range(PATCHES) if slot not in self._patches)
        return min(self._patches, key=lambda slot: self._patches[slot].since_ns)
