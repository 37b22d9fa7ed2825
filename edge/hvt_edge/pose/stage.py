"""Tells the ground once a second where the camera is; less often where that takes more than 300 bits a second."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import KW_ONLY, dataclass
from typing import Final, Protocol

from hvt_common.protocol.messages import PoseEncoder
from hvt_common.runtime.failures import Failures, reason_of
from hvt_common.units import SECOND_NS
from hvt_edge.pose.contract import PoseSource

_MOST_BPS: Final = 300
"""Payload bits a second."""
_EARLY: Final = 0.97
"""Frames come a little early or late: a report that is due nearly is due."""
_PART: Final = "pose"


class PoseSender(Protocol):
    """The receiver of reports: `hvt_edge.link.transmitter.Transmitter`."""

    def pose(self, make: Callable[[int], bytes], *, now_ns: int) -> bool:
        """Send ``make(now_ns)``; False where the budget has no room for it beside the next frame."""
        ...


@dataclass(eq=False)
class PoseStage:
    """One step a frame, in the frame loop."""

    source: PoseSource
    _: KW_ONLY
    session_id: int
    sender: PoseSender
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
        try:
            pose = self.source.at(media_ns, capture_ns=capture_ns)
            make = None if pose is None else encoder.encode(pose)
        except Exception as error:  # noqa: BLE001 - what an autopilot says ends no flight, whatever it is
            self.failures.failed(_PART, reason_of(error))
            return
        if make is None:
            self.failures.failed(_PART, self.source.trouble)
            return
        self.failures.works(_PART)
        if not self.sender.pose(lambda at_ns: make(at_ns).pack(), now_ns=now_ns):
            self._due_ns = None  # the next frame tries again
            return
        self._encoder = encoder
        pause_s = max(1.0, 8 * len(make(now_ns).pack()) / _MOST_BPS)
        self._due_ns = capture_ns + round(_EARLY * pause_s * SECOND_NS)
