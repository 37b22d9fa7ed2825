"""The index's row of one file of a recording.

`Recorded` holds the content of a recording that was read back, for exports in other forms.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info, RoiHeader
from hvt_common.runtime.statistics import Newest
from hvt_common.video.hevc import parameter_sets
from hvt_ground.events import Event, Notice, Overlay, PoseUpdate, Refinement, Shown, VideoSample
from hvt_ground.poses import Locator, PoseTrail

_MOST_REMEMBERED = 4096
"""The most tracks and stills that are known again; one that comes back after as many others counts twice."""
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
        if self._tracks.put((track_id, name), None):
            self.classes[name] = self.classes.get(name, 0) + 1

    def still(self, sequence: int) -> None:
        """A still of that number is in the file, for one object or several."""
        self.stills += self._stills.put(sequence, None)


@dataclass(frozen=True, slots=True)
class RecordedStill(Shown):
    """A still as the recording shows it."""

    frame_index: int
    """At which it was known."""
    capture_ns: int
    jpeg: bytes
    base_jpeg: bytes
    """The base crop of it; empty if the recording has none."""
    caption: str
    """``17  car → van .93``; empty where it was never on the screen."""
    header: RoiHeader | None = None
    """The `RoiHeader` of ``jpeg``; None if the recording has none."""


@dataclass(frozen=True)
class Recorded(ABC):
    """One session, from one file or from several that follow each other; pictures and boxes stay on disk."""

    edge: str
    session: str
    info: Info | None
    """The edge's facts of the session; None in a recording of an earlier HVT."""
    video: Sequence[VideoSample]
    """The video in order of frames."""
    stills: Sequence[RecordedStill]
    notices: Sequence[Notice]
    poses: Sequence[PoseUpdate]
    """In order of frames."""
    locator: Locator
    """Gives its tracks places on the map."""

    @cached_property
    def trail(self) -> PoseTrail:
        trail = PoseTrail(most=len(self.poses))
        for one in sorted(self.poses, key=lambda one: one.capture_ns):  # a clock may have been set back
            trail.add(one.pose)
        return trail

    @abstractmethod
    def overlays(self) -> Iterator[Overlay]:
        """The boxes at each frame that has a picture or at which boxes changed, in order of frames."""

    def decodable_video(self) -> Sequence[VideoSample]:
        """The samples from the first that can be decoded on; `UserError` where there is none."""
        for number, one in enumerate(self.video):
            if one.keyframe and parameter_sets(one.data):
                return self.video[number:]
        raise UserError(
            f"the recording of {self.edge} has no video: it was removed, none came, or the file breaks off"
        )

    def all(self) -> Iterator[VideoSample | Overlay | RecordedStill | Notice | PoseUpdate]:
        """All of it, in order of frames; of a frame the picture comes first."""
        streams = (self.video, self.overlays(), self.stills, self.notices, self.poses)
        return heapq.merge(*streams, key=lambda one: one.frame_index)
