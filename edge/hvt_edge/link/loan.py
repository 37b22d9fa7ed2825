"""A requested still borrows from the video for a second or two: frames are left out before they are coded.

In a window of the budget's bytes a still of N bytes has room once N bytes of video have left it, so no frame is
coded while one waits. After it, for as long as it is in the window, the video has N bytes less: every so many frames
one is left out, evenly, in place of a second hole where the window is full. Requested stills never take more than
`MOST_SHARE` of a window in all, and for one that does not go within `_PATIENCE` windows the video goes on for as long
before it is tried again: who may command cannot stop the video.
"""

from __future__ import annotations

from collections import deque

MOST_SHARE = 0.8
"""Share of a window for requested stills; the rest is for status, tracks, pose and the remaining video."""
_PATIENCE = 2
"""Windows for which frames are left out for a still that waits."""


class VideoLoan:
    """Pure: time is an argument. One still at a time is waited for."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._wanted: tuple[int, int] | None = None
        """(line bytes, since when)."""
        self._taken: deque[tuple[int, int]] = deque()
        """(time, line bytes) of the requested stills of the last window."""
        self._due = 0.0
        """Part of a frame that is due to be left out since the last one was."""

    def want(self, line_bytes: int, *, now_ns: int) -> None:
        """A requested still of about so many line bytes waits for room; said again, only its size is new."""
        since_ns = now_ns if self._wanted is None else self._wanted[1]
        self._wanted = line_bytes, since_ns

    def withdraw(self) -> None:
        """None waits any more."""
        self._wanted = None

    def take(self, line_bytes: int, *, now_ns: int) -> None:
        """A requested still goes out."""
        self._wanted = None
        self._taken.append((now_ns, line_bytes))

    def left_bytes(self, window_bytes: float, *, now_ns: int) -> float:
        """Bytes that requested stills may still take of the window that ends now."""
        return MOST_SHARE * window_bytes - self._taken_bytes(now_ns)

    def waits(self, window_bytes: float, *, now_ns: int) -> bool:
        """Whether one waits for which frames are to be left out."""
        if self._wanted is None:
            return False
        line_bytes, since_ns = self._wanted
        patience_ns = _PATIENCE * self._window_ns
        in_time = (now_ns - since_ns) % (2 * patience_ns) <= patience_ns
        return in_time and line_bytes <= self.left_bytes(window_bytes, now_ns=now_ns)

    def leaves_out(self, window_bytes: float, *, now_ns: int) -> bool:
        """Whether the frame that is due now is left out; asked once for each that would else be coded."""
        if self.waits(window_bytes, now_ns=now_ns):
            return True
        share = self._taken_bytes(now_ns) / window_bytes
        self._due = self._due + share if share else 0.0
        if self._due < 1:
            return False
        self._due -= 1
        return True

    def _taken_bytes(self, now_ns: int) -> int:
        while self._taken and self._taken[0][0] <= now_ns - self._window_ns:
            self._taken.popleft()
        return sum(size for _, size in self._taken)
