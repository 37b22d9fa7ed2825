"""Files that people name: read whole within a bound, written whole or not at all, still there while they are written.

A device that never ends is one that is too large to read.
"""

import codecs
import errno
import fcntl
import logging
import os
import re
import select
import stat
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

MOST_BYTES = 16_000_000
MOST_TABLE_BYTES = 1_000_000_000
"""Limit for labels and annotations of a whole dataset."""
PIPE_WAIT_S = 10.0
"""The longest wait for a pipe's other end, and then for its content."""
_MOST_TOML, _MOST_PARTS = 1_000_000, 32
"""Characters of TOML, and parts of a key: the time that Python takes grows with their square, to many minutes."""
_NO_KEY = re.compile(
    r'"""(?:[^\\]|\\.)*?(?:"{3,5}|\Z)|' + r"'''.*?(?:'{3,5}|\Z)"
    r'|"(?:[^"\\\n]|\\[^\n])*+"?' + r"|'[^'\n]*+'?|#[^\n]*+",
    re.DOTALL,
)
"""Strings, closed or not, and comments."""
_LONG_KEY = re.compile(rf"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){{{_MOST_PARTS}}}")
_LOCK_TRIES, _LOCK_PAUSE_S = 50, 0.02
_log = logging.getLogger(__name__)


def read_bytes(path: Path, *, most: int = MOST_BYTES) -> bytes:
    """All of a file. Raises `OSError`, also where it is larger than ``most``, or a pipe that nobody writes into."""
    with open(path, "rb", opener=at_once, buffering=0) as file:
        size = os.fstat(file.fileno()).st_size or most  # that of a pipe or a device is 0
        news = select.poll()
        news.register(file, select.POLLIN)
        content = b""
        while left := min(size, most) + 1 - len(content):
            if not news.poll(PIPE_WAIT_S * 1000):
                raise OSError(errno.ETIMEDOUT, f"a pipe into which nobody writes for {PIPE_WAIT_S:g} s")
            if not (more := file.read(left)):
                break
            content += more
    if len(content) > most:
        raise OSError(errno.EFBIG, f"larger than {most / 1e6:g} MB")
    return content


def open_plain(path: Path) -> BinaryIO:
    """A file, to be read from any place. Raises `OSError`, also for a pipe, which keeps its reader waiting."""
    file = open(path, "rb", opener=at_once)  # noqa: SIM115 - it is the caller's
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(errno.ESPIPE, "a pipe or a device, and no file")
    return file


def at_once(path: str, flags: int) -> int:
    """For `open` as ``opener``: to write into a pipe that nobody reads is an `OSError` after a while.

    No signal ends the system's own wait for the other end.
    """
    end_s = time.monotonic() + PIPE_WAIT_S
    while True:
        try:
            opened = os.open(path, flags | os.O_NONBLOCK, 0o666)
        except OSError as error:
            if error.errno != errno.ENXIO or time.monotonic() >= end_s:
                raise
            time.sleep(0.05)
        else:
            os.set_blocking(opened, True)
            return opened


def read_text(path: Path, *, most: int = MOST_BYTES) -> str:
    """The text of a file, as `decoded`. Raises `OSError`, also where it is no text."""
    try:
        return decoded(read_bytes(path, most=most))
    except UnicodeDecodeError as error:
        raise OSError(errno.EILSEQ, f"not UTF-8 text at byte {error.start}") from None


def decoded(content: bytes) -> str:
    """Text in UTF-8, or as its byte order mark says. Raises `UnicodeDecodeError` for anything else."""
    wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return content.decode("utf-16" if wide else "utf-8-sig")


