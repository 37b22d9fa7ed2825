"""Writes of an overlay only the visible changes.

A recording answers a question about frame N with the latest value of every component, so a value that did not
change need not be written again. Tracks are in four layers: those that the base stream shows and whose class rests
on it alone, those known from reports only, those that a still has spoken on, and those that stills doubt. Brightness
follows the probability. Words stand only at tracks that a still renamed or doubts, or that somebody chose.

Boxes are held against jitter: a box keeps the place that is on screen until it has moved more than `CENTRE_STEP_PX`
or grown more than `HALF_SIZE_STEP_PX`, and is then put on the nearest half pixel. The LZ4 compression of a chunk
removes equal numbers in equal places. A confidence, its brightness and a label's side are held in the same way.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from hvt_ground.events import Origin, Overlay
from hvt_ground.sinks.rerun.labels import Label, Word, place_labels

CENTRE_STEP_PX = 0.75
HALF_SIZE_STEP_PX = 1.0
CONFIDENCE_STEP_PCT = 5

BRIGHTNESS = (0.45, 0.75, 1.0)
"""By level: probability below one half; above; refined by a still with a calibrated probability above .9."""
_FAINT, _LIKELY, _SURE = range(3)
_FAINT_BELOW_PCT, _LIKELY_FROM_PCT = 45, 55
_MOST_CHOSEN = 8

Layer = Literal["tracks", "reported", "refined", "doubted", "labels"]
LAYERS: tuple[Layer, ...] = ("tracks", "reported", "refined", "doubted", "labels")

ORIGINS: tuple[Origin, ...] = ("base", "edge", "edge+base", "still")
"""Origins by the number that stands for them in a recording."""

REPORTED_MARK = "○"
_REPORTED: tuple[Origin, ...] = ("edge", "still")

_BOX_BYTES = 16  # two centres and two half sizes, float32
_ROW_BYTES = 40  # row id, two times, offsets
_MOST_HOLES = 256
_LEAST_S, _CONTINUES_S = 1.0, 2.0


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of the boxes of one layer; N entries in the order of the boxes."""

    track_ids: tuple[int, ...] = ()
    classes_before: tuple[str, ...] = ()
    classes_now: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    levels: tuple[int, ...] = ()
    """Levels of `BRIGHTNESS`."""


@dataclass(frozen=True, slots=True)
class LayerUpdate:
    """The changes of one layer at one frame. A missing component is as before."""

    layer: Layer
    components: Mapping[str, Any]
    """``boxes``: (N, 4) float32 centre and half size, whole or half base pixels; ``identity``: an `Identity`;
    ``confidences``: N percents; ``origins``: N numbers of `ORIGINS`. Of the layer ``labels``: ``places``: (M, 2)
    float32 points that a text is centred below; ``words``: M texts; ``inks``: M pairs of class and level."""


@dataclass(frozen=True, slots=True)
class _Screen:
    ids: npt.NDArray[np.int64]
    boxes: npt.NDArray[np.float32]
    """(N, 4) centre and half size."""
    percents: npt.NDArray[np.int64]
    levels: npt.NDArray[np.int64]
    """(N,) of `BRIGHTNESS`."""
    sides: Mapping[int, int]
    """Sides of the labels, by track."""


