"""What of an overlay is worth writing: only what a viewer would see change.

A recording answers "what was here at frame N" with the latest value of every component, so a value that did not
change need not be written again. Tracks are in three layers: those that the base stream shows and whose class rests
on it alone, those known from reports only, and those that a still has spoken on. Each layer has *geometry* (centres
and half sizes), *identity* (ids and classes), *labels* and *confidences*; each is written when it changed.

Geometry is held against jitter: a box keeps the place that is on screen until it has moved more than
`CENTRE_STEP_PX` or grown more than `HALF_SIZE_STEP_PX`, and is then put on the nearest half pixel. Equal numbers in
equal places are what the LZ4 compression of a chunk removes. A confidence is held in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from hvt_ground.events import Origin, Overlay

__all__ = [
    "CENTRE_STEP_PX",
    "HALF_SIZE_STEP_PX",
    "LAYERS",
    "ORIGINS",
    "REPORTED_MARK",
    "Geometry",
    "Identity",
    "Layer",
    "LayerUpdate",
    "OverlayEncoder",
    "confidence_text",
]

CENTRE_STEP_PX = 0.75
HALF_SIZE_STEP_PX = 1.0
CONFIDENCE_STEP_PCT = 5

Layer = Literal["tracks", "reported", "refined"]
LAYERS: tuple[Layer, ...] = ("tracks", "reported", "refined")

ORIGINS: tuple[Origin, ...] = ("base", "edge", "edge+base", "still")
"""Origins by the number that stands for them in a recording."""

REPORTED_MARK = "○"
_REPORTED: tuple[Origin, ...] = ("edge", "still")

_BOX_BYTES = 16  # two centres and two half sizes, float32
_ROW_BYTES = 40  # row id, two times, offsets


@dataclass(frozen=True, slots=True)
class Geometry:
    """Where the boxes of one layer are, base pixels."""

    centres_px: npt.NDArray[np.float32]
    """(N, 2) x y, whole or half pixels."""
    half_sizes_px: npt.NDArray[np.float32]
    """(N, 2) half width and half height, whole or half pixels."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What the boxes of one layer are; N entries in the order of the geometry."""

    track_ids: tuple[int, ...]
    classes_before: tuple[str, ...]
    classes_after: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class LayerUpdate:
    """What to write for one layer at one frame; None is "as before"."""

    layer: Layer
    geometry: Geometry | None
    identity: Identity | None
    labels: tuple[str, ...] | None
    """N texts; never in the layer that is drawn without."""
    confidences_pct: tuple[int, ...] | None
    origins: tuple[int, ...] | None = None
    """N numbers of `ORIGINS`; never while all tracks are of the base stream."""

    @property
    def empty(self) -> bool:
        """Whether nothing changed."""
        return (
            self.geometry is None
            and self.identity is None
            and self.labels is None
            and self.confidences_pct is None
            and self.origins is None
        )


@dataclass(frozen=True, slots=True)
class _Shown:
    """What is on screen: the held values of every track of the last overlay that was written."""

    ids: npt.NDArray[np.int64]
    centres: npt.NDArray[np.float32]
    half_sizes: npt.NDArray[np.float32]
    confidences_pct: npt.NDArray[np.int64]


class OverlayEncoder:
    """Turns overlays into the smallest updates that show them.

    Movement is written at the overlay's own rate while it costs less than ``share`` of the bytes received, and less
    often beyond that; a change of the set of tracks, of a class or of a label is always written.

    Args:
        share: of the bytes received, for movement.
        credit_bytes: for movement, before anything was received.
        afresh: nothing is known of what is on the screen, so the first overlay is written whole.
        with_origins: write origins from the first overlay on, not only once one is not of the base stream.
    """

    def __init__(
        self,
        *,
        share: float = 0.125,
        credit_bytes: int = 16_384,
        afresh: bool = False,
        with_origins: bool = False,
    ) -> None:
        self._share = share
        self._limit = float(credit_bytes)
        self._credit = float(credit_bytes)
        self._newest_frame = -1
        self._with_origins = with_origins
        self._shown = _Shown(
            np.empty(0, np.int64),
            np.empty((0, 2), np.float32),
            np.empty((0, 2), np.float32),
            np.empty(0, np.int64),
        )
        self._written: dict[Layer, LayerUpdate] = {
            layer: LayerUpdate(layer, None, Identity((), (), ()), (), (), ()) for layer in LAYERS
        }
        if afresh:
            self._written = {layer: _unknown(layer, with_origins=with_origins) for layer in LAYERS}

    @property
    def with_origins(self) -> bool:
        """Whether origins are written: a track was not of the base stream."""
        return self._with_origins

    @property
    def screen(self) -> tuple[LayerUpdate, ...]:
        """All that is on the screen, whole."""
        return tuple(self._written.values())

    def earn(self, received_bytes: int) -> None:
        """Credit the share of what was received on the link."""
        self._credit = min(self._credit + self._share * received_bytes, self._limit)

    def encode(self, overlay: Overlay) -> list[LayerUpdate]:
        """The updates that bring the screen to ``overlay``; none where nothing visible changed.

        An overlay of an earlier frame than the last has been drawn over, and changes nothing.
        """
        if overlay.frame_index < self._newest_frame:
            return []
        self._newest_frame = overlay.frame_index
        self._with_origins = self._with_origins or any(origin != "base" for origin in overlay.origins)
        shown = _held(self._shown, overlay)
        wanted = [_layer(layer, overlay, shown, with_origins=self._with_origins) for layer in LAYERS]
        updates = [_difference(self._written[update.layer], update) for update in wanted]
        updates = [update for update in updates if not update.empty]
        if not self._affordable(updates):
            return []
        self._shown = shown
        self._written = {update.layer: update for update in wanted}
        return updates

    def _affordable(self, updates: list[LayerUpdate]) -> bool:
        cost = sum(self._movement_bytes(u) for u in updates)
        if cost > self._credit and all(u.identity is None and u.labels is None for u in updates):
            return False
        self._credit -= cost
        return True

    def _movement_bytes(self, update: LayerUpdate) -> int:
        """An estimate after compression: the boxes that differ from the row before, and the row itself."""
        old = self._written[update.layer].geometry
        if update.geometry is None:
            return 0
        if old is None or len(old.centres_px) != len(update.geometry.centres_px):
            return _ROW_BYTES + _BOX_BYTES * len(update.geometry.centres_px)
        centres = int((old.centres_px != update.geometry.centres_px).any(axis=1).sum())
        sizes = int((old.half_sizes_px != update.geometry.half_sizes_px).any(axis=1).sum())
        return _ROW_BYTES + _BOX_BYTES // 2 * (centres + sizes)


