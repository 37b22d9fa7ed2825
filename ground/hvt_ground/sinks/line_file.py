"""A text file that grows by whole lines: a written line is in the file at once, whole or not at all."""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hvt_common.errors import UserError, telling
from hvt_common.files import check_there
from hvt_ground.sinks.queued import SinkWriter


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


class LineFile(SinkWriter[str]):
    """A new file with a first line of ``columns``; comma-separated. Takes the place of one of that name.

    Raises `UserError` where it cannot be created, or (from `log`) written any further.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path: Path = path
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        self._size_bytes, fresh = 0, has_nothing(path)
        with telling(f"table {path} cannot be created: "):
            self._file = os.open(path, flags, 0o644)
        try:
            self.log(",".join(columns) + "\n")
        except UserError:
            self.close()
            if fresh:
                path.unlink(missing_ok=True)
            raise

    def log(self, item: str) -> None:
        data = item.encode()
        try:
            check_there(self._file, self.path)
            while data:
                data = data[os.write(self._file, data) :]
        except OSError as error:
            with suppress(OSError):  # half a line
                os.ftruncate(self._file, self._size_bytes)
            raise UserError(f"table {self.path} cannot be written any further: {error.strerror}") from error
        self._size_bytes += len(item.encode())

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
