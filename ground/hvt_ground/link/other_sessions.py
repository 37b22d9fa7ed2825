"""Messages of sessions that are not shown: those that overtake their beginning, those of a duplicate publisher."""

from __future__ import annotations

from collections import deque

from hvt_common.units import SECOND_NS
from hvt_ground.link.packets import StatusPacket, StillPacket

__all__ = ["DuplicatePublishers", "PreSessionBuffer"]

_MOST_STILLS = 16
_AGAIN_NS = 60 * SECOND_NS
"""Between two warnings: sessions' ids cost a forger nothing, and a log is not to fill."""


class PreSessionBuffer:
    """Holds the first report and the newest stills that came while no session was open."""

    def __init__(self) -> None:
        self._status: StatusPacket | None = None
        self._stills: deque[StillPacket] = deque(maxlen=_MOST_STILLS)

    def status(self, packet: StatusPacket) -> None:
        """Note a report, if it is the first of its session: it may overtake the keyframe that begins it."""
        if packet.status.sequence == 0:
            self._status = packet

    def still(self, packet: StillPacket) -> None:
        """Note a still; of many the oldest goes."""
        self._stills.append(packet)

    def take(self) -> list[StatusPacket | StillPacket]:
        """Hand them out, once: the report, then the stills in the order in which they came."""
        packets: list[StatusPacket | StillPacket] = [] if self._status is None else [self._status]
        packets += self._stills
        self._status = None
        self._stills.clear()
        return packets


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
