"""The display of a still: its words, and the two pictures of a pair."""

from __future__ import annotations

import cv2
import numpy as np

from hvt_common.values import Image
from hvt_ground.events import Refinement
from hvt_ground.sinks.rerun.overlays import confidence_text

Coded = tuple[bytes, tuple[int, int]]
"""A JPEG and its (width, height) in pixels."""

_FIRST_STORED = 2**31
"""Stills that were stored at the edge are numbered from here on."""
_QUALITIES_PCT = (75, 65, 55)
_STILL_QUALITY_PCT = 85


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


def still_picture(refinement: Refinement) -> Coded | None:
    """The still as received where it is a JPEG, else the same pixels as JPEG; None if undecodable.

    The viewer shows neither WebP nor AVIF nor what only the ground can decode, and one media type for all pictures
    need not be written with each.
    """
    pixels = refinement.still_bgr  # what the codec made of it: the bytes themselves are a stranger's
    if pixels is None:
        pixels = _decoded(refinement.still)
    if pixels is None or pixels.size == 0:
        return None
    size = (pixels.shape[1], pixels.shape[0])
    if refinement.media_type == "image/jpeg":
        return refinement.still, size
    return _jpeg(pixels, quality_pct=_STILL_QUALITY_PCT), size


def _decoded(data: bytes) -> Image | None:
    if not data:
        return None
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return None if pixels is None else pixels.astype(np.uint8)


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
    if refinement.doubted:
        return f"{refinement.class_before}? {refinement.class_after} {certainty}"
    certain = "✓ " if refinement.sure else ""
    if refinement.class_before == refinement.class_after:
        return f"{refinement.class_after} {certain}{certainty}"
    if refinement.track_id is None:  # nothing was renamed by it
        return f"{refinement.class_before}, by itself {refinement.class_after} {certainty}"
    return f"{refinement.class_before} → {refinement.class_after} {certain}{certainty}"


def _jpeg(pixels: Image, *, quality_pct: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality_pct, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    _, data = cv2.imencode(".jpg", pixels, options)
    return data.tobytes()


BLANK: Coded = (_jpeg(np.full((3, 4, 3), 24, np.uint8), quality_pct=50), (4, 3))
"""Stands where a base crop should be and is not."""
