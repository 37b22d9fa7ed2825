"""Two edges of one id at the same time: what is said of it; the reassembly decides which is shown. Pure."""

from __future__ import annotations

__all__ = ["DuplicatePublishers"]

_SECOND_NS = 1_000_000_000
_AGAIN_NS = 60 * _SECOND_NS
"""Between two warnings: sessions' ids cost a forger nothing, and a log is not to fill."""


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
