"""Which class of a detector or classifier speaks of which class of a dataset.

Names are compared by kind (`hvt_common.inference.class_names`): COCO's ``person`` speaks of VisDrone's ``pedestrian``
and ``people``, an ImageNet ``pickup`` of UAVDT's ``truck``. Within one kind names stay apart where model and dataset
have the very same ones, else they become one word. Where a dataset has one class of a kind, that is the word.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from hvt_common.errors import UserError
from hvt_common.inference.class_names import MOVING, kind_of
from hvt_common.inference.labels import first_synonym

VEHICLE = "vehicle"
VEHICLES = frozenset({"car", "truck", "bus", VEHICLE})
"""The kinds behind the name where a dataset calls all of them so."""
_SHOWN = 12


@dataclass(frozen=True, slots=True)
class ClassMap:
    """Which names of a model and of a dataset mean the same."""

    spoken: Mapping[str, tuple[str, ...]]
    """Model class to classes of the dataset that it speaks of; classes that speak of none are not in it."""
    words: Mapping[str, str]
    """Word in which a name is compared, for all names of model and dataset that have a partner."""

    def word(self, name: str) -> str:
        """The word in which a name of either side is compared; its own plain form where it has no partner."""
        return self.words.get(name) or _plain(name)

    @property
    def classes(self) -> tuple[str, ...]:
        """Words that both sides have, sorted: the classes of metrics."""
        return tuple(sorted(set(self.words.values())))


def map_classes(model_names: Iterable[str], dataset_classes: Iterable[str]) -> ClassMap:
    """Partners of a model's class names in `Sequence.class_set`; `UserError` where none share a kind."""
    models, classes = tuple(dict.fromkeys(model_names)), tuple(dict.fromkeys(dataset_classes))
    ours, theirs = _by_kind(models, classes), _by_kind(classes, classes)
    spoken: dict[str, tuple[str, ...]] = {}
    words: dict[str, str] = {}
    for kind in ours.keys() & theirs.keys():
        found, words_of = _pair(ours[kind], theirs[kind], kind=kind)
        spoken |= found
        words |= words_of
    if MOVING in models and len(models) == 1:  # the motion detector does not name moving objects
        spoken, words = {MOVING: classes}, dict.fromkeys((MOVING, *classes), MOVING)
    if not spoken or not classes:
        raise UserError(
            f"the model's classes ({_some(models)}) and those of the dataset ({_some(classes)}) have nothing in "
            "common: give a model of one of these kinds, or labels=reference"
        )
    return ClassMap({name: spoken[name] for name in models if name in spoken}, words)


def of_kinds(names: Iterable[str], kinds: Iterable[str]) -> tuple[str, ...]:
    """Those of some class names that are of these kinds, in their order; ``vehicle`` is a car, truck or bus too."""
    wanted = {kind_of(kind) for kind in kinds}
    wanted |= VEHICLES if VEHICLE in wanted else set()
    return tuple(name for name in names if kind_of(name) in wanted)


def _pair(
    models: list[str], classes: list[str], *, kind: str
) -> tuple[dict[str, tuple[str, ...]], dict[str, str]]:
    """For one kind: the dataset classes of each model class, and the word of every name."""
    if len(classes) > 1 and {_plain(name) for name in models} == {_plain(name) for name in classes}:
        named = {_plain(name): name for name in classes}
        spoken: dict[str, tuple[str, ...]] = {name: (named[_plain(name)],) for name in models}
        return spoken, {name: _plain(name) for name in (*models, *classes)}
    word = _plain(classes[0]) if len(classes) == 1 else kind
    return dict.fromkeys(models, tuple(classes)), dict.fromkeys((*models, *classes), word)


def _by_kind(names: Collection[str], classes: Collection[str]) -> dict[str, list[str]]:
    all_one = any(_plain(name) == VEHICLE for name in classes)
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        kind = kind_of(name)
        found[VEHICLE if all_one and kind in VEHICLES else kind].append(name)
    return found


def _plain(name: str) -> str:
    return first_synonym(name).casefold()


def _some(names: Collection[str]) -> str:
    shown = ", ".join(list(names)[:_SHOWN])
    return f"{shown} … {len(names)} in all" if len(names) > _SHOWN else shown or "none"


def joint_classes(
    detector_names: Collection[str], reader_names: Collection[str] | None, class_set: Collection[str]
) -> ClassMap:
    """One vocabulary for a detector, a classifier (None: the detector reads, or nobody) and the labels of a dataset.

    Within one kind names stay apart only where both models have the very names of the dataset: names that one of them
    cannot tell apart are one for the other too. A ``minivan`` of ImageNet is right on a ``car``, and on a ``van``.
    Raises `UserError` where one of them has no kind in common with the dataset.
    """
    found = map_classes(detector_names, class_set)
    if reader_names is None:
        return found
    shared = tuple(name for name in dict.fromkeys(class_set) if name in found.words)
    read = map_classes(reader_names, shared)
    common = {name: _common_word(name, found, read) for name in shared}
    spoken = {**read.spoken, **found.spoken}
    words = {name: common[classes[0]] for name, classes in spoken.items()} | common
    models = tuple(dict.fromkeys((*detector_names, *reader_names)))
    return ClassMap(
        spoken={
            name: tuple(one for one in shared if common[one] == words[name])
            for name in models
            if name in spoken
        },
        words=words,
    )


def _common_word(name: str, *maps: ClassMap) -> str:
    """Word for a class of the dataset: that of its kind where one of the models knows no finer."""
    own = _plain(name)
    said = (one.words.get(name, own) for one in maps)
    return next((word for word in said if word != own), own)