def toml_table(text: str) -> dict[str, Any]:
    """TOML as a table. Raises `ValueError`, also for a text or a key that is too long, and `RecursionError`."""
    if len(text) > _MOST_TOML:
        raise ValueError(f"it has {len(text)} characters, accepted are at most {_MOST_TOML}")
    if (key := _LONG_KEY.search(_NO_KEY.sub("_", text))) is not None:
        raise ValueError(f"the key {key[0][:20]}… has more than {_MOST_PARTS} parts")
    return tomllib.loads(text)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, through a link to where it leads; another process may do so, too.

    A pipe, a device or standard output takes the bytes as they come, after everything printed before.
    Raises `OSError`.
    """
    if is_output(path):
        sys.stdout.flush()
        with open(1, "wb", closefd=False) as output:
            output.write(content)
        return
    if path.exists() and not path.is_file():
        with open(path, "wb", opener=at_once) as output:
            output.write(content)
        return
    real = Path(os.path.realpath(path))
    scratch = real.with_name(f"{real.name}.{os.getpid()}.part")
    try:
        scratch.write_bytes(content)
        scratch.replace(real)
    except OSError:
        with suppress(OSError):
            scratch.unlink()
        raise


@contextmanager
def locked(path: Path, on_wait: Callable[[], object] = lambda: None) -> Iterator[None]:
    """Hold the lock of this file, which is made and stays: whoever else asks for it, a thread too, waits.

    ``on_wait`` is called before this one waits. The lock ends with the process. A file system without locks is
    warned of once, and nobody waits. Raises `OSError` where the file cannot be made.
    """
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except PermissionError:
        if not path.exists():
            raise
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)  # another user made it
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            on_wait()
            fcntl.flock(file, fcntl.LOCK_EX)
        except OSError as error:
            _warn_of(path.parent, error.strerror)
        yield
    finally:
        os.close(file)


@cache
def _warn_of(folder: Path, why: str) -> None:
    _log.warning("%s takes no locks (%s): let one program at a time write there", folder, why)


def is_output(path: Path) -> bool:
    """Whether it leads to where standard output goes."""
    try:
        return os.path.samestat(path.stat(), os.fstat(1))
    except OSError:  # not there yet
        return False


def check_there(file: int, path: Path) -> None:
    """Raise `FileNotFoundError` where no name leads to the open file any more: nobody would find it.

    A file that was moved, alone or with its folder, is where the system says.
    """
    if os.fstat(file).st_nlink == 0:
        raise FileNotFoundError(None, "it was removed", str(path))
    if _is_gone(path) and _is_gone(_named_by_system(file)):
        raise FileNotFoundError(None, "its disk was unmounted", str(path))


def _named_by_system(file: int) -> Path:
    try:
        return Path(f"/proc/self/fd/{file}").readlink()
    except OSError:  # another system than Linux
        return Path(os.devnull)


def _is_gone(path: Path) -> bool:
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:  # nobody may look there, which says nothing
        return False
    return False


def created(path: Path, flags: int = 0) -> int:
    """A descriptor to write a new file with, in place of one of that name; until it is closed the file is locked.

    Raises `OSError`, also where another program is at work on the file, or was while this waited; a pipe or a device
    has no lock.
    """
    for waited in range(_LOCK_TRIES):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | flags, 0o644)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            return file
        ours, found = takes_lock(file), os.fstat(file)
        is_others = found.st_size and (waited or not ours)
        # The index removes empty files that nobody has locked: this one perhaps, just now.
        if ours and found.st_nlink and not is_others:
            if found.st_size:
                os.ftruncate(file, 0)
            return file
        os.close(file)
        if is_others:
            break
        time.sleep(_LOCK_PAUSE_S)
    raise OSError(errno.EBUSY, "another program is at work on it")


def takes_lock(file: int) -> bool:
    """Whether a descriptor holds the lock of its file now; another program may, as long as it writes it."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks: nobody can claim it either
        return True
    return True


def claim_name(path: Path) -> bool:
    """Whether the name was free: from now on it is ours, with an empty file, and no other process gets it.

    True as well where no file can be made there; opening it tells why.
    """
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644))
    except FileExistsError:
        return False
    except OSError:
        return True
    return True


def has_nothing(path: Path) -> bool:
    """Whether there is no file of that name, or an empty one: never a device, a link or a pipe."""
    try:
        found = path.lstat()
    except OSError:
        return not path.is_symlink()
    return stat.S_ISREG(found.st_mode) and not found.st_size
