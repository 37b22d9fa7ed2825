"""The class names of common data sets, and which class names of models and people mean the same kind of object.

A *kind* is the word in which classes of different models are compared: ``car``, ``truck``, ``bus``, ``person``,
``motor``, ``bicycle``, ``tricycle``, ``train``, ``boat``, ``aeroplane``; ``names/kinds.toml`` has the table. The
motion detector's only class, ``moving``, may be any kind and passes every class list. A name that is not in the table
is a kind of its own.
"""

from __future__ import annotations

import tomllib
from importlib.resources import files

__all__ = [
    "COCO_NAMES",
    "IMAGENET_NAMES",
    "MOVING",
    "VISDRONE_NAMES",
    "kind_of",
    "same_kind",
]

MOVING = "moving"
"""The class of what moves, whatever it is."""


def _text(name: str) -> str:
    return (files("hvt_common.inference") / "names" / name).read_text(encoding="utf-8")


def _list(name: str) -> tuple[str, ...]:
    return tuple(line for line in _text(name).splitlines() if not line.startswith("#"))


COCO_NAMES = _list("coco.txt")
VISDRONE_NAMES = _list("visdrone.txt")
IMAGENET_NAMES = _list("imagenet.txt")
_KIND_OF_NAME = {name: kind for kind, names in tomllib.loads(_text("kinds.toml")).items() for name in names}


def kind_of(name: str) -> str:
    """The kind that a class name means; the plain name itself where the table does not hold it.

    Case, and the synonyms that ImageNet writes after a comma, do not matter: ``Beach wagon, station wagon`` is a car.
    """
    plain = name.partition(",")[0].strip().casefold()
    return str(_KIND_OF_NAME.get(plain, plain))


def same_kind(name: str, wanted: str) -> bool:
    """Whether both words mean the same kind; what moves may be anything."""
    kinds = kind_of(name), kind_of(wanted)
    return kinds[0] == kinds[1] or MOVING in kinds
