"""The output of commands: on the terminal, also while they work, and in ``--out``."""

import threading
import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from hvt_common.errors import FlightError, UserError, telling
from hvt_common.files import locked
from hvt_common.runtime.reporting import check_writable, say

ONE_TARGET = "one target is labelled, all else that is in view is not: recall alone can be said"
_WIDTH = 100
_LINE_EVERY_S = 60
_FIRST_LINE_S = 1.0
"""An impossible command fails sooner."""
_SOON_S = 45.0
"""Nearer to the end seconds are not told: the last runs, which end as they will, are all of it."""
_REMEMBERED = 64
_LEAST = 4


def print_columns(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    words: Collection[str],
    gap: int = 0,
    caption: str | None = None,
) -> None:
    """Print a table; the columns of these heads hold ``words``, the others figures, flush right.

    Without a ``gap`` between its columns it has a frame.
    """
    frame: dict[str, Any] = {"box": None, "padding": (0, gap, 0, 0), "pad_edge": False} if gap else {}
    table = Table(title=title, title_justify="left", title_style="bold", caption=caption, **frame)
    table.caption_justify = "left"
    for head in heads:
        word = head in words
        side: Literal["left", "right"] = "left" if word else "right"
        table.add_column(head, justify=side, style="cyan" if word else None, no_wrap=bool(gap))
    for row in rows:
        table.add_row(*row)
    _console().print(table)


def print_lines(*lines: str) -> None:
    """Print text as it is, whatever its length."""
    for line in lines:
        _console().print(line, soft_wrap=True)


def decimals(value: float | None, digits: int = 3) -> str:
    """A figure, a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def share(value: float | None, digits: int = 3) -> str:
    """The same of a number from 0 to 1, without its 0."""
    return decimals(value, digits).replace("0.", ".", 1)


def check_out(folder: Path, *, name: str) -> Path:
    """The file of that name in ``--out``; `UserError` now where it could not be written later. Leaves nothing."""
    with telling(f"--out {folder} cannot be made (", "): name a folder"):
        fresh = [one for one in (folder, *folder.parents) if not one.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder / name, name="--out")
    with suppress(OSError):  # another study writes there
        for one in fresh:
            one.rmdir()
    return folder / name


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Make ``--out``; within it, a failed write is a `UserError` that names it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except (OSError, FlightError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        why = cause.strerror if isinstance(cause, OSError) else error
        raise UserError(f"--out {folder} cannot be written ({why}): name another") from None


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Of studies that write into one folder one reads and writes at a time; in one that is not there nobody does."""
    with ExitStack() as lock:
        if folder.is_dir():
            with telling(f"{folder} cannot be written (", "): name another folder"):
                wait = f"another study writes into {folder}: waiting for it"
                lock.enter_context(locked(folder / ".lock", lambda: say(wait)))
        yield


class RunProgress:
    """How far ``what``, such as runs, is; the time left is told by how fast the last ones were done.

    A bar on a terminal. Elsewhere a line at once, also while inputs are still opened, one with the first
    estimate, and one a minute, also while none is done.
    """

    def __init__(
        self, what: str, *, first_line_s: float = _FIRST_LINE_S, line_every_s: float = _LINE_EVERY_S
    ) -> None:
        self._what = what
        self._first_line_s, self._line_every_s = first_line_s, line_every_s
        self._console = Console(stderr=True, highlight=False)
        self._began_s = self._said_s = time.monotonic()
        self._said = self._estimated = False
        self._done = self._of = self._failed = 0
        self._steps: deque[tuple[float, int]] = deque([(self._began_s, 0)], maxlen=_REMEMBERED)
        """(time, done); the first is that of the first one done: the start of a study happens once."""
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
        self._ended = threading.Event()
        self._clock = threading.Thread(target=self._say_now_and_then, name="progress", daemon=True)

    def update(self, done: int, of: int, *, alike: bool = True, failed: int = 0) -> None:
        """So many are done; where the last was not ``alike``, it says nothing of the time of those that are left."""
        with self._lock:
            now_s = time.monotonic()
            if not alike or (done and not self._steps[0][1]):
                self._steps.clear()
            if not self._steps or done != self._steps[-1][1]:
                self._steps.append((now_s, done))
            self._done, self._of, self._failed = done, of, failed
            more = self._more(now_s)
            self._bar.update(self._task, completed=done, total=of, more=more)
            news = (bool(more) and not self._estimated) or done == of
            first = not self._said and now_s - self._began_s >= self._first_line_s
            if not self._console.is_terminal and (
                news or first or now_s - self._said_s >= self._line_every_s
            ):
                self._say(now_s)

    def note(self, text: str) -> None:
        self._console.print(text, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._bar.start()
        else:
            self._clock.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._ended.set()
        if self._console.is_terminal:
            self._bar.stop()
        else:
            self._clock.join()

    def _say_now_and_then(self) -> None:
        wait_s = self._first_line_s
        while not self._ended.wait(wait_s):
            with self._lock:
                now_s = time.monotonic()
                if not self._said or now_s - self._said_s >= self._line_every_s:
                    self._say(now_s)
                wait_s = self._said_s + self._line_every_s - now_s

    def _say(self, now_s: float) -> None:
        more = self._more(now_s)
        self._said, self._estimated, self._said_s = True, self._estimated or bool(more), now_s
        gone = timedelta(seconds=round(now_s - self._began_s))
        far = f"{self._done} of {self._of} in {gone}" if self._of else "opening what they need"
        self.note(f"{self._what}: {far}" + f", {more}" * bool(more))

    def _more(self, now_s: float) -> str:
        left_s = time_left_s(self._steps, self._of, now_s)
        words = [f"{self._failed} failed"] if self._failed else []
        if left_s:
            soon = left_s < _SOON_S
            words.append(
                f"{'less than a minute' if soon else f'about {timedelta(seconds=round(left_s))}'} left"
            )
        return ", ".join(words)


def time_left_s(steps: deque[tuple[float, int]], of: int, now_s: float) -> float:
    """From (time, done) of the last steps, oldest first, to the end; 0 where it is not known yet, or nothing is left.

    Processes that begin together end together: of fewer than `_LEAST` steps nothing is concluded. The next step ends
    now at the earliest.
    """
    (first_s, first), (last_s, last) = steps[0], steps[-1]
    count = last - first
    if count < _LEAST:
        return 0.0
    return max((last_s - first_s) / count, (now_s - first_s) / (count + 1)) * (of - last)


def _console() -> Console:
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:  # a file has room for every column
        console.width = max(console.width, _WIDTH)
    return console
