"""Which numbers have been, in any order and in bounded memory: frames in a recording, stills that came."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable

__all__ = ["SequenceWindow"]

_PAGE_BITS = 12


class SequenceWindow:
    """A set of numbers from 0, one bit each. What was missed long ago may still come, and is known to be new.

    Args:
        pages: how many stretches of 4096 numbers are kept, half a kilobyte each; beyond, the one that nobody came to
            for the longest is forgotten. So forged numbers, however many, cost memory up to that, and do not make
            anything that is to come look as if it had been.
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

    def __contains__(self, number: int) -> bool:
        """Whether it has been, as far as is remembered."""
        return bool(self._pages.get(number >> _PAGE_BITS, 0) >> (number & (1 << _PAGE_BITS) - 1) & 1)