class OverlayEncoder:
    """Turns overlays into the smallest updates that show them.

    Movement is written at the overlay's own rate while it costs less than ``share`` of the bytes received (and
    ``credit_bytes`` before that), and less often beyond; a change of the set of tracks, of a class or of a label is
    always written. ``afresh`` writes the first overlay whole. ``size`` is (width, height) of the picture.
    """

    def __init__(
        self, size: tuple[int, int], *, share: float = 0.2, credit_bytes: int = 16_384, afresh: bool = False
    ) -> None:
        self._size = size
        self._chosen: deque[int] = deque(maxlen=_MOST_CHOSEN)
        self._share = share
        self._limit = self._credit = float(credit_bytes)
        self._newest_frame = -1
        nothing = np.empty((0, 4), np.float32)
        none = np.empty(0, np.int64)
        self._screen = _Screen(none, nothing, none, none, {})
        empty = {"boxes": nothing, "identity": Identity(), "confidences": (), "origins": ()}
        silent = {"places": nothing[:, :2], "words": (), "inks": ()}
        self._written: dict[Layer, Mapping[str, Any]] = {
            layer: {} if afresh else silent if layer == "labels" else empty for layer in LAYERS
        }

    @property
    def screen(self) -> list[LayerUpdate]:
        return [LayerUpdate(layer, components) for layer, components in self._written.items()]

    def earn(self, received_bytes: int) -> None:
        """Credit the share of the bytes received on the link."""
        self._credit = min(self._credit + self._share * received_bytes, self._limit)

    def choose(self, track_id: int) -> None:
        """Somebody asked for this track: it is labelled, as long as it is among the last ones."""
        self._chosen.append(track_id)

    def encode(self, overlay: Overlay) -> list[LayerUpdate]:
        """The updates that bring the screen to ``overlay``; none where nothing visible changed.

        An overlay of an earlier frame than the last has been drawn over, and changes nothing.
        """
        if overlay.frame_index < self._newest_frame:
            return []
        self._newest_frame = overlay.frame_index
        screen = _held(self._screen, overlay)
        labels = _labels(overlay, screen, self._size, self._chosen)
        screen = replace(screen, sides={int(screen.ids[one.row]): one.side for one in labels})
        wanted = dict(_layers(overlay, screen))
        wanted["labels"] = _label_components(overlay, screen, labels)
        updates = []
        for layer, components in wanted.items():
            old = self._written[layer]
            changed = {name: one for name, one in components.items() if not _same(old.get(name), one)}
            if changed:
                updates.append(LayerUpdate(layer, changed))
        if not self._affordable(updates):
            return []
        self._screen, self._written = screen, dict(wanted)
        return updates

    def _affordable(self, updates: list[LayerUpdate]) -> bool:
        cost = sum(
            _movement_bytes(self._written[one.layer].get(name), one.components.get(name))
            for one in updates
            for name in ("boxes", "places")
        )
        if cost > self._credit and not any({"identity", "words"} & one.components.keys() for one in updates):
            return False
        self._credit -= cost
        return True


@dataclass(slots=True)
class _Hole:
    before: int
    after: int | None
    """Frame of the first overlay after it; None where there has been none."""
    capture_ns: int = 0
    """Capture time of that frame."""
    screen: tuple[LayerUpdate, ...] = ()
    """All that is on the screen there."""
    written: bool = False


class BacklogOverlays:
    """Boxes in a hole that is filled later, written so that they end where the live stream goes on.

    A viewer shows the latest value before its time, so boxes in a hole would stand over the video after it. At the
    first overlay after the hole all is therefore written once more. Holes shorter than a second are none: the
    base stream leaves out frames. Of one recording; not safe for threads.
    """

    def __init__(self, size: tuple[int, int], *, fps: float) -> None:
        self._size = size
        self._least = max(2, round(_LEAST_S * fps))
        self._continues = round(_CONTINUES_S * fps)
        self._newest: int | None = None
        self._holes: deque[_Hole] = deque([_Hole(-1, None)], maxlen=_MOST_HOLES)
        self._encoder: OverlayEncoder | None = None
        self._last = -1
        self._credit_bytes = 0

    def note(self, overlay: Overlay, encoder: OverlayEncoder) -> None:
        """Note a live overlay; ``encoder`` knows the screen."""
        frame, newest = overlay.frame_index, self._newest
        if newest is not None and frame <= newest:
            return
        self._newest = frame
        if newest is None:
            self._holes.clear()
        if newest is None or frame - newest >= self._least:
            before = -1 if newest is None else newest
            self._holes.append(_Hole(before, frame, overlay.capture_ns, tuple(encoder.screen)))

    def earn(self, received_bytes: int) -> None:
        """Credit the bytes of stored video, as `OverlayEncoder.earn`."""
        self._credit_bytes += received_bytes

    def encode(self, overlay: Overlay) -> list[tuple[int, int, LayerUpdate]]:
        """The changes of an overlay of stored video, with frame and capture time; nothing outside a hole."""
        frame = overlay.frame_index
        holes = (
            one for one in self._holes if one.before < frame and (one.after is None or frame < one.after)
        )
        hole = next(holes, None)
        if hole is None:
            return []
        timed = []
        if hole.after is not None and not hole.written:
            hole.written = True
            timed += [(hole.after, hole.capture_ns, update) for update in hole.screen]
        if self._encoder is None or not 0 < frame - self._last <= self._continues:
            self._encoder = OverlayEncoder(self._size, afresh=True)
        self._last = frame
        self._encoder.earn(self._credit_bytes)
        self._credit_bytes = 0
        return timed + [(frame, overlay.capture_ns, update) for update in self._encoder.encode(overlay)]


