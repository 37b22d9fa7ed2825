"""What overtakes the beginning of its session: asking the edge about a new one takes a while, and messages go on."""

from __future__ import annotations

from collections import deque

from hvt_common.protocol.messages import RoiHeader, Status
from hvt_common.transport.inbox import Received

__all__ = ["PreSessionBuffer"]

_MOST_STILLS = 16


class PreSessionBuffer:
    """Holds the first report and the newest stills that came while no session was open."""

    def __init__(self) -> None:
        self._status: tuple[Status, Received] | None = None
        self._stills: deque[tuple[RoiHeader, Received]] = deque(maxlen=_MOST_STILLS)

    def status(self, status: Status, item: Received) -> None:
        """Note a report, if it is the first of its session: it may overtake the keyframe that begins it."""
        if status.sequence == 0:
            self._status = (status, item)

    def still(self, header: RoiHeader, item: Received) -> None:
        """Note a still; of many the oldest goes."""
        self._stills.append((header, item))

    def take_status(self) -> tuple[Status, Received] | None:
        """Hand out the report, once."""
        status, self._status = self._status, None
        return status

    def take_stills(self) -> list[tuple[RoiHeader, Received]]:
        """Hand out the stills, once, in the order in which they came."""
        stills = list(self._stills)
        self._stills.clear()
        return stills
