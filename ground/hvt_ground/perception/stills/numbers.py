"""Which stills of a session have come, on whichever way: each is shown once, and counted as often as it crossed."""

from __future__ import annotations

from hvt_ground.link.sequence_window import SequenceWindow

__all__ = ["StillSequenceWindow"]

_MOST_SENT = 512
"""Stills whose second copy is still known for one: those of the last seconds."""
_NEVER_NS = -(2**64)
"""When a still was sent that has come with what was kept only."""


class StillSequenceWindow:
    """For the receiving thread."""

    def __init__(self) -> None:
        self._seen = SequenceWindow()
        self._sent_ns: dict[int, int] = {}
        """Sequence → when a still was sent of which no second copy has come."""

    def is_new(self, sequence: int, *, send_ns: int) -> bool:
        """Whether a still on ``roi`` has not come before."""
        if not self._seen.add([sequence]):
            return False
        self._note(sequence, send_ns)
        return True

    def is_copy(self, sequence: int, *, send_ns: int) -> bool:
        """Whether one that is not new is the copy that the edge sent for want of an acknowledgement; once.

        What bears the time of the first is somebody's who repeats what he heard. Of one that came with what was kept,
        the first on ``roi`` is such a copy.
        """
        if send_ns <= self._sent_ns.get(sequence, send_ns):
            return False
        del self._sent_ns[sequence]
        return True

    def is_new_stored(self, sequence: int) -> bool:
        """Whether a still that was kept has not come before."""
        return self.is_new(sequence, send_ns=_NEVER_NS)

    def _note(self, sequence: int, send_ns: int) -> None:
        self._sent_ns[sequence] = send_ns
        while len(self._sent_ns) > _MOST_SENT:
            del self._sent_ns[next(iter(self._sent_ns))]
