"""Stills in a recording: their words and pictures, and which rows of them are worth writing."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np

from hvt_common.inference.class_names import is_nothing
from hvt_common.protocol.messages import RoiHeader
from hvt_common.runtime.statistics import Newest
from hvt_common.values import Image
from hvt_ground.events import Overlay, Refinement
from hvt_ground.sinks.palette import AMBER, GREY, class_colour
from hvt_ground.sinks.rerun import blueprint as names
from hvt_ground.sinks.rerun.overlays import confidence_text
from hvt_ground.sinks.rerun.still_places import Gallery, Patches, frame_of, placed
from hvt_ground.sinks.rerun.tables import Caption, LogText, PlacedJpeg, SizeLimit, TableRow

Coded = tuple[bytes, tuple[int, int]]
"""A JPEG and its (width, height) in pixels."""

_FIRST_STORED = 2**31
"""Stills that were stored at the edge are numbered from here on."""
_STILL = re.compile(r"(late )?still #(\d+) (?:→ track (\d+): .*(?:\.\d\d|1\.0)  \()?")
_QUALITIES_PCT = (75, 65, 55)
_STILL_QUALITY_PCT = 85

HIDDEN_CROP_RATIO = 1.15
"""A still that is not shown keeps its base crop while the recording is smaller than this times the bytes received."""

PAIR_RATIO = 1.3
"""A pair that costs more than came over the link (a residual still, shown as JPEG) is shown below this ratio …"""

PAIR_SHARE = 0.25
"""… and, however much video and boxes take, while such pairs are less than this times the bytes received: stills
matter most."""

PATCH_RATIO = 1.25
"""A patch that repeats a picture of the gallery, or follows its track, is written below this ratio."""

_REMEMBERED_STILLS = 1024
_MOVE_BYTES = 30
_PATCH_BYTES = 100


class StillRows:
    """Decides which parts of each still are worth writing. Not safe for threads."""

    def __init__(self, size_limit: SizeLimit) -> None:
        self._size_limit = size_limit
        self._gallery = Gallery()
        self._patches = Patches()
        self._pair_bytes = 0
        """Bytes of pairs beyond those that came over the link."""
        self._pictured: Newest[int, None] = Newest(_REMEMBERED_STILLS)

    def refinement(self, refinement: Refinement) -> list[TableRow]:
        """The rows of a still; its pictures are written once, however many objects it shows."""
        before, after = refinement.words
        changed = before != after
        text = event_text(refinement)
        colour = class_colour(after) if changed else GREY
        if refinement.doubted:
            colour = AMBER
        rows = [TableRow(names.EVENTS, "text", LogText(text, "INFO", colour), len(text))]
        still = still_picture(refinement) if self._pictured.put(refinement.still_sequence, None) else None
        if still is None:
            return rows
        self._size_limit.received_bytes += len(refinement.still)
        base = base_picture(refinement, still_size=still[1], limit_bytes=round(0.8 * len(still[0])))
        shown = self._pair(refinement, base, still, changed=changed)
        spent = sum(row.size_bytes for row in shown)
        # A still that found no slot in the gallery can be seen on the enhanced picture only. Patches ride on the
        # tracks of now: one of long ago has no place there.
        if not refinement.stored and (
            self._size_limit.has(spent + len(still[0]) + _PATCH_BYTES, ratio=PATCH_RATIO)
            or not (shown or still[0] is not refinement.still)
        ):
            shown += self._patch(refinement, still)
        shown = shown or self._hidden(refinement, base, still)
        return [*rows, *shown, *(_message(refinement, still) if shown else [])]

    def overlay(self, overlay: Overlay) -> list[TableRow]:
        """The patches that move with their tracks, or go."""
        rows = []
        for moved in self._patches.move(overlay):
            path = f"{names.PATCHES}/{moved.slot}"
            if moved.place is None:
                rows.append(TableRow(path, "patch", None, _MOVE_BYTES))
            elif self._size_limit.has(_MOVE_BYTES, ratio=PATCH_RATIO):
                rows.append(TableRow(path, "place", moved.place, _MOVE_BYTES))
        return rows

    def _pair(
        self, refinement: Refinement, base: Coded | None, still: Coded, *, changed: bool
    ) -> list[TableRow]:
        # Base crop and still in the gallery; nothing where all slots are held, or for lack of room.
        # A slot's old base crop must not stand beside a new still: the frame's absence is shown as a blank.
        pictures = (("base", base or BLANK), ("still", still))
        cost = sum(len(data) for _, (data, _) in pictures)
        dear = still[0] is not refinement.still
        if dear and not self._pair_fits(cost):
            return []
        at = refinement.frame_index, refinement.capture_ns
        gallery = self._gallery
        slot = gallery.put_stored(*at) if refinement.stored else gallery.put(*at, changed=changed)
        if slot is None:
            return []
        self._pair_bytes += cost if dear else 0
        path = f"{names.STILLS}/{slot}"
        words = Caption(caption(refinement), class_colour(refinement.words[1]), frame_of(slot))
        rows = [TableRow(path, "caption", words)]
        for name, (data, size) in pictures:
            picture = PlacedJpeg(data, placed(slot, size, right=name == "still"))
            rows.append(TableRow(f"{path}/{name}", "placed jpeg", picture, len(data)))
        return rows

    def _pair_fits(self, pair_bytes: int) -> bool:
        share = PAIR_SHARE * self._size_limit.received_bytes
        return self._pair_bytes + pair_bytes <= share or self._size_limit.has(pair_bytes, ratio=PAIR_RATIO)

    def _patch(self, refinement: Refinement, still: Coded) -> list[TableRow]:
        # The still on the enhanced picture; nothing where its object is not on the screen.
        data, size = still
        put = self._patches.put(refinement, size=size)
        if put is None or put.place is None:
            return []
        path = f"{names.PATCHES}/{put.slot}"
        return [TableRow(path, "patch", PlacedJpeg(data, put.place), len(data) + _MOVE_BYTES)]

    def _hidden(self, refinement: Refinement, base: Coded | None, still: Coded) -> list[TableRow]:
        # Kept where it can be found but not seen, as far as bytes allow; a still as received always is.
        path, rows = names.OVERFLOW, []
        for name, picture in (("still", still), ("base", base)):
            if picture is None:
                continue
            data = picture[0]
            if data is refinement.still or self._size_limit.has(len(data), ratio=HIDDEN_CROP_RATIO):
                rows.append(TableRow(f"{path}/{name}", "jpeg", data, len(data)))
        return rows


def _message(refinement: Refinement, still: Coded) -> list[TableRow]:
    # The still as a message of its own that goes with the JPEG in the recording: its checksum covers the two.
    header, (data, size) = refinement.header, still
    if header is None or len(data) > RoiHeader.MAX_PAYLOAD:
        return []
    x1, y1, x2, y2 = header.crop_source_px
    coded = {} if size == (x2 - x1, y2 - y1) else {"w": size[0], "h": size[1]}
    message = replace(header, codec="jpeg", parameters=coded).pack(data)
    return [TableRow(names.STILL_MESSAGES, "message", message, len(message))]


def caption(refinement: Refinement) -> str:
    """``17  car → van .93``, under the pair; the track is the ground's own where one matched."""
    whose = str(refinement.track_id) if refinement.track_id is not None else "no track"
    if refinement.stored and refinement.track_id is None:
        whose = "late"
    elif refinement.unread:
        whose = f"edge {refinement.edge_track_id}"
    return f"{whose}  {_verdict(refinement)}"