def _held(screen: _Screen, overlay: Overlay) -> _Screen:
    # The overlay's values on their grids, except where the screen is near enough.
    corners = overlay.boxes_base_px
    boxes = np.hstack((corners[:, :2] + corners[:, 2:], corners[:, 2:] - corners[:, :2])) / 2
    percents = np.round(overlay.confidences * 100).astype(np.int64)
    levels = np.where(percents < 50, _FAINT, _LIKELY)
    ids = overlay.track_ids.copy()
    result = _Screen(ids, (np.round(boxes * 2) / 2).astype(np.float32), percents.copy(), levels, screen.sides)
    _, new, old = np.intersect1d(overlay.track_ids, screen.ids, assume_unique=True, return_indices=True)
    moved = np.abs(boxes[new] - screen.boxes[old])
    for columns, step_px in ((slice(2), CENTRE_STEP_PX), (slice(2, 4), HALF_SIZE_STEP_PX)):
        near = (moved[:, columns] <= step_px).all(axis=1)
        result.boxes[new[near], columns] = screen.boxes[old[near], columns]
    near = np.abs(percents[new] - screen.percents[old]) < CONFIDENCE_STEP_PCT
    result.percents[new[near]] = screen.percents[old[near]]
    between = (percents[new] >= _FAINT_BELOW_PCT) & (percents[new] < _LIKELY_FROM_PCT)
    levels[new[between]] = np.minimum(screen.levels[old[between]], _LIKELY)
    levels[overlay.sure] = _SURE
    return result


def _layers(overlay: Overlay, screen: _Screen) -> Iterator[tuple[Layer, dict[str, Any]]]:
    reported, doubted, words = _reported(overlay), overlay.doubted, overlay.words
    of_layer: dict[Layer, npt.NDArray[np.bool_]] = {
        "tracks": ~overlay.refined & ~reported & ~doubted,
        "reported": ~overlay.refined & reported & ~doubted,
        "refined": overlay.refined & ~doubted,
        "doubted": doubted,
    }
    for layer, mask in of_layer.items():
        rows = np.flatnonzero(mask).tolist()
        components: dict[str, Any] = {
            "boxes": screen.boxes[mask],
            "identity": Identity(
                tuple(overlay.track_ids[mask].tolist()),
                tuple(overlay.base_classes[row] for row in rows),
                tuple(overlay.classes[row] for row in rows),
                tuple(words[row] for row in rows),
                tuple(screen.levels[mask].tolist()),
            ),
            "confidences": tuple(screen.percents[mask].tolist()),
            "origins": tuple(ORIGINS.index(overlay.origins[row]) for row in rows),
        }
        yield layer, components


def _same(old: object, new: object) -> bool:
    if isinstance(new, np.ndarray):
        return isinstance(old, np.ndarray) and np.array_equal(old, new)
    return old == new


def _movement_bytes(old: npt.NDArray[np.float32] | None, new: npt.NDArray[np.float32] | None) -> int:
    # An estimate after compression: the boxes that differ from the row before, and the row itself.
    if new is None:
        return 0
    if old is None or len(old) != len(new):
        return _ROW_BYTES + _BOX_BYTES * len(new)
    moved = (old != new).reshape(len(new), -1, 2).any(axis=2)  # centre, half size
    return _ROW_BYTES + _BOX_BYTES // 2 * int(moved.sum())


def _reported(overlay: Overlay) -> npt.NDArray[np.bool_]:
    return np.array([origin in _REPORTED for origin in overlay.origins], np.bool_)


def _labels(overlay: Overlay, screen: _Screen, size: tuple[int, int], chosen: Container[int]) -> list[Label]:
    # Labels of the tracks that a still renamed or doubts, or that were chosen, as far as there is room.
    reported, shown = _reported(overlay), overlay.words
    words = []
    for row, track_id in enumerate(screen.ids.tolist()):
        renamed = overlay.base_classes[row] != overlay.classes[row]
        if not renamed and track_id not in chosen:
            continue
        mark = f" {REPORTED_MARK}" if reported[row] else ""
        name = f"{overlay.base_classes[row]}?" if overlay.doubted[row] else shown[row]
        certain = " ✓" if screen.levels[row] == _SURE else ""
        words.append(Word(row, f"{track_id} {name}{certain}{mark}"))
    centres, halves = screen.boxes[:, :2].astype(np.float64), screen.boxes[:, 2:].astype(np.float64)
    boxes = np.hstack([centres - halves, centres + halves])
    sides = {row: screen.sides[one] for row, one in enumerate(screen.ids.tolist()) if one in screen.sides}
    return place_labels(words, boxes, size=size, sides=sides)


def _label_components(overlay: Overlay, screen: _Screen, labels: Sequence[Label]) -> dict[str, Any]:
    return {
        "places": np.round(np.array([one.at_px for one in labels], np.float32).reshape(-1, 2)),
        "words": tuple(one.text for one in labels),
        "inks": tuple((overlay.words[one.row], int(screen.levels[one.row])) for one in labels),
    }


def confidence_text(percent: int) -> str:
    """``.07``, ``.93``, ``1.0``."""
    return f".{percent:02d}" if percent < 100 else "1.0"
