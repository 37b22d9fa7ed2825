"""Stored stills name the tracks of stored video: each the one whose box it shows at its frame."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hvt_common.values import iou
from hvt_ground.events import Event, Overlay, Refinement

_LEAST_IOU = 0.4
_MOST = 512


class LateStills:
    """The late stills of one session; for one thread. Stills come before the boxes of their frame."""

    def __init__(self) -> None:
        self._stills: OrderedDict[int, list[Refinement]] = OrderedDict()
        """Those of no track yet, by frame."""
        self._named: OrderedDict[int, Refinement] = OrderedDict()
        """Stills by track."""

    def take(self, still: Refinement) -> None:
        """Note a stored still that was read; others pass by."""
        if still.stored and not still.unread and still.track_id is None:
            bare = replace(still, base_crop_bgr=None, still_bgr=None)  # the pictures are shown already
            self._stills.setdefault(still.frame_index, []).append(bare)
            if len(self._stills) > _MOST:
                self._stills.popitem(last=False)

    def named(self, overlay: Overlay) -> Iterator[Event]:
        """The overlay with the classes of the stills so far, after the refinements by the stills of its frame."""
        tracks = overlay.track_ids.tolist()
        for still in self._stills.pop(overlay.frame_index, ()) if tracks else ():
            shares = iou(np.array([still.box_base_px], np.float32), overlay.boxes_base_px)[0]
            best = int(shares.argmax())
            if shares[best] >= _LEAST_IOU:
                self._named[tracks[best]] = still
                before = overlay.base_classes[best]
                yield replace(still, track_id=tracks[best], class_before=before)
        while len(self._named) > _MOST:
            self._named.popitem(last=False)
        stills = [self._named.get(track) for track in tracks]
        if not any(stills):
            yield overlay
            return
        classes = zip(overlay.classes, stills, strict=True)
        confidences = zip(overlay.confidences.tolist(), stills, strict=True)
        yield replace(
            overlay,
            classes=tuple(still.class_after if still else name for name, still in classes),
            confidences=np.array([s.confidence if s else own for own, s in confidences], np.float32),
            refined=np.array([still is not None for still in stills], np.bool_),
            doubted=np.array([still is not None and still.doubted for still in stills], np.bool_),
        )