def _unknown(layer: Layer, *, with_origins: bool) -> LayerUpdate:
    """What no overlay is equal to; labels only where the layer has some."""
    nobody = (-1,)
    return LayerUpdate(
        layer,
        None,
        Identity(nobody, ("",), ("",)),
        ("",) if layer == "refined" else (),
        nobody,
        nobody if with_origins else (),
    )


def _held(shown: _Shown, overlay: Overlay) -> _Shown:
    """The overlay's values on their grids, except where what is on screen is near enough."""
    boxes = overlay.boxes_base_px
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    half_sizes = (boxes[:, 2:] - boxes[:, :2]) / 2
    percent = np.round(overlay.confidences * 100).astype(np.int64)
    result = _Shown(
        overlay.track_ids.copy(),
        (np.round(centres * 2) / 2).astype(np.float32),
        (np.round(half_sizes * 2) / 2).astype(np.float32),
        percent.copy(),
    )
    _, new, old = np.intersect1d(overlay.track_ids, shown.ids, assume_unique=True, return_indices=True)
    still = (np.abs(centres[new] - shown.centres[old]) <= CENTRE_STEP_PX).all(axis=1)
    result.centres[new[still]] = shown.centres[old[still]]
    same = (np.abs(half_sizes[new] - shown.half_sizes[old]) <= HALF_SIZE_STEP_PX).all(axis=1)
    result.half_sizes[new[same]] = shown.half_sizes[old[same]]
    near = np.abs(percent[new] - shown.confidences_pct[old]) < CONFIDENCE_STEP_PCT
    result.confidences_pct[new[near]] = shown.confidences_pct[old[near]]
    return result


def _layer(layer: Layer, overlay: Overlay, shown: _Shown, *, with_origins: bool) -> LayerUpdate:
    """Everything about one layer."""
    labelled = layer == "refined"
    origins = overlay.origins or ("base",) * len(overlay.track_ids)
    reported = np.array([origin in _REPORTED for origin in origins], np.bool_)
    of_layer = {
        "tracks": ~overlay.refined & ~reported,
        "reported": ~overlay.refined & reported,
        "refined": overlay.refined,
    }
    chosen = np.flatnonzero(of_layer[layer])
    identity = Identity(
        track_ids=tuple(int(i) for i in overlay.track_ids[chosen]),
        classes_before=tuple(overlay.base_classes[i] for i in chosen),
        classes_after=tuple(overlay.classes[i] for i in chosen),
    )
    percent = tuple(int(p) for p in shown.confidences_pct[chosen])
    parts = zip(
        identity.track_ids,
        identity.classes_before,
        identity.classes_after,
        percent,
        reported[chosen].tolist(),
        strict=True,
    )
    return LayerUpdate(
        layer=layer,
        geometry=Geometry(shown.centres[chosen], shown.half_sizes[chosen]),
        identity=identity,
        labels=tuple(_label(*part) for part in parts) if labelled else (),
        confidences_pct=percent,
        origins=tuple(ORIGINS.index(origins[i]) for i in chosen) if with_origins else (),
    )


def _difference(old: LayerUpdate, new: LayerUpdate) -> LayerUpdate:
    """What of ``new`` is not written yet."""
    assert old.identity is not None
    assert new.identity is not None
    same_tracks = old.identity.track_ids == new.identity.track_ids
    same_percent = same_tracks and old.confidences_pct == new.confidences_pct
    return LayerUpdate(
        layer=new.layer,
        geometry=None if same_tracks and _alike(old.geometry, new.geometry) else new.geometry,
        identity=None if old.identity == new.identity else new.identity,
        labels=None if old.labels == new.labels else new.labels,
        confidences_pct=None if same_percent else new.confidences_pct,
        origins=None if old.origins == new.origins else new.origins,
    )


def _alike(old: Geometry | None, new: Geometry | None) -> bool:
    if old is None or new is None:
        return new is None or not len(new.centres_px)  # an empty layer need not be written to be empty
    return np.array_equal(old.centres_px, new.centres_px) and np.array_equal(
        old.half_sizes_px, new.half_sizes_px
    )


def _label(track_id: int, before: str, after: str, confidence_pct: int, reported: bool) -> str:  # noqa: FBT001
    """``17 ✓`` where the still agreed with the base stream, ``17 car → van .93`` where it did not."""
    mark = f" {REPORTED_MARK}" if reported else ""
    if before == after:
        return f"{track_id} ✓{mark}"
    return f"{track_id} {before} → {after} {confidence_text(confidence_pct)}{mark}"


def confidence_text(percent: int) -> str:
    """``.07``, ``.93``, ``1.0``."""
    return f".{percent:02d}" if percent < 100 else "1.0"
