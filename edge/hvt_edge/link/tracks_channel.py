"""The tracks channel at the edge: which steps are sent to the ground, and which of their tracks."""

from __future__ import annotations

from copy import copy
from dataclasses import KW_ONLY, dataclass, replace
from typing import Final

from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import TrackStepEncoder
from hvt_common.units import SECOND_NS
from hvt_edge.link.transmitter import Transmitter
from hvt_edge.perception.analyzer import AnalyzedFrame

_EARLY: Final = 0.95
"""Steps come a little early or late: one that is due nearly counts as due."""


@dataclass(eq=False)
class TrackReporter:
    """Sends tracks to the ground at decision steps."""

    sender: Transmitter
    _: KW_ONLY
    session_id: int
    most_per_s: float = 3.0
    """Most steps a second of capture time."""
    most_bps: int = 12_000
    """Most payload bits a second: in a crowd steps come less often."""
    fresh_frames: int = 5
    """A track whose last detection is more source frames old than this is left out."""
    refresh_ns: int = SECOND_NS
    """Capture time after which a step is coded without reference to earlier ones: a lost step matters no longer."""

    def __post_init__(self) -> None:
        self._encoder = TrackStepEncoder(session_id=self.session_id, refresh_ns=self.refresh_ns)
        self._last_ns: int | None = None
        self._last_bytes = 0

    def report(self, seen: AnalyzedFrame, *, now_ns: int) -> bool:
        """Send this step's tracks if it is a decision step and one is due; tell whether it was sent.

        A step without tracks is sent too: an empty scene is news. ``now_ns`` is the time of the budget's windows.
        """
        capture_ns = seen.frame.capture_ns
        if not seen.detected or not self._due(capture_ns):
            return False
        tracks = seen.tracks
        fresh = tracks.frame_index - tracks.seen_frames <= self.fresh_frames
        encoder = copy(self._encoder)  # the next step builds on the last one that was sent
        step = encoder.encode(tracks.take(fresh), capture_ns=capture_ns)
        if not self.sender.metadata(
            Channel.TRACKS,
            lambda at_ns: replace(step, send_delay_ns=at_ns - capture_ns).pack(),
            now_ns=now_ns,
        ):
            return False
        self._encoder, self._last_ns, self._last_bytes = encoder, capture_ns, len(step.pack())
        return True

    def _due(self, capture_ns: int) -> bool:
        if self._last_ns is None:
            return True
        pause_s = max(1 / self.most_per_s, 8 * self._last_bytes / self.most_bps)
        return capture_ns - self._last_ns >= SECOND_NS * pause_s * _EARLY
