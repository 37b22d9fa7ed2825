"""From the value of ``--detector`` or ``--classifier`` to files: embedded, of the library, or plain.

The embedded models come with the package: trained in this repository, Apache-2.0; see ``docs/models.md``. The model
library is an extra: the entry points of the group ``hvt.models``.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Collection, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hvt_common.errors import UserError, absent, named_path
from hvt_common.runtime.plug_ins import installed, loaded

if TYPE_CHECKING:
    from hvt_common.inference.letterbox import OwnSteps

EMBEDDED_DETECTOR = "aerial-nano"
"""Finds vehicles and people from straight above or aslant."""
EMBEDDED_CLASSIFIER = "aerial-cls"
"""Names the objects of stills."""

MOTION = "motion"
"""The word that stands for the detector without weights, which is of the model library; it remembers pictures."""

_GROUP = "hvt.models"
_JOIN = "+"
_MOST_PARTS = 3
MISSING = "the model library is an extra that is not installed: pip install 'hvt'"


class ModelStore(Protocol):
    """The part ``store`` of the library: models by name."""

    @property
    def entries(self) -> Collection[str]:
        """The names."""

    def verified(self, name: str) -> Path:
        """The file of that name, checked; `UserError` where it is not there or not the right one."""

    def known_classes(self, path: Path) -> str:
        """The classes of a file that is pinned: ``COCO, 80``, or names; "" for others."""

    @staticmethod
    def own_steps(path: Path) -> OwnSteps:
        """The first steps of a checked file on its pixels."""


def library_part(name: str) -> Any | None:
    """A part of the model library, as the entry points name it; None where it is not installed."""
    found = installed(_GROUP).get(name)
    return None if found is None else loaded(found[0], lambda part: part, what="model library")


def needed_part(name: str, what: str) -> Any:
    """As `library_part`; `UserError` where it is not installed: the sentence says that ``what`` needs it."""
    part = library_part(name)
    if part is None:
        raise UserError(f"{what} is not available: {MISSING}")
    return part


def model_store() -> ModelStore | None:
    part = library_part("store")
    return None if part is None else part()


def embedded_models() -> dict[str, Path]:
    """The models that come with the package, by name."""
    folder = resources.files("hvt_common") / "models"
    assert isinstance(folder, Path), "the package is installed as files, not run from an archive"
    return {name: folder / f"{name}.onnx" for name in (EMBEDDED_DETECTOR, EMBEDDED_CLASSIFIER)}


def model_names() -> tuple[str, ...]:
    """Every name that `resolve_model` knows; of fetched models too, whether they are here or not."""
    store = model_store()
    return (*embedded_models(), *(() if store is None else store.entries))


def known_classes(path: Path) -> str:
    """The classes of a file as the library that pins it says: ``COCO, 80``, or names; "" for others."""
    store = model_store()
    return "" if store is None else store.known_classes(path)


def parts_of(spec: str) -> tuple[str, ...]:
    """The detectors that ``A+B`` or ``A+B+C`` names; of any other ``spec`` that one alone.

    A file of such a name is that file; after a colon (of a plug-in) a plus is text. Raises `UserError` where a part
    is missing or repeated, or there are more than three.
    """
    names, colon, text = spec.partition(":")
    *parts, last = (part.strip() for part in names.split(_JOIN))
    found = (*parts, f"{last}{colon}{text}")
    # Path's own `exists` raises where a name is too long.
    is_path = os.path.exists(os.path.expanduser(spec)) or ("" in found and os.sep in spec)  # noqa: PTH110, PTH111
    if not parts or is_path:
        return (spec,)
    what = f"detector {spec!r} is not accepted"
    if "" in found:
        raise UserError(f"{what}: a name is missing beside a {_JOIN}; give NAME{_JOIN}NAME")
    if len(set(found)) < len(found):
        twice = next(part for part in found if found.count(part) > 1)
        raise UserError(f"{what}: it names {twice} twice; each part may be named once")
    if len(found) > _MOST_PARTS:
        raise UserError(f"{what}: it names {len(found)} detectors; at most {_MOST_PARTS} are merged")
    return found


def resolve_model(spec: str, *, role: str = "model", words: Sequence[str] = ()) -> Path:
    """The file of a model that is named or that is a file already; a model of the cache is checked first.

    ``spec`` is a name, or a path if it has a folder or a suffix in it. The sentence of an error calls it ``role``
    and lists ``words`` too. Raises `UserError` where there is nothing of that name; for a model that could be had,
    with the command that fetches it and the way to bring it by hand.
    """
    separators = [os.sep, os.altsep or os.sep]
    if "." in spec or any(separator in spec for separator in separators):
        return _file(spec, role=role)
    embedded = embedded_models()
    if spec in embedded:
        return embedded[spec]
    store = model_store()
    if store is not None and spec in store.entries:
        return store.verified(spec)
    if (path := named_path(spec, name=role)).is_file():
        return path
    names = [*words, *embedded, *(() if store is None else store.entries)]
    near = "".join(f" (did you mean {name}?)" for name in difflib.get_close_matches(spec, names, n=1))
    more = f"; of other names, {MISSING}" if store is None else ""
    raise UserError(
        f"{role} '{spec}' is not known{near}: give one of {', '.join(names)}, or an ONNX file{more}"
    )


def _file(spec: str, *, role: str) -> Path:
    path = named_path(spec, name=role)
    if not path.exists():
        raise absent(path)(
            f"{role} {spec} does not exist: give an ONNX file, or a name that 'hvt-models list' shows"
        )
    return path
