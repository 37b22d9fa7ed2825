"""A recording as the messages that it came in: video, stills and poses.

The edge's own tracks are not among them: a recording has the ground's list, in which they are part.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, count

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import BaseHeader, Flags, PoseEncoder, RoiHeader
from hvt_common.transport.inbox import Received
from hvt_common.video.hevc import parameter_sets
from hvt_ground.events import PoseUpdate, VideoSample
from hvt_ground.recordings.contract import Recorded, RecordedStill

_OF_EVERY_POSE = 0
"""Each report stands by itself, so that none is lost with another."""


def messages_of(recorded: Recorded) -> Iterator[Received]:
    """The messages in the order in which they were known, the session's first; times are capture times.

    Each is made when it is its turn. Stills are the JPEGs of the recording. Raises `UserError` where that does not
    say what session it is of.
    """
    info = recorded.info
    if info is None:
        raise UserError(
            f"the recording of {recorded.edge} does not hold what its edge said of the session, as those of an "
            "earlier HVT: it can be exported, not played"
        )
    make = _Messages(info.edge, info.session_id)
    begins_ns = recorded.video[0].capture_ns if recorded.video else 0
    first = Received(make.keys.key(Channel.INFO), info.pack(), b"", "", begins_ns)
    # Of one frame the pose is known first, and a still last.
    streams = (
        map(make.pose, recorded.poses),
        map(make.unit, recorded.video),
        (make.still(one, one.header) for one in recorded.stills if one.header is not None),
    )
    return chain([first], heapq.merge(*streams, key=lambda one: one.received_ns))


class _Messages:
    """Makes the messages of one session."""

    def __init__(self, edge: str, session_id: int) -> None:
        self.keys = EdgeKeys(edge)
        self._session_id = session_id
        self._units: Iterator[int] = count()
        self._poses = PoseEncoder(session_id=session_id, refresh_ns=_OF_EVERY_POSE)

    def pose(self, update: PoseUpdate) -> Received:
        """A report of a pose."""
        report = self._poses.encode(update.pose)(update.capture_ns)
        return Received(self.keys.key(Channel.POSE), report.pack(), b"", "", update.capture_ns)

    def unit(self, sample: VideoSample) -> Received:
        """An access unit; those that never came are missed by their frames alone."""
        flags = Flags.LOCKSTEP
        if sample.keyframe:
            flags |= Flags.KEYFRAME
        if parameter_sets(sample.data):
            flags |= Flags.PARAMETER_SETS
        header = BaseHeader(
            session_id=self._session_id,
            sequence=next(self._units),
            frame_index=sample.frame_index,
            capture_ns=sample.capture_ns,
            send_delay_ns=0,
            flags=flags,
        )
        key = self.keys.key(Channel.BASE)
        return Received(key, sample.data, header.pack(sample.data), "video/h265", sample.capture_ns)

    def still(self, still: RecordedStill, header: RoiHeader) -> Received:
        """A still, at the time at which it was known; one that was stored has its picture here."""
        live = replace(header, flags=header.flags & ~Flags.STORED)
        key = self.keys.key(Channel.ROI)
        return Received(key, still.jpeg, live.pack(still.jpeg), "image/jpeg", still.capture_ns)
