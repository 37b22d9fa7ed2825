"""Tree canopies seen from above: clumps of leaves, lit from the side the sun stands on."""

import cv2
import numpy as np
import numpy.typing as npt

from hvt_scene.appearance import Appearance
from hvt_scene.view import Floats
from hvt_scene.world.layout import MAIN_HALF_M, SIDE_HALF_M, WORLD_M, Layout, Tree

CANOPY_SPAN = 2.1
"""Width of a canopy picture in radii of its tree."""

_CANOPY_PX = 192
_VARIANTS = 8
_COVER_M_PER_PX = 0.25


class Grove:
    """The canopies, and the trees that things may pass or stand under; the other trees belong to the ground.

    Attributes:
        canopies: pictures by variant, (h, h, 4) uint8, premultiplied BGRA.
        places_m: (T, 2) centres of the overhanging trees.
        radii_m: (T,).
    """

    def __init__(self, layout: Layout, appearance: Appearance, *, rng: np.random.Generator) -> None:
        self.canopies = [_canopy(rng, appearance) for _ in range(_VARIANTS)]
        self._levels = [_pyramid(canopy) for canopy in self.canopies]
        trees = [tree for tree in layout.trees if _overhangs(tree, layout)]
        self.places_m = np.array([(tree.x, tree.y) for tree in trees]).reshape(-1, 2)
        self.radii_m = np.array([tree.r for tree in trees])
        self._variants = [tree.variant for tree in trees]
        self._cover = _cover(trees, self.canopies)

    def level(self, index: int, *, m_per_px: float) -> tuple[npt.NDArray[np.uint8], float]:
        """The picture of an overhanging tree for a camera of that resolution, and its metres per pixel."""
        fine = CANOPY_SPAN * float(self.radii_m[index]) / _CANOPY_PX
        levels = self._levels[self._variants[index]]
        step = int(np.clip(np.floor(np.log2(m_per_px / fine)), 0, len(levels) - 1))
        return levels[step], fine * (1 << step)

    def cover_at(self, points_m: Floats) -> Floats:
        """How much overhanging crowns hide at (..., 2) points of the world, 0…1."""
        limit = np.array(self._cover.shape[::-1]) - 1
        cells = np.clip((points_m / _COVER_M_PER_PX).astype(np.int64), 0, limit)
        return self._cover[cells[..., 1], cells[..., 0]] / 255.0


def _overhangs(tree: Tree, layout: Layout) -> bool:
    """Whether anything may pass or stand under the tree."""
    main = abs(tree.y - layout.main_y) < MAIN_HALF_M + tree.r + 3
    side = abs(tree.x - layout.side_x) < SIDE_HALF_M + tree.r + 3
    parked = any((tree.x - p.x) ** 2 + (tree.y - p.y) ** 2 < (tree.r + 3) ** 2 for p in layout.parked)
    return main or side or parked or any(_near_walk(tree, walk) for walk in layout.walks)


def _near_walk(tree: Tree, walk: tuple[float, float, float, float]) -> bool:
    x = min(max(tree.x, min(walk[0], walk[2])), max(walk[0], walk[2]))
    y = min(max(tree.y, min(walk[1], walk[3])), max(walk[1], walk[3]))
    return (tree.x - x) ** 2 + (tree.y - y) ** 2 < (tree.r + 2.0) ** 2


def _cover(trees: list[Tree], canopies: list[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """Alpha of the overhanging crowns from above, (h, w) uint8 at `_COVER_M_PER_PX`."""
    cover = np.zeros((round(WORLD_M[1] / _COVER_M_PER_PX), round(WORLD_M[0] / _COVER_M_PER_PX)), np.uint8)
    for tree in trees:
        side = max(2, round(CANOPY_SPAN * tree.r / _COVER_M_PER_PX))
        crown = cv2.resize(canopies[tree.variant][..., 3], (side, side), interpolation=cv2.INTER_AREA)
        left, top = (round(at / _COVER_M_PER_PX - side / 2) for at in (tree.x, tree.y))
        patch = cover[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)]
        inside = crown[max(-top, 0) :, max(-left, 0) :][: patch.shape[0], : patch.shape[1]]
        np.maximum(patch, inside, out=patch)
    return cover


def _pyramid(picture: npt.NDArray[np.uint8]) -> list[npt.NDArray[np.uint8]]:
    """The picture and three halvings of it."""
    levels = [picture]
    for _ in range(3):
        levels.append(
            np.asarray(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        )
    return levels


def _canopy(rng: np.random.Generator, appearance: Appearance) -> npt.NDArray[np.uint8]:
    side = _CANOPY_PX
    bgr = np.zeros((side, side, 3), np.uint8)
    alpha = np.zeros((side, side), np.uint8)
    outward = np.array(appearance.shadow_vector)
    outward = outward / max(float(np.hypot(*outward)), 1e-6)
    base = np.array(appearance.grass_bgr) * np.array([0.62, 0.86, 0.66]) * rng.uniform(0.82, 1.15)
    base = base + rng.normal(0, 6, 3)
    clumps = 150
    turn, reach = rng.uniform(0, 2 * np.pi, clumps), np.sqrt(rng.uniform(0, 1, clumps))
    # Outer and low clumps first, the crown's top last.
    for angle, radius in sorted(zip(turn, reach, strict=True), key=lambda clump: -clump[1]):
        direction = np.array([np.cos(angle), np.sin(angle)])
        spot = side / 2 + direction * radius * side * 0.39
        size = int(side * rng.uniform(0.035, 0.075))
        lit = 1.0 - 0.42 * radius * float(direction @ outward) - 0.14 * radius + float(rng.normal(0, 0.10))
        centre = np.round(spot).astype(int)
        dark = np.clip(base * lit * 0.62, 0, 255).tolist()
        bright = np.clip(base * lit * 1.22, 0, 255).tolist()
        cv2.circle(alpha, centre.tolist(), size, 255, -1, cv2.LINE_AA)
        cv2.circle(bgr, centre.tolist(), size + 1, dark, -1, cv2.LINE_8)
        cv2.circle(
            bgr,
            np.round(spot - outward * size * 0.3).astype(int).tolist(),
            int(size * 0.72),
            bright,
            -1,
            cv2.LINE_AA,
        )
    noise = cv2.resize(rng.normal(1, 0.10, (side // 2, side // 2)).astype(np.float32), (side, side))
    lit_bgr = np.clip(bgr * noise[..., None] * (alpha[..., None] / 255.0), 0, 255)
    bgra = np.concatenate([lit_bgr, alpha[..., None]], axis=2).astype(np.uint8)
    bgra[..., :3] = np.minimum(bgra[..., :3], bgra[..., 3:])
    return bgra
