"""Which stills lie on the enhanced picture, and where: each rides on its track from the moment it is known.

A still is of a frame that has passed when it arrives. It is put where its object is now: its place at its own frame,
moved as the track has moved since. It stays while its object stands still, and a moving one's for `FRESH_NS`: by then
the still and the picture around it no longer agree. Nothing here knows Rerun.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hvt_ground.events import Overlay, Refinement
from hvt_ground.sinks.rerun.stills.gallery import Placement

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
