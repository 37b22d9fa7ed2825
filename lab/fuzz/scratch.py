"""A folder for the files that targets write, gone when the process ends."""

from __future__ import annotations

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

__all__ = ["scratch"]


@cache
def scratch() -> Path:
    """The same folder each time."""
    folder = Path(mkdtemp(prefix="hvt-fuzz-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder
