"""The words in which labels, the ground's detector and the reader of its stills are compared.

Labels that the detector can speak of are asked for, whoever reads the stills: the same labels with every classifier.
"""

from __future__ import annotations

from collections.abc import Collection

from hvt_common.inference.labels import first_synonym
from hvt_study.datasets.class_map import ClassMap, map_classes


def joint_classes(
    detector_names: Collection[str], reader_names: Collection[str] | None, class_set: Collection[str]
) -> ClassMap:
    """One vocabulary for a detector, a classifier and the labels of a dataset.

    Within one kind names stay apart only where both models have the very names of the dataset: what one of them
    cannot tell apart is not asked of the other. A ``minivan`` of ImageNet is right on a ``car``, and on a ``van``.

    Args:
        detector_names: of the ground's detector.
        reader_names: of the classifier that reads stills; None where the detector does it, or nobody.
        class_set: `Sequence.class_set`.

    Raises:
        UserError: detector and dataset have no kind in common, or the classifier has none with what they share.
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
    """Of a class of the dataset: the word of its kind where one of the models knows no finer."""
    own = first_synonym(name).casefold()
    said = (one.words.get(name, own) for one in maps)
    return next((word for word in said if word != own), own)
