"""Messages of sessions that are not shown: those that overtake their beginning, those of a duplicate publisher."""

from __future__ import annotations

from collections import deque

from hvt_common.protocol.messages import RoiHeader, Status
from hvt_common.transport.inbox import Received

__all__ = ["DuplicatePublishers", "PreSessionBuffer"]

_MOST_STILLS = 16
_SECOND_NS = 1_000_000_000
_AGAIN_NS = 60 * _SECOND_NS
"""Between two warnings: sessions' ids cost a forger nothing, and a log is not to fill."""


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


class DuplicatePublishers:
    """Notes the sessions of a second edge with the id of ``edge``."""

    def __init__(self, edge: str) -> None:
        self._edge = edge
        self._other: int | None = None
        self._said_ns: int | None = None

    def knows(self, session_id: int) -> bool:
        """Whether this is the one noted last, of which enough has been said."""
        return session_id == self._other

    def note(self, other: int, *, shown: int, now_ns: int) -> str | None:
        """A message of ``other`` came while ``shown`` goes on; return what to say of it, if it is time to."""
        self._other = other
        if self._said_ns is not None and now_ns - self._said_ns < _AGAIN_NS:
            return None
        self._said_ns = now_ns
        return (
            f"two edges call themselves {self._edge}: the session {shown:016x} is shown, {other:016x} is not; stop "
            "one of them, or start it with an --edge-id of its own"
        )
