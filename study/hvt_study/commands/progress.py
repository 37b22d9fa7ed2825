"""How far a study is: a bar on a terminal; elsewhere a line at once, one with the first estimate, one a minute.

The first line comes also while what is measured is still opened.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from datetime import timedelta
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

_LINE_EVERY_S = 60
_FIRST_LINE_S = 1.0
"""What cannot be done at all says so sooner."""
_SOON_S = 30.0
"""Nearer to the end seconds are not told: the last runs, which end as they will, are all of it."""
_REMEMBERED = 64
_LEAST = 4


class RunProgress:
    """Of ``what``, such as runs. The time left is told by how fast the last ones were done."""

    def __init__(self, what: str, *, first_line_s: float = _FIRST_LINE_S) -> None:
        self._what = what
        self._first_line_s = first_line_s
        self._console = Console(stderr=True, highlight=False)
        self._began_s = self._said_s = time.monotonic()
        self._said = self._estimated = False
        self._steps: deque[tuple[float, int]] = deque([(self._began_s, 0)], maxlen=_REMEMBERED)
        """(time, done); the first is that of the first one done: what begins a study is done once."""
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[more]}"),
            console=self._console,
            transient=True,
        )
        self._task = self._bar.add_task(what, total=None, more="")
        self._lock = threading.Lock()
        self._first_line = threading.Timer(first_line_s, self._say_first)
        self._first_line.daemon = True

    def update(self, done: int, of: int, left_s: float | None = None, *, failed: int = 0) -> None:
        """So many are done, of so many; ``left_s`` where the time left is known better than by how fast they were."""
        now_s = time.monotonic()
        if not self._steps[0][1] and done:
            self._steps.clear()
        if not self._steps or done != self._steps[-1][1]:
            self._steps.append((now_s, done))
        more = self._more(time_left_s(self._steps, of) if left_s is None else left_s, failed)
        self._bar.update(self._task, completed=done, total=of, more=more)
        news = (bool(more) and not self._estimated) or done == of
        with self._lock:
            first = not self._said and now_s - self._began_s >= self._first_line_s
            if not self._console.is_terminal and (news or first or now_s - self._said_s >= _LINE_EVERY_S):
                self._said, self._estimated, self._said_s = True, self._estimated or bool(more), now_s
                gone = timedelta(seconds=round(now_s - self._began_s))
                self.note(f"{self._what}: {done} of {of} in {gone}" + f", {more}" * bool(more))

    def note(self, text: str) -> None:
        """Say something that stays."""
        self._console.print(text, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._bar.start()
        else:
            self._first_line.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._first_line.cancel()
        if self._console.is_terminal:
            self._bar.stop()

    def _say_first(self) -> None:
        with self._lock:
            if not self._said:
                self._said, self._said_s = True, time.monotonic()
                self.note(f"{self._what}: opening what they need")

    def _more(self, left_s: float, failed: int) -> str:
        words = [f"{failed} failed"] if failed else []
        if left_s:
            amount = (
                f"about {timedelta(seconds=round(left_s))}" if left_s >= _SOON_S else "less than a minute"
            )
            words.append(f"{amount} left")
        return ", ".join(words)


def time_left_s(steps: deque[tuple[float, int]], of: int) -> float:
    """From (time, done) of the last steps, oldest first, to the end; 0 where it is not known yet, or nothing is left.

    Processes that begin together end together: of fewer than `_LEAST` steps nothing is concluded.
    """
    (first_s, first), (last_s, last) = steps[0], steps[-1]
    return (last_s - first_s) / (last - first) * (of - last) if last - first >= _LEAST else 0.0
