"""The errors that a user is meant to read."""

import argparse
import errno
import io
import os
import re
import select
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn, TextIO

from hvt_common.redaction import Redaction

_MAY_COME = frozenset(
    {
        *(errno.EADDRNOTAVAIL, errno.EADDRINUSE, errno.ENETDOWN, errno.ENETUNREACH, errno.EHOSTUNREACH),
        *(errno.EHOSTDOWN, errno.ECONNREFUSED, errno.ECONNRESET, errno.ECONNABORTED, errno.ETIMEDOUT),
        *(errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.EBUSY, errno.EAGAIN),
        *(errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM),
    }
)
_FULL = (errno.ENOSPC, errno.EDQUOT)
_NO_MORE = (errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_NO_MORE_WORDS = ("can't start new thread", "failed to map segment from shared object")
"""Words of Python's errors without a number."""
_ENDLESS = re.compile(r"(\S{300})\S+")
_NEVER_SEEN = (errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ELOOP)


def foreign() -> type[BaseException]:
    """Exceptions of foreign code, for an ``except``: much of it calls `sys.exit`, or panics in Rust. Not Ctrl-C."""
    return Exception if isinstance(sys.exc_info()[1], KeyboardInterrupt | GeneratorExit) else BaseException


class UserError(Exception):
    """Something the user can mend: one sentence that names the thing, its value and the accepted ones.

    Command-line tools print it without a traceback and exit with code 2. Raise it only for faults from
    outside (arguments, files, the machine); a wrong value between our own functions is a bug and crashes
    loudly.
    """

    said = False
    """Whether the log has the sentence already."""


class NotYetError(UserError):
    """A named thing is not there and may come: a camera that boots, the address of a VPN, another program's port.

    A program that serves waits for it (`hvt_common.runtime.failures.Awaited`); any other ends with exit code 1, so
    that a supervisor starts it again.
    """


def may_come(error: OSError) -> bool:
    """Whether time may mend it: something is not there, not free or used up, or a name that no server knows yet."""
    return isinstance(error, socket.gaierror | TimeoutError) or error.errno in _MAY_COME


def absent(path: Path) -> type[UserError]:
    """The error of a file that is not there: a folder that does not exist may be of a disk that is mounted later."""
    try:
        return UserError if path.absolute().parent.is_dir() else NotYetError
    except OSError:  # nobody may look there, or the name is too long
        return UserError


def named_path(text: str, *, name: str = "") -> Path:
    """The path that somebody wrote; ``~`` is a user's folder. One that is not there is no error.

    Raises `UserError` for a user that is not known, or where nobody may look, or the name is too long: there
    `Path.exists` raises. `NotYetError` where the disk does not answer.
    """
    what = f"{name} {text!r}".lstrip()
    if text == "-":
        raise UserError(f"{what} is a standard stream elsewhere, and no file here: name a file")
    try:
        path = Path(text).expanduser()
        path.stat()
    except RuntimeError:
        raise UserError(f"{what} begins with a user that this machine does not know") from None
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        kind = UserError if error.errno in _NEVER_SEEN else NotYetError
        raise kind(f"{what} cannot be looked at ({error.strerror}): name another") from None
    return path


def listening_trouble(error: OSError) -> str:
    """Why an address and its port cannot be listened on, and the remedy: the end of a sentence."""
    if error.errno == errno.EADDRNOTAVAIL:
        return "this machine has no such address"
    if isinstance(error, socket.gaierror):
        return f"{error.strerror}; give another host"
    return f"{error.strerror or error}; give another port, or end what uses it"


class FlightError(Exception):
    """Something that went wrong after the start and cannot be put right: one sentence, and exit code 1.

    A supervisor starts the program again, which may help. ``summary`` is that of the flight, where it had begun.
    """

    said = False

    def __init__(self, sentence: str, *, summary: Any = None) -> None:
        super().__init__(sentence)
        self.summary = summary


class Parser(argparse.ArgumentParser):
    """Explains wrong arguments in one sentence, without the usage above it."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.register("type", Path, _given_path)
        self.register("type", None, _given_text)
        self.register("type", int, _number(int, "a whole number"))
        self.register("type", float, _number(float, "a number"))

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        return super().parse_known_args(_with_joined_values(args), namespace)

    def add_subparsers(self, **settings: Any) -> Any:
        commands = super().add_subparsers(**settings)
        commands.type = str  # it takes all words that follow: the command's own option is to be named
        return commands

    def _print_message(self, message: str, file: Any = None) -> None:
        # That of argparse says nothing where there is no room for it.
        print(message, end="", file=file or sys.stderr, flush=True)

    def error(self, message: str) -> NoReturn:
        message = re.sub(r"(unrecognized arguments: )(\s*)$", r"\1'\2'", message)
        message = re.sub(r"ignored explicit argument (.*)", r"\1 is given, and it takes no value", message)
        raise UserError(f"{message}; see {self.prog} --help")


def _with_joined_values(argv: Sequence[str] | None) -> list[str]:
    """``--budget -5kbps`` as ``--budget=-5kbps``: argparse would take the value for a flag, and not name it."""
    joined: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        if re.match(r"-[\d.]", word) and joined and re.fullmatch(r"--[a-z][a-z-]*", joined[-1]):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def _given_path(text: str) -> Path:
    if not text.strip():  # else it is the folder that this runs in
        raise argparse.ArgumentTypeError(f"{text!r} is empty: give a name")
    return named_path(text)


def _given_text(text: str) -> str:
    if not text.strip():
        raise argparse.ArgumentTypeError(f"{text!r} is empty: leave it out or give it a value")
    return text


def _number(kind: type[float], accepted: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            return kind(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not accepted: give {accepted}") from None

    return parse


def check_not_read(path: Path, reads: Iterable[Path], *, name: str) -> None:
    """Raise `UserError` where ``path``, which is to be written, is one of the files that are ``reads``, by any name.

    Links count, symbolic and hard ones: the file to read would be lost.
    """
    for one in reads:
        try:
            same = path.samefile(one)
        except (OSError, ValueError):  # one of them is not there, or no path at all
            continue
        if same:
            raise UserError(f"{name} {path} is {one} itself, which is read: name another file")


@contextmanager
def telling(what: str, rest: str = "") -> Iterator[None]:
    """Turn an `OSError` into a `UserError`: ``what``, the system's reason, and the ``rest`` of the sentence."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{what}{error.strerror}{rest}") from error


def check_apart(files: Iterable[tuple[str, Path | None]]) -> None:
    """Raise `UserError` where two of the (name, path), which are to be written, are one file.

    None is no file, and a device takes anything.
    """
    names: dict[str, str] = {}
    for name, path in files:
        if path is None or (path.exists() and not path.is_file()):
            continue
        other = names.setdefault(os.path.realpath(path), name)
        if other != name:
            raise UserError(f"{other} and {name} both name {path}: give each a file of its own")


def exit_with_sentence(
    run: Callable[[Sequence[str] | None], int],
    *,
    program: str,
    argv: Sequence[str] | None,
    local: re.Pattern[str] | None = None,
) -> int:
    """Return the exit code of ``run(argv)``: 2 after a `UserError`, 1 after a `FlightError` or a `NotYetError`, said.

    128 and the signal's number, as of a shell, where one has interrupted it (130: Ctrl-C). Neither that nor a
    traceback has the secrets of an address in ``argv``; a word that ``local`` matches whole is none.

    Standard output that nobody reads any more, as after ``| head``, ends the program with 1 and no word; a full disk,
    or no memory, with 1. Standard streams that were closed are /dev/null.
    """
    _open_standard_streams()
    _print_any_character()
    words = sys.argv[1:] if argv is None else argv
    redaction = Redaction(one for one in words if local is None or not local.fullmatch(one))
    sys.excepthook = _traceback_without(redaction)
    try:
        _check_folder()
        code = run(argv)
        print(end="", flush=True)
    except (UserError, FlightError) as error:
        if not error.said:
            _say(f"{program}: {_in_a_line(redaction.text(str(error)))}")
        return 2 if isinstance(error, UserError) and not isinstance(error, NotYetError) else 1
    except KeyboardInterrupt as error:
        _say(f"{program}: interrupted")
        return 128 + next((one for one in error.args if isinstance(one, int)), signal.SIGINT)
    except BrokenPipeError:
        if not _reader_left():
            raise
        return 1
    except Exception as error:
        sentence = _used_up(error)
        if not sentence:
            raise
        if isinstance(error, OSError) and error.errno in _FULL:
            _discard(sys.stdout)
        _say(f"{program}: {sentence}")
        return 1
    return code


def _say(sentence: str) -> None:
    # The exit code is the same where nobody can read it.
    try:
        print(sentence, file=sys.stderr, flush=True)
    except OSError:
        _discard(sys.stderr)


def _in_a_line(sentence: str) -> str:
    # A value may have line ends, and no end.
    shown = "".join(one if one.isprintable() else ascii(one)[1:-1] for one in sentence)
    return _ENDLESS.sub(r"\1…", shown)


def _used_up(error: Exception) -> str:
    # The resource that the machine has run out of; empty where that is not the reason.
    number = error.errno if isinstance(error, OSError) else None
    reason = str(getattr(error, "strerror", None) or error) or type(error).__name__
    if number in _FULL:
        return f"a disk that it writes to is full ({reason}): make room there"
    if isinstance(error, MemoryError) or number in _NO_MORE or any(one in reason for one in _NO_MORE_WORDS):
        return (
            f"the system gives it no more memory, threads or files ({reason}): "
            "end other programs, or raise what ulimit -a shows"
        )
    return ""


def _open_standard_streams() -> None:
    # Else the next file that is opened has such a number: a recording, into which libjpeg writes its warnings.
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)
            if opened != number:
                os.dup2(opened, number)
                os.close(opened)
            os.set_inheritable(number, True)
            if getattr(sys, name) is None:
                setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))  # noqa: SIM115


