"""What a recording holds that was read back, for those that write it in another form."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from hvt_common.errors import UserError
from hvt_common.protocol.messages import Info, RoiHeader
from hvt_common.video.hevc import parameter_sets
from hvt_ground.events import Notice, Overlay, PoseUpdate, VideoSample
from hvt_ground.poses import Locator, PoseTrail


@dataclass(frozen=True, slots=True)
class RecordedStill:
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
    locator: Locator
    """What places its tracks."""

    @cached_property
    def trail(self) -> PoseTrail:
        """All poses."""
        trail = PoseTrail(most=len(self.poses))
        for one in self.poses:
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
        raise UserError(f"the recording of {self.edge} has no video: it was removed, or none came")

    def all(self) -> Iterator[VideoSample | Overlay | RecordedStill | Notice | PoseUpdate]:
        """All of it, in order of frames; of a frame the picture comes first."""
        streams = (self.video, self.overlays(), self.stills, self.notices, self.poses)
        return heapq.merge(*streams, key=lambda one: one.frame_index)
