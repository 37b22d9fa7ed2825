"""The class names of common data sets, and which class names of models and people mean the same kind of object.

A *kind* is the word in which classes of different models are compared: ``car``, ``truck``, ``bus``, ``person``,
``motor``, ``bicycle``, ``tricycle``, ``train``, ``boat``, ``aeroplane``; ``names/kinds.toml`` has the table. The
motion detector's only class, ``moving``, may be any kind and passes every class list. A name that is not in the table
is a kind of its own.

A *group* is coarser: ``vehicle``, ``person``, ``boat``, ``animal`` (``names/groups.toml``). A classifier
of photographs can tell groups apart: ``names/imagenet_groups.txt`` has the group of each synset of ImageNet.
"""

import tomllib
from collections.abc import Sequence
from importlib.resources import files

MOVING = "moving"
"""The class of any moving object."""


def _text(name: str) -> str:
    return (files("hvt_common.inference") / "names" / name).read_text(encoding="utf-8")


def _list(name: str) -> tuple[str, ...]:
    return tuple(line for line in _text(name).splitlines() if not line.startswith("#"))


COCO_NAMES = _list("coco.txt")
VISDRONE_NAMES = _list("visdrone.txt")
IMAGENET_NAMES = _list("imagenet.txt")
VEHICLE_KINDS = frozenset({"car", "truck", "bus"})
"""Kinds that a network confuses before any others; a van is a car."""
_NOTHING = frozenset({"other", "background", "nothing"})
_IMAGENET_SHARE = 0.9
_GROUP_OF_KIND = {
    kind: group for group, kinds in tomllib.loads(_text("groups.toml")).items() for kind in kinds
}
_GROUP_OF_SYNSET = {
    name.casefold(): group for _, group, name in (line.split(" ", 2) for line in _list("imagenet_groups.txt"))
}
_KIND_OF_NAME = {name: kind for kind, names in tomllib.loads(_text("kinds.toml")).items() for name in names}


def kind_of(name: str) -> str:
    """The kind that a class name means; the plain name itself where the table does not hold it.

    Case, and the synonyms that ImageNet writes after a comma, do not matter: ``Beach wagon, station wagon`` is a car.
    """
    plain = _plain(name)
    return str(_KIND_OF_NAME.get(plain, plain))


def group_of(name: str) -> str | None:
    """The group that a class name means; None where it means none.

    ``car`` and ``Beach wagon, station wagon`` are a vehicle, ``Japanese spaniel`` is an animal, ``waffle iron`` none.
    """
    return _GROUP_OF_KIND.get(kind_of(name)) or _GROUP_OF_SYNSET.get(_plain(name))


def are_apart(name: str, other: str) -> bool:
    """Whether they mean two groups: a person is no vehicle, but may be ``moving``."""
    groups = {group_of(name), group_of(other)}
    return len(groups) == 2 and None not in groups


def is_nothing(name: str) -> bool:
    """Whether a class stands for none of the others: ``other``, ``background`` or ``nothing``."""
    return _plain(name) in _NOTHING


def is_imagenet(names: Sequence[str]) -> bool:
    """Whether these are the classes of a network trained on ImageNet: nearly all of its 1000 names are among them."""
    return len(_IMAGENET.intersection(map(_plain, names))) >= _IMAGENET_SHARE * len(_IMAGENET)


def _plain(name: str) -> str:
    return name.partition(",")[0].strip().casefold()


_IMAGENET = frozenset(map(_plain, IMAGENET_NAMES))


def same_kind(name: str, wanted: str) -> bool:
    """Whether both words mean the same kind; ``moving`` may be anything."""
    kinds = kind_of(name), kind_of(wanted)
    return kinds[0] == kinds[1] or MOVING in kinds
