"""Translates a classifier's names for a track: its classes are those of the detectors.

*Which.* A class of the same name speaks for that class of a track, and for those of its kind that the classifier has
no name for; another for the classes of its kind; a name that is no kind, for those of its group (see `class_names`).
A network of ImageNet tells groups only (vehicle, person, boat, animal): it was never shown a van from above. The
paper's ``replace`` takes its kinds too. A name that means no class of a track is a note on the still.

*How much.* The probability of a class of a track is that of all the classifier's classes that speak for it. Classes
of a track without such a class, a stop sign to a classifier of vehicles, get the rest of the probability. Where most
of the probability means no class, the still has no vote; nor has a network of ImageNet on an object too small.

*Nothing of mine.* ``other``, ``background`` or ``nothing``, which a classifier was trained to answer for an object
of none of its classes, is one class for detectors and classifier. A track that it wins is doubted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.class_names import MOVING, group_of, is_imagenet, is_nothing, kind_of
from hvt_common.values import Posterior

LEAST_SIDE_PX = 24
"""The shorter side of an object, source pixels, from which a network of ImageNet has a vote."""
_SOME = 6


class Vocabulary:
    """The classes that a track may have, and their names by a reader of stills.

    ``detectors`` are the names of both sides' detectors, ``reader`` those of the still reader; ``kinds`` lets a
    network of ImageNet tell kinds (the paper's rule). Where a detector says only that something moves, the reader's
    own words are added.
    """

    def __init__(self, detectors: Sequence[str], reader: Sequence[str], *, kinds: bool = False) -> None:
        self.coarse = is_imagenet(reader)
        """Whether the reader is a network of ImageNet."""
        words = [group_of(name) or "" if self.coarse else name for name in reader]
        nothing = next((name for name in reader if is_nothing(name)), None) if not self.coarse else None
        self.names = _names(detectors, words, nothing)
        """The classes of tracks; those of ``detectors`` come first, under their own ids."""
        self.nothing: int | None = None
        """The class that is nothing of mine; None where the reader cannot say it."""
        if nothing is not None:
            self.nothing = next(place for place, name in enumerate(self.names) if is_nothing(name))
        self._reader = tuple(reader)
        targets = _targets(self.names, self._reader, groups=self.coarse and not kinds)
        self._means = np.zeros((len(self._reader), len(self.names)))
        for row, columns in enumerate(targets):
            self._means[row, list(columns)] = 1.0
        cells = {columns: place for place, columns in enumerate(dict.fromkeys([frozenset(), *targets]))}
        self._cells = np.array([cells[columns] for columns in targets])
        self._unspoken = self._means.sum(axis=0) == 0
        if MOVING in self.names:
            self._unspoken[self.names.index(MOVING)] = False

    def vote(self, said: Posterior, *, called: str, side_px: float) -> tuple[Posterior | None, str]:
        """Translate the reader's answer; ``called`` is the edge's name of the object, ``side_px`` its shorter side.

        The vote is over ``names``; its probabilities need not sum to 1, as several classes may mean one thing. Where
        there is none (None), a note has the reader's name without a class: ``waffle iron .31``.
        `ValueError` if the answer does not have one probability for each of the reader's classes.
        """
        if said.probabilities.shape != (len(self._reader),):
            raise ValueError(
                f"a posterior over {len(self._reader)} classes is wanted, not {said.probabilities.shape}"
            )
        # A model that overflows says nothing, and vetoes nothing.
        given = np.where(np.isfinite(said.probabilities), said.probabilities, 0.0).astype(np.float64)
        cells = np.bincount(self._cells, weights=given)
        best = int(cells.argmax())
        if best == 0 or (self.coarse and side_px < LEAST_SIDE_PX):
            return None, f"{said.class_name} .{min(99, round(100 * said.confidence)):02d}"
        likelihoods = given @ self._means
        nothing = 0.0 if self.nothing is None else likelihoods[self.nothing]
        likelihoods[self._unspoken] = cells[0] + nothing
        meant = np.flatnonzero(self._means[int(np.flatnonzero(self._cells == best)[0])])
        name = next((self.names[k] for k in meant if same_word(self.names[k], called)), self.names[meant[0]])
        sure = cells[cells > 0]
        entropy = max(0.0, -float((sure * np.log(sure)).sum()))
        return Posterior(name, min(1.0, float(cells[best])), entropy, likelihoods.astype(np.float32)), ""


def check_common(detector: str, detects: Sequence[str], classifier: str, says: Sequence[str]) -> None:
    """Raise `UserError` where no class of a classifier means anything to a detector's tracks."""
    mine = tuple(word for word in says if not is_nothing(word))
    if MOVING in detects or any(_targets(tuple(detects), mine, groups=is_imagenet(says))):
        return
    raise UserError(
        f"--classifier {classifier} has no class in common with --detector {detector}: it knows {_some(says)}; tracks"
        f" are {_some(detects)}: give a classifier of such classes, detector or none"
    )


def same_word(name: str, other: str) -> bool:
    """Whether two class names are one, but for case and spaces."""
    return _plain(name) == _plain(other)


def _names(detectors: Sequence[str], words: Sequence[str], nothing: str | None) -> tuple[str, ...]:
    names = list(detectors)  # each in its place, though a name may occur twice
    if MOVING in names:
        names += [word for word in dict.fromkeys(words) if word and word not in names]
    if nothing is not None and not any(map(is_nothing, names)):
        names.append(nothing)
    return tuple(names)


def _targets(names: tuple[str, ...], reader: tuple[str, ...], *, groups: bool) -> list[frozenset[int]]:
    # For each class of the reader the classes of ``names`` that it speaks for.
    if groups:
        return [_of_group(word, names) for word in reader]
    said = set(map(_plain, reader))
    trained = not is_imagenet(reader)  # the background of ImageNet was never shown
    return [_meant(word, names, said) if trained or not is_nothing(word) else frozenset() for word in reader]


def _meant(word: str, names: tuple[str, ...], said: set[str]) -> frozenset[int]:
    if is_nothing(word):
        return frozenset(k for k, name in enumerate(names) if is_nothing(name))
    own = frozenset(k for k, name in enumerate(names) if same_word(name, word))
    kin = frozenset(k for k, name in enumerate(names) if kind_of(name) == kind_of(word) and name != MOVING)
    nameless = frozenset(k for k in kin if _plain(names[k]) not in said)
    return (own | nameless) if own else (nameless or kin or _of_group(word, names))


def _of_group(word: str, names: tuple[str, ...]) -> frozenset[int]:
    group = group_of(word)
    return frozenset(k for k, name in enumerate(names) if group is not None and group_of(name) == group)


def _plain(name: str) -> str:
    return name.partition(",")[0].strip().casefold()


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_SOME])
    return f"{shown} … ({len(names)} in all)" if len(names) > _SOME else shown
