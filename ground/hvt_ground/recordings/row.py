"""The index's row of one file of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from hvt_common.runtime.statistics import Newest
from hvt_ground.events import Event, Overlay, Refinement, VideoSample

_MOST_REMEMBERED = 4096
"""Tracks and stills that are known again; one that comes back after so many others counts twice."""
_LATEST_NS = 2**63 - 1


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """A file; times are Unix nanoseconds."""

    file: str
    """Its name in the folder."""
    edge: str
    session: str
    """Hexadecimal."""
    begin_ns: int | None
    """Capture time of the first picture, report or still, by the edge's clock; None before there is one."""
    end_ns: int | None
    """Capture time of the last frame."""
    written_ns: int
    """When it was written to last: its age counts from there. `IndexWriter` says it, and moves it with the clock."""
    size_bytes: int
    frames: int
    """Access units."""
    stills: int
    classes: Mapping[str, int] = field(default_factory=dict)
    """Tracks that had the class, as refined."""
    backlog: bool = False
    """Objects of an outage, of the time of another file or of a session that was over."""
    video: bool = True
    """False once the video was removed."""
    whole: bool = False
    """It was closed; otherwise it is written to, or its program was killed."""


class FileAccount:
    """Gathers a `RecordingRow` from the events that go into a file. Its memory is bounded."""

    def __init__(self, *, backlog: bool = False) -> None:
        self.backlog = backlog
        self.begin_ns: int | None = None
        self.end_ns: int | None = None
        self.stills = 0
        self.classes: dict[str, int] = {}
        self._tracks: Newest[tuple[int, str], None] = Newest(_MOST_REMEMBERED)
        self._stills: Newest[int, None] = Newest(_MOST_REMEMBERED)

    def note(self, event: Event) -> None:
        """Count an event."""
        match event:
            case Overlay():
                rows = zip(event.track_ids.tolist(), event.classes, event.doubted.tolist(), strict=True)
                for track, name, doubted in rows:
                    if not doubted:
                        self.track(track, name)
                self.span(event.capture_ns)
            case Refinement():
                self.still(event.still_sequence)
                self.span(event.capture_ns)
            case VideoSample():
                self.span(event.capture_ns)

    def span(self, capture_ns: int) -> None:
        """Something is of this time, which comes from the wire: a time that no timestamp can hold is clamped."""
        at_ns = min(max(capture_ns, 0), _LATEST_NS)
        self.begin_ns = at_ns if self.begin_ns is None else min(self.begin_ns, at_ns)
        self.end_ns = at_ns if self.end_ns is None else max(self.end_ns, at_ns)

    def track(self, track_id: int, name: str) -> None:
        """A track is shown as of that class."""
        if self._tracks.put((track_id, name), None):
            self.classes[name] = self.classes.get(name, 0) + 1

    def still(self, sequence: int) -> None:
        """A still of that number is in the file, for one object or several."""
        self.stills += self._stills.put(sequence, None)
