"""The camera's pose: the contract of a source of poses, the opener of extras' sources, reports to the ground."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import KW_ONLY, dataclass, replace
from typing import Final, Protocol, cast

from hvt_common.errors import UserError, not_installed
from hvt_common.geodesy import interpolate
from hvt_common.protocol.channels import Channel
from hvt_common.protocol.messages import PoseEncoder, PoseReport
from hvt_common.runtime.failures import Failures
from hvt_common.runtime.plug_ins import loaded, the_one
from hvt_common.units import SECOND_NS
from hvt_common.values import Pose
from hvt_edge.link.transmitter import Transmitter

_GROUP: Final = "hvt.poses"
_FILE: Final = "file"
"""The entry point for every ``--pose`` whose word names no other."""
_WHAT: Final = "pose source"
MOST_GAP_S: Final = 10.0
_MUCH_LONGER: Final = 1.1
_BEYOND_NS: Final = SECOND_NS
"""How long before the first pose and after the last one they still count."""
_MOST_BPS: Final = 300
"""Payload bits a second: a report a second, less often where that takes more."""
_EARLY: Final = 0.97
"""Frames come a little early or late: a report that is due nearly counts as due."""
_PART: Final = "pose"


class PoseSource(Protocol):
    """Opened once; closed with the edge."""

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:
        """The pose of a frame; None where it is not known. Quick: called in the frame loop.

        ``media_ns`` counts from the source's first frame; ``capture_ns`` is the frame's, and becomes the pose's.
        """
        ...

    @property
    def trouble(self) -> str:
        """The reason why there is no pose now; empty where there is one, or none is expected."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """The guesses made at its opening, and their reasons: a sentence each."""
        ...

    def close(self) -> None: ...


class OpenPose(Protocol):
    """An entry point of the group ``hvt.poses``; its name is the word before the colon of ``--pose``."""

    def __call__(self, spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:
        """Open ``spec``, or raise `UserError`; ``hfov_deg`` is used where the source gives no field of view."""
        ...


def open_pose(spec: str, *, hfov_deg: float | None, clock: Callable[[], int]) -> PoseSource:
    """Open ``--pose`` by the extra that knows it; see `OpenPose`."""
    word = spec.partition(":")[0]
    names = (word, _FILE)
    entry = next(filter(None, (the_one(_GROUP, one, what=_WHAT, built_in=False) for one in names)), None)
    if entry is None:
        raise not_installed(f"--pose {spec:.200}", "hvt[edge]")
    opened = cast("OpenPose", loaded(entry, lambda it: it, what=_WHAT))
    return opened(spec, hfov_deg=hfov_deg, clock=clock)


class PoseTable:
    """``poses`` in order of time, at least one; their ``capture_ns`` counts from the clip's first frame."""

    def __init__(
        self, poses: Sequence[Pose], *, most_gap_s: float = MOST_GAP_S, notes: tuple[str, ...] = ()
    ) -> None:
        self.notes = notes
        self._poses = poses
        self._times = [one.capture_ns for one in poses]
        self._most_gap_ns = round(most_gap_s * SECOND_NS)
        self.trouble = ""

    def compare(self, *, clip_s: float) -> None:
        """Note that the poses go on long after a clip's end: they are another flight's, or begin before it."""
        end_s = self._times[-1] / SECOND_NS
        if end_s > max(clip_s + MOST_GAP_S, _MUCH_LONGER * clip_s):
            ends = f"they end at {end_s:.0f} s, the clip at {clip_s:.0f} s"
            self.notes += (f"{ends}: are they this clip's, and is their time 0 its first frame?",)

    def at(self, media_ns: int, *, capture_ns: int) -> Pose | None:
        """The pose at this moment of the clip, between the two around it; None in a gap or beyond the ends."""
        pose = self._at(media_ns)
        self.trouble = "" if pose else f"the pose file has nothing at {media_ns / SECOND_NS:.0f} s"
        return None if pose is None else replace(pose, capture_ns=capture_ns)

    def _at(self, media_ns: int) -> Pose | None:
        after = bisect_right(self._times, media_ns)
        if 0 < after < len(self._poses):
            first, second = self._poses[after - 1], self._poses[after]
            if second.capture_ns - first.capture_ns <= self._most_gap_ns:
                return interpolate(first, second, media_ns)
        nearest = self._poses[max(0, after - 1)]
        return nearest if abs(nearest.capture_ns - media_ns) <= _BEYOND_NS else None

    def close(self) -> None:
        """Nothing is open."""


@dataclass(eq=False)
class PoseStage:
    """One step a frame, in the frame loop."""

    source: PoseSource
    _: KW_ONLY
    session_id: int
    sender: Transmitter
    failures: Failures

    def __post_init__(self) -> None:
        self._encoder = PoseEncoder(session_id=self.session_id)
        self._due_ns: int | None = None

    def step(self, media_ns: int, *, capture_ns: int, now_ns: int) -> None:
        """Report the pose of a frame where one is due; ``media_ns`` counts from the source's first frame."""
        if self._due_ns is not None and capture_ns < self._due_ns:
            return
        self._due_ns = capture_ns + round(_EARLY * SECOND_NS)
        encoder = copy(self._encoder)  # the next report builds on the last one that was sent

        def encoded() -> Callable[[int], PoseReport] | None:
            pose = self.source.at(media_ns, capture_ns=capture_ns)
            if pose is None and self.source.trouble:
                raise UserError(self.source.trouble)
            return None if pose is None else encoder.encode(pose)

        # No value from an autopilot may end a flight.
        make = self.failures.attempt(_PART, encoded, None)
        if make is None:
            return
        if not self.sender.metadata(Channel.POSE, lambda at_ns: make(at_ns).pack(), now_ns=now_ns):
            self._due_ns = None  # the next frame tries again
            return
        self._encoder = encoder
        pause_s = max(1.0, 8 * len(make(now_ns).pack()) / _MOST_BPS)
        self._due_ns = capture_ns + round(_EARLY * pause_s * SECOND_NS)