def _print_any_character() -> None:
    # An ellipsis in a help text is no bug where the locale has none; in that of C Python takes UTF-8 (PEP 540).
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
        elif isinstance(stream, io.TextIOWrapper) and stream.errors == "surrogateescape":
            stream.reconfigure(encoding="utf-8", errors="surrogateescape")


def _check_folder() -> None:
    try:
        Path.cwd()
    except FileNotFoundError:
        raise UserError("the folder that this was started in is gone: change to one that is there") from None


def _traceback_without(
    redaction: Redaction,
) -> Callable[[type[BaseException], BaseException, TracebackType | None], None]:
    # For ``sys.excepthook``: a bug before there is a log.

    def show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        print(redaction.text("".join(traceback.format_exception(kind, error, trace))), file=sys.stderr)

    return show


def _reader_left() -> bool:
    # Standard output has no reader: discard all further output, also at exit.
    output = select.poll()
    output.register(sys.stdout.fileno(), 0)
    if not output.poll(0):
        return False
    _discard(sys.stdout)
    return True


def _discard(stream: TextIO) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def not_installed(what: str, package: str) -> UserError:
    """The error of an option whose extra is absent, with the ``package`` that brings it, such as ``hvt[edge]``."""
    return UserError(f"{what} is of an extra that is not installed: pip install '{package}'")


@contextmanager
def needs_extra(install: str) -> Iterator[None]:
    """Within it a missing package is a `UserError` that names it for ``pip install``, such as ``'hvt[study]'``."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("hvt_"):
            raise
        raise UserError(f"the package {error.name!r} is missing: pip install {install}") from None
