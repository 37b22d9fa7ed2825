"""Messages of sessions that are not shown: those that overtake their beginning, those of a duplicate publisher."""

from __future__ import annotations

from collections import deque

from hvt_common.protocol.messages import PoseReport, RoiHeader, Status
from hvt_common.units import SECOND_NS
from hvt_ground.link.packets import Packet

_MOST_STILLS = _MOST_POSES = 16
_AGAIN_NS = 60 * SECOND_NS
"""Between two warnings: sessions' ids cost a forger nothing, and a log is not to fill."""


class PreSessionBuffer:
    """Holds the first report, the newest stills and the newest poses that came while no session was open."""

    def __init__(self) -> None:
        self._status: list[Packet] = []
        self._stills: deque[Packet] = deque(maxlen=_MOST_STILLS)
        self._poses: deque[Packet] = deque(maxlen=_MOST_POSES)

    def hold(self, packet: Packet) -> None:
        """Note a still, a pose, or the first report of a session: it may overtake the keyframe that begins it."""
        if isinstance(packet.header, RoiHeader):
            self._stills.append(packet)
        elif isinstance(packet.header, PoseReport):
            self._poses.append(packet)
        elif isinstance(packet.header, Status) and packet.header.sequence == 0:
            self._status = [packet]

    def take(self) -> list[Packet]:
        """Hand them out, once: the report, then poses and stills, each in the order in which they came."""
        packets = [*self._status, *self._poses, *self._stills]
        self._status = []
        self._stills.clear()
        self._poses.clear()
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
        """A message of ``other`` came while ``shown`` goes on; return the warning, if it is time for it."""
        self._other = other
        if self._said_ns is not None and now_ns - self._said_ns < _AGAIN_NS:
            return None
        self._said_ns = now_ns
        return (
            f"two edges call themselves {self._edge}: the session {shown:016x} is shown, {other:016x} is not; stop "
            "one of them, or start it with an --edge-id of its own"
        )
