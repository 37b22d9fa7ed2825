"""A text file that grows by whole lines: what is written is in the file at once, whole or not at all."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from hvt_common.errors import UserError

__all__ = ["LineFile", "check_there"]


def check_there(file: int, path: Path) -> None:
    """Raise `FileNotFoundError` where the open file has been removed: what is written to it would be in none."""
    if os.fstat(file).st_nlink == 0:
        raise FileNotFoundError(None, "it was removed", str(path))


class LineFile:
    """A new file with a first line of ``columns``; comma-separated. Takes the place of one of that name.

    Raises `UserError` where it cannot be created, or (from `log`) written any further.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC
        self._size_bytes, fresh = 0, not path.exists()
        try:
            self._file = os.open(path, flags, 0o644)
        except OSError as error:
            raise UserError(f"table {path} cannot be created: {error.strerror}") from None
        try:
            self.log(",".join(columns) + "\n")
        except UserError:
            self.close()
            if fresh:
                path.unlink(missing_ok=True)
            raise

    def log(self, item: str) -> None:
        """Append lines."""
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

    def skipped(self, count: int) -> None:
        """Nothing to do: skipped lines are lost."""

    def close(self, hurry: threading.Event | None = None) -> None:  # noqa: ARG002 - it is always quick
        """Close the file; a second call does nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
