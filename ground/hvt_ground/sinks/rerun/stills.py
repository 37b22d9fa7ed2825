"""What a recording shows of stills: pairs in the gallery, patches on the enhanced picture, lines of the event log."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import rerun as rr

from hvt_ground.events import Overlay, Refinement
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.backlog_stills import BacklogGallery, CaptionRow, Put
from hvt_ground.sinks.rerun.gallery import HOLD_S, SLOTS, Gallery, placed
from hvt_ground.sinks.rerun.palette import GREY, Rgb, class_colour
from hvt_ground.sinks.rerun.patches import Patches
from hvt_ground.sinks.rerun.still_pairs import BLANK, Coded, base_picture, caption, event_text, still_picture
from hvt_ground.sinks.rerun.tables import (
    Captions,
    LogText,
    PlacedJpeg,
    SizeLimit,
    caption_columns,
    hidden_picture_columns,
    patch_columns,
    picture_columns,
    place_columns,
    text_columns,
)

__all__ = ["RowTime", "StillRows", "TableRow"]

HIDDEN_CROP_RATIO = 1.15
"""A still that is not shown keeps its base crop while the recording is smaller than this times the bytes received."""

PAIR_RATIO = 1.3
"""A pair that costs more than came over the link (a residual still, shown as JPEG) is shown below this ratio."""

PATCH_RATIO = 1.25
"""A patch that repeats a picture of the gallery, or follows its track, is written below this ratio."""

_REMEMBERED_STILLS = 64
_MOVE_BYTES = 30
_PATCH_BYTES = 100


@dataclass(frozen=True, slots=True)
class RowTime:
    """A moment of a recording."""

    frame_index: int
    capture_ns: int


@dataclass(frozen=True, slots=True)
class TableRow:
    """A row for the table of an entity with these columns."""

    path: str
    columns: Callable[..., Iterable[rr.ComponentColumn]]
    value: Any
    size_bytes: int = 64
    """What it costs once compacted, about."""
    at: RowTime | None = None
    """Where that is not the event's."""


class StillRows:
    """Decides what of each still is worth writing. Not safe for threads."""

    def __init__(self, size_limit: SizeLimit) -> None:
        self._size_limit = size_limit
        self._gallery = Gallery()
        self._captions: Captions = (("", GREY),) * SLOTS
        self._backlog = BacklogGallery(self._captions, hold_ns=round(HOLD_S * 1e9))
        self._patches = Patches()
        self._pictured: OrderedDict[int, None] = OrderedDict()

    def refinement(self, refinement: Refinement) -> list[TableRow]:
        """The rows of a still; its pictures are written once, however many objects it shows."""
        changed = refinement.class_before != refinement.class_after
        text = event_text(refinement)
        colour = class_colour(refinement.class_after) if changed else GREY
        rows = [TableRow(names.EVENTS, text_columns, LogText(text, "INFO", colour), len(text))]
        still = still_picture(refinement) if self._is_new(refinement.still_sequence) else None
        if still is None:
            return rows
        self._size_limit.received_bytes += len(refinement.still)
        base = base_picture(refinement, still_size=still[1], limit_bytes=round(0.8 * len(still[0])))
        shown = self._pair(refinement, base, still, changed=changed)
        spent = sum(row.size_bytes for row in shown)
        # A still that found no slot in the gallery can be seen on the enhanced picture only. Patches ride on the
        # tracks of now: one of long ago has no place there.
        if refinement.stored:
            return rows + (shown or self._hidden(refinement, base, still))
        if self._size_limit.has(spent + len(still[0]) + _PATCH_BYTES, ratio=PATCH_RATIO) or not (
            shown or still[0] is not refinement.still
        ):
            shown += self._patch(refinement, still)
        return rows + (shown or self._hidden(refinement, base, still))

    def overlay(self, overlay: Overlay) -> list[TableRow]:
        """The patches that move with their tracks, or go."""
        rows = []
        for moved in self._patches.move(overlay):
            path = f"{names.PATCHES}/{moved.slot}"
            if moved.place is None:
                rows.append(TableRow(path, patch_columns, None, _MOVE_BYTES))
            elif self._size_limit.has(_MOVE_BYTES, ratio=PATCH_RATIO):
                rows.append(TableRow(path, place_columns, moved.place, _MOVE_BYTES))
        return rows

    def _is_new(self, still_sequence: int) -> bool:
        if still_sequence in self._pictured:
            return False
        self._pictured[still_sequence] = None
        if len(self._pictured) > _REMEMBERED_STILLS:
            self._pictured.popitem(last=False)
        return True

    def _pair(
        self, refinement: Refinement, base: Coded | None, still: Coded, *, changed: bool
    ) -> list[TableRow]:
        """Base crop and still in the gallery; nothing where all slots are held, or for lack of room."""
        # A slot's old base crop must not stand beside a new still: the frame's absence is shown as a blank.
        pictures = (("base", base or BLANK), ("still", still))
        cost = sum(len(data) for _, (data, _) in pictures)
        if still[0] is not refinement.still and not self._size_limit.has(cost, ratio=PAIR_RATIO):
            return []
        put = self._slot(refinement, changed=changed)
        if put is None:
            return []
        rows = []
        for name, (data, size) in pictures:
            picture = PlacedJpeg(data, placed(put.slot, size, right=name == "still"))
            rows.append(TableRow(f"{names.STILLS}/{put.slot}/{name}", picture_columns, picture, len(data)))
        for shown in put.rows:
            at = RowTime(shown.frame_index, shown.capture_ns)
            rows.append(TableRow(names.CAPTIONS, caption_columns, shown.captions, 160, at))
        return rows

    def _slot(self, refinement: Refinement, *, changed: bool) -> Put[tuple[str, Rgb]] | None:
        """A slot of the gallery and the captions to write; None where all are held."""
        words = (caption(refinement), class_colour(refinement.class_after))
        at = refinement.frame_index, refinement.capture_ns
        if refinement.stored:
            put = self._backlog.put(*at, words)
            if put is not None and put.stays:
                self._captions = _with(self._captions, put.slot, words)
            return put
        slot = self._gallery.take(refinement.capture_ns, changed=changed)
        if slot is None:
            return None
        self._captions = _with(self._captions, slot, words)
        row = CaptionRow(*at, self._captions)
        self._backlog.note(slot, row)
        return Put(slot, (row,), stays=True)

    def _patch(self, refinement: Refinement, still: Coded) -> list[TableRow]:
        """The still on the enhanced picture; nothing where its object is not on the screen."""
        data, size = still
        put = self._patches.put(refinement, size=size)
        if put is None or put.place is None:
            return []
        path = f"{names.PATCHES}/{put.slot}"
        return [TableRow(path, patch_columns, PlacedJpeg(data, put.place), len(data) + _MOVE_BYTES)]

    def _hidden(self, refinement: Refinement, base: Coded | None, still: Coded) -> list[TableRow]:
        """Kept where it can be found but not seen, as far as bytes allow; a still as received always is."""
        path, rows = names.OVERFLOW, []
        for name, picture in (("still", still), ("base", base)):
            if picture is None:
                continue
            data = picture[0]
            if data is refinement.still or self._size_limit.has(len(data), ratio=HIDDEN_CROP_RATIO):
                rows.append(TableRow(f"{path}/{name}", hidden_picture_columns, data, len(data)))
        return rows


def _with(captions: Captions, slot: int, words: tuple[str, Rgb]) -> Captions:
    return (*captions[:slot], words, *captions[slot + 1 :])
