"""From what the user wrote after ``--detector`` or ``--classifier`` to a file.

The embedded models come with the package: trained in this repository, Apache-2.0; see ``docs/models.md``.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from hvt_common.errors import UserError, absent
from hvt_common.inference.store.manifest import builtin_manifest
from hvt_common.inference.store.store import Store, file_digest

EMBEDDED_DETECTOR = "aerial-nano"
"""Finds vehicles and people from straight above or aslant."""
EMBEDDED_CLASSIFIER = "aerial-cls"
"""Names the objects of stills."""


def embedded_models() -> dict[str, Path]:
    """The models that come with the package, by name."""
    folder = resources.files("hvt_common") / "models"
    assert isinstance(folder, Path), "the package is installed as files, not run from an archive"
    return {name: folder / f"{name}.onnx" for name in (EMBEDDED_DETECTOR, EMBEDDED_CLASSIFIER)}


def model_names() -> tuple[str, ...]:
    """Every name that `resolve_model` knows; of fetched models too, whether they are here or not."""
    return (*embedded_models(), *Store().entries)


def known_classes(path: Path) -> str:
    """The classes of a file as the built-in manifest that pins it says: ``COCO, 80``, or names; "" for others."""
    try:
        size_bytes = path.stat().st_size
    except OSError:
        return ""
    entries = [entry for entry in builtin_manifest().values() if entry.size_bytes == size_bytes]
    same = [entry for entry in entries if file_digest(path) == entry.sha256]
    return same[0].classes if same else ""


def resolve_model(
    spec: str, *, role: str = "model", words: Sequence[str] = (), store: Store | None = None
) -> Path:
    """The file of a model that is named or that is a file already; a model of the cache is checked first.

    ``spec`` is a name, or a path: what has a folder or a suffix in it. The sentence of an error calls it ``role``
    and lists ``words`` too. Raises `UserError` where there is nothing of that name; for a model that could be had,
    with the command that fetches it and the way to bring it by hand.
    """
    separators = [os.sep, os.altsep or os.sep]
    if "." in spec or any(separator in spec for separator in separators):
        return _file(spec, role=role)
    embedded = embedded_models()
    if spec in embedded:
        return embedded[spec]
    store = store if store is not None else Store()
    entries = store.entries
    if spec in entries:
        return store.verified(spec)
    if Path(spec).is_file():
        return Path(spec)
    names = [*words, *embedded, *entries]
    near = "".join(f" (did you mean {name}?)" for name in difflib.get_close_matches(spec, names, n=1))
    raise UserError(f"{role} '{spec}' is not known{near}: give one of {', '.join(names)}, or an ONNX file")


def _file(spec: str, *, role: str) -> Path:
    path = Path(spec).expanduser()
    if not path.exists():
        raise absent(path)(
            f"{role} {spec} does not exist: give an ONNX file, or a name that 'hvt-models list' shows"
        )
    return path
