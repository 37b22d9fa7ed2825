"""Who is in a scene, what they look like and where they are at a moment."""

from __future__ import annotations

import numpy as np

from hvt_scene.drawing.canvas import OUTLINE_POINTS
from hvt_scene.drawing.codes import RoofCode, draw_code, paint_code
from hvt_scene.drawing.vehicles import CLASS_NAMES, draw_vehicle
from hvt_scene.view.project import Floats
from hvt_scene.world.layout import Parked
from hvt_scene.world.traffic import SAMPLES_HZ, Mover


class Cast:
    """Everybody, as parallel arrays: those who move first, then what stands still. Index i has the id i + 1.

    Attributes:
        sprites: their pictures.
        class_ids: (N,) int32.
        outlines_m: (N, `OUTLINE_POINTS`, 2) convex outlines about their centres, metres, body axes.
        heights_m: (N,).
        reach_m: (N,) from the centre to the farthest point of the outline.
        codes: what is painted on roofs, by index; empty until `paint_codes`.
    """

    def __init__(self, movers: list[Mover], parked: list[Parked], *, rng: np.random.Generator) -> None:
        everybody: list[Mover | Parked] = [*movers, *parked]
        kinds = [(one.class_name, one.small) for one in everybody]
        self.sprites = [draw_vehicle(name, rng, small=small) for name, small in kinds]
        self.class_ids = np.array([CLASS_NAMES.index(name) for name, _ in kinds], np.int32)
        self.outlines_m = np.stack([sprite.outline_m for sprite in self.sprites])
        self.heights_m = np.array([sprite.height_m for sprite in self.sprites])
        self.reach_m = np.linalg.norm(self.outlines_m, axis=2).max(1)
        self.codes: dict[int, RoofCode] = {}
        self._tracks = np.stack([mover.track for mover in movers])
        turn = np.array([one.turn for one in parked]) * (np.pi / 2)
        spots = np.array([(one.x, one.y) for one in parked])
        self._standing = np.stack([spots[:, 0], spots[:, 1], np.cos(turn), np.sin(turn)], axis=1)
        assert self.outlines_m.shape[1:] == (OUTLINE_POINTS, 2)

    def paint_codes(self, rng: np.random.Generator, *, m_per_px: float) -> None:
        """Paint a code on each roof that bears one; nothing else of the scene changes. ``m_per_px`` of the source."""
        for index, sprite in enumerate(self.sprites):
            code = draw_code(CLASS_NAMES[self.class_ids[index]], sprite, rng, m_per_px=m_per_px)
            if code is not None:
                self.codes[index] = code
                self.sprites[index] = paint_code(sprite, code)

    def places(self, t_s: float) -> Floats:
        """(N, 4) x, y, cos and sin of the heading, world metres."""
        low = min(int(t_s * SAMPLES_HZ), self._tracks.shape[1] - 2)
        share = t_s * SAMPLES_HZ - low
        moving = self._tracks[:, low] * (1 - share) + self._tracks[:, low + 1] * share
        moving[:, 2:] /= np.hypot(moving[:, 2], moving[:, 3])[:, None]
        return np.concatenate([moving, self._standing])
