"""Files and folders that are written whole or not at all: under another name first, then moved."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import av.error

from hvt_common.errors import UserError
from hvt_ground.sinks.line_file import claim_name


@contextmanager
def whole_file(path: Path, *, new: bool = False) -> Iterator[Path]:
    """The name to write to; it takes the place of ``path`` at the end, and is removed where that fails.

    Raises:
        UserError: it cannot be written, or is to be ``new`` and somebody has made one meanwhile.
    """
    part = _part_of(path)
    if path.exists() and not path.is_file():  # moved over /dev/null, every program would fill the file
        raise UserError(f"{path} is there and no file: name a file with --out")
    try:
        yield part
        if new and not claim_name(path):
            raise UserError(f"{path} is there already: name another with --out")
        part.replace(path)
    except (OSError, av.error.FFmpegError) as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """The same of a folder, which may be there if it is empty.

    Raises:
        UserError: it is not empty, or cannot be written.
    """
    part = _part_of(path)
    try:
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise UserError(f"{path} is there and not an empty folder: name one that is new")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        part.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _part_of(path: Path) -> Path:
    if not path.name:
        raise UserError(f"--out {path} has no name: name a file, or a folder that is new")
    return path.with_name(f".{path.name}.{os.getpid()}.part")  # another export may write the same
