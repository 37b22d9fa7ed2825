"""Boxes in a hole that is filled later: what to write so that they end where the picture of now goes on.

A viewer shows the latest value before its time. Boxes that are written into a hole would stand over what follows it,
where that only said what had changed since before the hole. So at the first overlay after it all is said once more.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from hvt_ground.events import Overlay
from hvt_ground.sinks.rerun.overlay_encoding import LayerUpdate, OverlayEncoder

__all__ = ["BacklogOverlays", "TimedUpdate"]

TimedUpdate = tuple[int, int, LayerUpdate]
"""Frame index, capture time, and what to write there."""

_MOST_HOLES = 256
_CONTINUES_S = 2.0


@dataclass(slots=True)
class _Hole:
    before: int
    after: int | None
    """Frame of the first overlay after it; None where there has been none."""
    capture_ns: int = 0
    """Of that."""
    screen: tuple[LayerUpdate, ...] = ()
    """All that is on the screen there."""
    said: bool = False


class BacklogOverlays:
    """Of one recording. Not safe for threads.

    Args:
        fps: frames a second.
        least_s: shorter holes are none: the base stream leaves out frames, and boxes go on.
    """

    def __init__(self, *, fps: float, least_s: float = 1.0) -> None:
        self._least = max(2, round(least_s * fps))
        self._continues = round(_CONTINUES_S * fps)
        self._newest: int | None = None
        self._holes: deque[_Hole] = deque([_Hole(-1, None)], maxlen=_MOST_HOLES)
        self._encoder: OverlayEncoder | None = None
        self._last = -1
        self._credit_bytes = 0

    def note(self, overlay: Overlay, encoder: OverlayEncoder) -> None:
        """An overlay of now was written; ``encoder`` knows what is on the screen."""
        frame, newest = overlay.frame_index, self._newest
        if newest is not None and frame <= newest:
            return
        self._newest = frame
        if newest is None:
            self._holes.clear()
        if newest is None or frame - newest >= self._least:
            before = -1 if newest is None else newest
            self._holes.append(_Hole(before, frame, overlay.capture_ns, encoder.screen))

    def earn(self, received_bytes: int) -> None:
        """Credit what came of kept video, as `OverlayEncoder.earn`."""
        self._credit_bytes += received_bytes

    def encode(self, overlay: Overlay, *, with_origins: bool) -> list[TimedUpdate]:
        """What to write for an overlay of kept video; nothing where it lies in no hole."""
        frame = overlay.frame_index
        hole = next((one for one in self._holes if one.before < frame and _ends_after(one, frame)), None)
        if hole is None:
            return []
        timed: list[TimedUpdate] = []
        if hole.after is not None and not hole.said:
            hole.said = True
            timed += [(hole.after, hole.capture_ns, update) for update in hole.screen]
        if self._encoder is None or not 0 < frame - self._last <= self._continues:
            self._encoder = OverlayEncoder(afresh=True, with_origins=with_origins)
        self._last = frame
        self._encoder.earn(self._credit_bytes)
        self._credit_bytes = 0
        return timed + [(frame, overlay.capture_ns, update) for update in self._encoder.encode(overlay)]


def _ends_after(hole: _Hole, frame_index: int) -> bool:
    return hole.after is None or frame_index < hole.after