def event_text(refinement: Refinement) -> str:
    """The refinement and the still that caused it, for the event log."""
    verdict = _verdict(refinement)
    if refinement.doubted:
        verdict = f"doubted, {verdict}"
    if refinement.track_id is not None:
        outcome = f"→ track {refinement.track_id}: {verdict}"
    elif refinement.stored or refinement.unread:
        outcome = f"of edge track {refinement.edge_track_id}: {verdict}"
    else:
        outcome = f"matches no track (edge track {refinement.edge_track_id}): {verdict}"
    size = f"{len(refinement.still) / 1000:.1f} kB, q{refinement.quality_pct}"
    number = refinement.still_sequence
    name = f"still #{number}" if number < _FIRST_STORED else f"late still #{number - _FIRST_STORED}"
    return f"{name} {outcome}  ({refinement.reason}; {size})"


def still_of_event(text: str) -> int | None:
    """The sequence number of the still that `event_text` tells of; None of another event."""
    found = _STILL.match(text)
    return None if found is None else int(found[2]) + (_FIRST_STORED if found[1] else 0)


def refined_by_event(text: str) -> int | None:
    """The ground's track whose class the still of this event told; None where it told none's."""
    found = _STILL.match(text)
    return None if found is None or found[3] is None else int(found[3])


def still_picture(refinement: Refinement) -> Coded | None:
    """The still as received where it is a JPEG, else the same pixels as JPEG; None if undecodable.

    The viewer shows neither WebP nor AVIF nor codecs of the ground alone, and one media type for all pictures
    need not be written with each.
    """
    pixels = refinement.still_bgr  # the decoded pixels: the bytes themselves are a stranger's
    if pixels is None and refinement.still:
        pixels = cv2.imdecode(np.frombuffer(refinement.still, np.uint8), cv2.IMREAD_COLOR)  # type: ignore[assignment]
    if pixels is None or pixels.size == 0:
        return None
    size = (pixels.shape[1], pixels.shape[0])
    if refinement.media_type == "image/jpeg":
        return refinement.still, size
    return _jpeg(pixels, quality_pct=_STILL_QUALITY_PCT), size


def base_picture(refinement: Refinement, *, still_size: tuple[int, int], limit_bytes: int) -> Coded | None:
    """The base crop as JPEG of the best quality within ``limit_bytes``, or the lowest where none fits.

    Where the still is finer than the base, the crop is enlarged to its size (bicubic): the viewer would show large
    pixels, and the eye should compare detail. None where the frame was gone.
    """
    crop = refinement.base_crop_bgr
    if crop is None or crop.size == 0:
        return None
    if still_size[0] > 1.1 * crop.shape[1]:
        crop = cv2.resize(crop, still_size, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    data = b""
    for quality in _QUALITIES_PCT:
        data = _jpeg(crop, quality_pct=quality)
        if len(data) <= limit_bytes:
            break
    return data, (crop.shape[1], crop.shape[0])


def _verdict(refinement: Refinement) -> str:
    if refinement.unread:
        why = f"({refinement.note})" if refinement.note else "unread"
        return f"{refinement.class_after} {why}".strip()
    certainty = confidence_text(round(refinement.confidence * 100))
    certain = "✓ " if refinement.sure else ""
    before, after = refinement.words
    if refinement.doubted and before != after:
        return f"{refinement.class_before}? {after} {certainty}"
    if before == after:
        doubt = "?" * (refinement.doubted and not is_nothing(after))
        return f"{after}{doubt} {certain}{certainty}"
    if refinement.track_id is None:  # nothing was renamed by it
        return f"{before}, by itself {after} {certainty}"
    return f"{before} → {after} {certain}{certainty}"


def _jpeg(pixels: Image, *, quality_pct: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality_pct, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, data = cv2.imencode(".jpg", pixels, options)
    return data.tobytes()


BLANK: Coded = (_jpeg(np.full((3, 4, 3), 24, np.uint8), quality_pct=50), (4, 3))
"""Stands where a base crop should be and is not."""
