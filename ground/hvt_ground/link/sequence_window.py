"""Remembers received numbers, in any order and in bounded memory: frames in a recording, stills that came."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterable

_PAGE_BITS = 12
_MOST_SENT = 512
"""Stills whose second copy is still known for one: those of the last seconds."""
_NEVER_NS = -(2**64)
"""When a still was sent that has come with the backlog only."""


class SequenceWindow:
    """A set of numbers from 0, one bit each. What was missed long ago may still come, and is known to be new.

    At most ``pages`` stretches of 4096 numbers are stored, half a kilobyte each; beyond, the one longest unused is
    forgotten. So forged numbers cost bounded memory, and do not make what is to come look as if it had been.
    """

    def __init__(self, *, pages: int = 4096) -> None:
        self._most = pages
        self._pages: OrderedDict[int, int] = OrderedDict()
        """The one that was touched last stands last."""
        self.count = 0

    def add(self, numbers: Iterable[int]) -> int:
        """Take numbers; return how many of them are new."""
        before = self.count
        for number in numbers:
            page, bit = number >> _PAGE_BITS, 1 << (number & (1 << _PAGE_BITS) - 1)
            held = self._pages.get(page, 0)
            self._pages[page] = held | bit
            self._pages.move_to_end(page)
            self.count += not held & bit
            if len(self._pages) > self._most:
                self._pages.popitem(last=False)
        return self.count - before

    def discard(self, number: int) -> None:
        """Take a number out again."""
        if number in self:
            self._pages[number >> _PAGE_BITS] ^= 1 << (number & (1 << _PAGE_BITS) - 1)
            self.count -= 1

    def __contains__(self, number: int) -> bool:
        """Whether it has been, as far as is remembered."""
        return bool(self._pages.get(number >> _PAGE_BITS, 0) >> (number & (1 << _PAGE_BITS) - 1) & 1)


class StillSequenceWindow:
    """The received stills: each is shown once, and counted as often as it crossed. Safe for threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seen = SequenceWindow()
        self._sent_ns: dict[int, int] = {}
        """Sequence → when a still was sent of which no second copy has come."""

    def is_new(self, sequence: int, *, send_ns: int) -> bool:
        """Whether a still on ``roi`` has not come before."""
        with self._lock:
            if not self._seen.add([sequence]):
                return False
            self._sent_ns[sequence] = send_ns
            while len(self._sent_ns) > _MOST_SENT:
                del self._sent_ns[next(iter(self._sent_ns))]
            return True

    def is_copy(self, sequence: int, *, send_ns: int) -> bool:
        """Whether one that is not new is the copy that the edge sent for want of an acknowledgement; once.

        What bears the time of the first is a replay. Of one that came with the backlog, the first on ``roi`` is such
        a copy.
        """
        with self._lock:
            if send_ns <= self._sent_ns.get(sequence, send_ns):
                return False
            del self._sent_ns[sequence]
            return True

    def is_new_stored(self, sequence: int) -> bool:
        """Whether a still of the backlog has not come before."""
        return self.is_new(sequence, send_ns=_NEVER_NS)

    def forget(self, sequence: int) -> None:
        """One was lost on its way into a file: it is new when it comes again."""
        with self._lock:
            self._seen.discard(sequence)
            self._sent_ns.pop(sequence, None)
