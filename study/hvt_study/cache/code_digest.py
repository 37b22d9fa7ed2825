"""HVT's own code by its content: a version that stays the same through a hundred edits does not say what was run."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

DETECTING = ("hvt_common", "hvt_models")
"""Has a say in what a detector finds."""
FLYING = (*DETECTING, "hvt_codecs", "hvt_edge", "hvt_ground", "hvt_study")
"""Has one in a flight and its figures."""
_BESIDE = ("hvt_study/commands", "hvt_study/report")
"""Has no say in a flight or in its figures."""
_DIGITS = 16


def flight_code() -> str:
    """Of all that decides a flight and its figures: what flies, with the extras that have a say, and the study."""
    return code_digest(*FLYING, without=_BESIDE)


@cache
def code_digest(*packages: str, without: tuple[str, ...] = ()) -> str:
    """Of the Python files of these packages, as they are installed here; a process reads them once.

    Args:
        packages: names; a checkout and a wheel with the same files have the same digest.
        without: folders, such as ``hvt_study/report``, that are passed over.
    """
    return tree_digest(_folders(packages), without=without)


def tree_digest(folders: Iterable[Path], *, without: Collection[str] = ()) -> str:
    """Hexadecimal; of the names and contents of all Python files below, in whatever order a disk lists them.

    ``without`` names folders as `code_digest` does: from the last part of one of ``folders`` on.
    """
    digest = hashlib.sha256()
    files = {
        file.relative_to(folder.parent).as_posix(): file for folder in folders for file in _python(folder)
    }
    for name, file in sorted(files.items()):
        if any(name.startswith(f"{folder}/") for folder in without):
            continue
        content = file.read_bytes()
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:_DIGITS]


def _folders(packages: Iterable[str]) -> Iterator[Path]:
    for name in packages:
        found = find_spec(name)
        assert found is not None, f"{name} is a part of HVT"
        yield from map(Path, found.submodule_search_locations or ())


def _python(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*.py") if path.is_file())
