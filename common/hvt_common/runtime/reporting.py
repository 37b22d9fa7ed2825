"""The report of a run: a status line, at its end a table and a JSON file; and the findings of a check before it."""

import contextlib
import itertools
import json
import logging
import os
import stat
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, Self, TextIO, TypeVar

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hvt_common.errors import FlightError, NotYetError, UserError, check_not_read, telling
from hvt_common.files import claim_name, is_output, takes_lock, write_whole
from hvt_common.runtime.log import STATUS_LOGGER, Log
from hvt_common.runtime.process import ended_in_time
from hvt_common.units import shown_text

S = TypeVar("S")
S_co = TypeVar("S_co", covariant=True)

_log = logging.getLogger(__name__)

_PLAIN_EVERY = 5
_MOST_NAME_BYTES = 190
"""File systems take 255. The files of further sessions, parts and backlogs have up to 64 more."""


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check, for people; ``todo`` is one line with the remedy, if there is one."""

    state: Literal["ok", "unknown", "warning", "wrong"]
    found: str
    todo: str = ""


class StatusLine:
    """One line on a terminal, rewritten in place; elsewhere every fifth update is a line, so that logs stay short.

    With ``as_json`` those lines and all notes go to the log. A closed pipe, a lost terminal or a full disk silences
    it; the run goes on.
    """

    def __init__(self, *, quiet: bool, as_json: bool = False) -> None:
        self._console = _Console(stderr=True, highlight=False, emoji=False)
        self._quiet = quiet
        self._updates = 0
        self._log = logging.getLogger(STATUS_LOGGER) if as_json else None
        self._live: Live | None = None
        if self._console.is_terminal and not (quiet or as_json):
            self._live = Live(console=self._console, auto_refresh=False, transient=True)

    def show(self, text: str) -> None:
        """Replace the line (call about once a second)."""
        with _going_on(sys.stderr):
            if self._live is not None:
                self._live.update(Text(shown_text(text), overflow="ellipsis", no_wrap=True), refresh=True)
            elif not self._quiet:
                if self._updates % _PLAIN_EVERY == 0:
                    self._print(text)
                self._updates += 1

    def note(self, text: str) -> None:
        if not self._quiet:
            with _going_on(sys.stderr):
                self._print(text)

    def _print(self, text: str) -> None:
        if self._log is not None:
            self._log.info("%s", text)
        else:
            self._console.print(shown_text(text), markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        if self._live is not None:
            with _going_on(sys.stderr):
                self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            with _going_on(sys.stderr):
                self._live.stop()


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Rich would end the process here."""
        raise BrokenPipeError


@contextlib.contextmanager
def _going_on(stream: TextIO) -> Iterator[None]:
    # After a failed write, send the stream to /dev/null and go on.
    try:
        yield
        if stream is not None:  # None where the process was started with the stream closed
            stream.flush()
    except OSError:
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def say(text: str) -> None:
    """Print a line on standard output, if it can be written."""
    with _going_on(sys.stdout):
        print(shown_text(text))


def print_table(title: str, rows: Sequence[tuple[str, str]]) -> None:
    table = Table(title=Text(title), show_header=False, title_justify="left", title_style="bold")
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        # Not markup: a path may have brackets in it.
        table.add_row(Text(shown_text(name)), Text(shown_text(value)))
    with _going_on(sys.stdout):
        _Console(highlight=False).print(table)


def reported(run: Callable[[], S], report: Callable[[S], None]) -> S:
    """Return the summary of a flight after ``report`` of it, also of one that breaks off with a `FlightError`."""
    try:
        summary = run()
    except FlightError as error:
        if error.summary is not None:
            report(error.summary)
        raise
    report(summary)
    return summary


class Side(Protocol[S_co]):
    """An edge or a ground, as a program runs it."""

    def run(self) -> S_co: ...

    def in_hand(self) -> frozenset[tuple[str, int]]: ...

    def given_up(self) -> Exception: ...


def flown(
    side: Side[S], stop: threading.Event, *, log: Log, path: Path | None, show: Callable[[S], None]
) -> S:
    """Run an edge or a ground until it ends or ``stop`` is set, and return its summary.

    That goes into the log as JSON or to ``show``, and into the file ``path``: alone, if a list has one only.
    """
    before = version_of(path)

    def report(summary: S) -> None:
        content = log.redaction.value(summary)
        (log.result if log.as_json else show)(content)
        if path is not None:
            single = isinstance(content, list) and len(content) == 1
            write_json(path, content[0] if single else content, before=before)

    return reported(
        lambda: ended_in_time(side.run, stop, in_hand=side.in_hand, otherwise=side.given_up), report
    )


def check_writable(path: Path | None, *, name: str, reads: Iterable[Path] = ()) -> None:
    """Raise `UserError` now where a file could not be written later, or is of the ``reads``; changes nothing."""
    if path is None:
        return
    check_not_read(path, reads, name=name)
    if path.is_dir():
        raise UserError(f"{name} {path} is a folder: name a file")
    if not path.absolute().parent.is_dir():
        raise NotYetError(  # it may be of a disk that is mounted later
            f"{name} {path} is in a folder that does not exist: make {path.absolute().parent} first"
        )
    if len(os.fsencode(path.name)) > _MOST_NAME_BYTES:
        raise UserError(
            f"{name} {path} has a name of {len(os.fsencode(path.name))} bytes: give one of at most "
            f"{_MOST_NAME_BYTES}, because the names of further files begin with it"
        )
    if path.exists() and not path.is_file():  # /dev/stdout or a pipe: opening it to see may block
        return
    real = path.resolve()
    fresh = not real.exists()
    with telling(f"{name} {path} cannot be written (", "): name a file that can"):
        with real.open("ab"):
            pass
        if fresh:
            real.unlink()


def check_folder(path: Path, *, name: str, otherwise: str = "") -> Path:
    """The folder, or the nearest above it that is there; `UserError` where nothing can be written. Makes nothing."""
    wanted = there = path.absolute()
    usable = False
    with contextlib.suppress(OSError):  # a part of the path cannot be read
        there = next(one for one in (wanted, *wanted.parents) if one.exists())
        usable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    if not usable:
        kind = UserError if there == wanted else NotYetError
        because = f"because {there} is no folder that can be written: name another{otherwise}"
        raise kind(f"{name} {path} cannot be used, {because}")
    return there


def write_json(
    path: Path, content: Mapping[str, Any] | Sequence[Mapping[str, Any]], *, before: object = None
) -> None:
    """Write the summary, as `write_whole`. Raises `FlightError` where it cannot be written.

    ``before`` is `version_of` the file as the run began: a file that another run has written since is kept, and this
    one gets the next free name.
    """
    text = (json.dumps(content, indent=2) + "\n").encode()
    try:
        with _first_of(path, before) as is_first:
            if is_first:
                write_whole(path, text)
                return
        names = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in itertools.count(2))
        other, path = path, next(one for one in names if claim_name(one))
        _log.warning("another run has written %s meanwhile: this summary is in %s", other, path)
        write_whole(path, text)
    except OSError as error:
        raise FlightError(f"{path} cannot be written ({error.strerror})") from error


@contextlib.contextmanager
def _first_of(path: Path, before: object) -> Iterator[bool]:
    # Whether no other run has written the file since, or is about to; nobody waits for a lock here.
    if before is None or is_output(path) or (path.exists() and not path.is_file()):
        yield True
        return
    real = Path(os.path.realpath(path))
    lock = real.with_name(f"{real.name}.lock")
    file = os.open(lock, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    # Its last holder may have removed it just now: that lock is nobody's.
    is_ours = takes_lock(file) and os.fstat(file).st_nlink > 0
    try:
        yield is_ours and version_of(path) in (before, ())
    finally:
        if is_ours:
            lock.unlink(missing_ok=True)
        os.close(file)


def version_of(path: Path | None) -> tuple[int, ...]:
    """Another value once a regular file was written anew; empty where there is none, and for standard output."""
    try:
        found = None if path is None or is_output(path) else path.stat()
    except OSError:
        found = None
    if found is None or not stat.S_ISREG(found.st_mode):
        return ()
    return found.st_ino, found.st_mtime_ns, found.st_size
