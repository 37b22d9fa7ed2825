"""The tracks of one frame as a VMTI local set (MISB ST 0903.5), to be nested in ST 0601 as item 74.

The class of a target is the detector's or the classifier's own word, as a VObject (item 102) with an ontology class
and no ontology: there is none that knows these words.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from hvt_common.geodesy import turned_deg
from hvt_gateways.transport_stream.klv import ber_length, ber_oid, imapb, item, whole
from hvt_ground.events import Overlay

MOST_BYTES: Final = 48 * 1024
"""Limit of all targets: a PES packet holds 64 kB."""
_SYSTEM: Final = b"HVT"
_VERSION: Final = 5
_MOST_COUNT: Final = 0xFFFFFF
_OFFSET_DEG: Final = 19.2
_LONGEST_CLASS: Final = 127


def vmti_local_set(
    overlay: Overlay, *, size: tuple[int, int], centre: tuple[float, float] | None, time: bytes
) -> bytes:
    """The value of item 74, without key and checksum, as it is nested.

    ``size`` is (width, height) of the picture, base pixels. Places are offsets (items 10 and 11) from ``centre``, the
    frame centre of the set around it, latitude and longitude in degrees; None leaves them out. (Item 17 would need a
    height above the ellipsoid, which nobody knows.) ``time`` is the precision time stamp.

    Tracks that stills doubt are counted (item 5) but not reported (item 6), and so are those for which there is no
    room, the least sure ones.
    """
    rows = np.flatnonzero(~overlay.doubted)
    targets: dict[int, bytes] = {}
    left_bytes = MOST_BYTES
    for row in sorted(rows.tolist(), key=lambda one: -float(overlay.confidences[one])):
        target = _target(overlay, row, size=size, centre=centre)
        left_bytes -= len(target)
        if left_bytes < 0:
            break
        targets[row] = target
    items = [
        item(2, time),
        item(3, _SYSTEM),
        item(4, whole(_VERSION)),
        item(5, whole(min(len(overlay.track_ids), _MOST_COUNT))),
        item(6, whole(len(targets))),
        item(7, whole(overlay.frame_index & _MOST_COUNT)),
        item(8, whole(size[0])),
        item(9, whole(size[1])),
    ]
    if targets:
        items.append(item(101, b"".join(targets[row] for row in sorted(targets))))
    return b"".join(items)


def _target(
    overlay: Overlay, row: int, *, size: tuple[int, int], centre: tuple[float, float] | None
) -> bytes:
    """One VTarget pack with its length."""
    x1, y1, x2, y2 = overlay.boxes_base_px[row].tolist()
    items = [
        item(1, _pixel((x1 + x2) / 2, (y1 + y2) / 2, size=size)),
        item(2, _pixel(x1, y1, size=size)),
        item(3, _pixel(math.ceil(x2) - 1, math.ceil(y2) - 1, size=size)),
        item(5, whole(round(100 * min(max(float(overlay.confidences[row]), 0.0), 1.0)))),
    ]
    if centre is not None and overlay.places is not None:
        latitude, longitude = overlay.places.places_deg[row].tolist()
        across = turned_deg(longitude - centre[1])
        offsets = [imapb(one, -_OFFSET_DEG, _OFFSET_DEG, size=3) for one in (latitude - centre[0], across)]
        if all(offsets):
            items += [item(10, offsets[0]), item(11, offsets[1])]
    name = overlay.words[row].encode()[:_LONGEST_CLASS].decode(errors="ignore").encode()
    items.append(item(102, item(2, name)))
    pack = ber_oid(max(0, int(overlay.track_ids[row]))) + b"".join(items)
    return ber_length(len(pack)) + pack


def _pixel(x: float, y: float, *, size: tuple[int, int]) -> bytes:
    """The number of the pixel that a point lies in: from 1 at the top left, row by row (ST 0903, VTarget item 1)."""
    column, line = (
        min(max(math.floor(value), 0), side - 1) for value, side in zip((x, y), size, strict=True)
    )
    return whole(column + 1 + line * size[0])
