"""One function opens every dataset: ``open_dataset("visdrone:/data/VisDrone2019-VID-val")``; another several."""

from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Words
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from itertools import islice
from pathlib import Path

from hvt_common.errors import UserError, named_path
from hvt_study.datasets.class_map import of_kinds
from hvt_study.datasets.layouts.demo import open_demo
from hvt_study.datasets.layouts.image_sequence import open_clips
from hvt_study.datasets.layouts.mot import open_mot
from hvt_study.datasets.layouts.options import Options, split_options
from hvt_study.datasets.layouts.still import open_stills
from hvt_study.datasets.layouts.visdrone import open_uavdt, open_visdrone
from hvt_study.datasets.sequence import Sequence

_Found = Mapping[str, Callable[[], Sequence]]
"""By name, each opened when called."""
_Layout = Callable[[Path, Options], _Found]

_LAYOUTS: Mapping[str, tuple[_Layout, frozenset[str]]] = {
    "visdrone": (open_visdrone, frozenset({"fps", "labels", "labelled"})),
    "uavdt": (open_uavdt, frozenset({"fps", "labels", "labelled"})),
    "mot": (open_mot, frozenset({"fps", "labels", "labelled"})),
    "clips": (open_clips, frozenset({"fps"})),
    "still": (open_stills, frozenset({"labels", "view", "seeds", "classes", "labelled"})),
}
"""The layout of each scheme, and its options. Only requested sequences are opened."""

DATASETS = ("visdrone:ROOT", "uavdt:ROOT", "mot:ROOT", "clips:FOLDER", "demo:SEEDS", "still:FOLDER")
_SHOWN_NAMES = 5


def open_dataset(uri: str, *, limit: int | None = None, only: Words[str] = ()) -> tuple[Sequence, ...]:
    """The sequences of a dataset, in natural order: at most ``limit``, and ``only`` those of these names or patterns.

    ``uri`` is one of `DATASETS`; options follow a question mark: ``visdrone:ROOT?fps=24``. Raises `UserError` for an
    unknown scheme or option, where the layout lacks something or an annotation is wrong, or ``only`` names a
    sequence that is not there.
    """
    return tuple(one for _, one in open_datasets((uri,), limit=limit, only=only))


def open_datasets(
    uris: Words[str], *, limit: int | None = None, only: Words[str] = ()
) -> Iterator[tuple[str, Sequence]]:
    """The same of several, each with its URI; ``limit`` is of each.

    Raises `UserError` as `open_dataset`; a name of ``only`` has to be in one of them, not in all.
    """
    uris = tuple(dict.fromkeys(uris))
    if limit is not None and limit < 1:
        raise UserError(f"dataset {uris[0]!r} is limited to {limit} sequences: accepted is 1 or more")
    found = {}
    for uri in uris:
        with _readable(uri):
            found[uri] = _laid_out(uri)
    _check_there(found, only)
    for uri, sequences in found.items():
        chosen = (name for name in sequences if not only or any(fnmatchcase(name, one) for one in only))
        for name in islice(chosen, limit):
            with _readable(uri):
                sequence = sequences[name]()
            yield uri, sequence


@contextmanager
def _readable(uri: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise UserError(f"dataset {uri!r} cannot be read: {error}") from None


def _laid_out(uri: str) -> _Found:
    scheme, colon, place = uri.partition(":")
    if scheme == "demo" and colon:
        return open_demo(uri, place)
    if not colon or scheme not in _LAYOUTS:
        raise UserError(f"dataset {uri!r} is unknown: accepted are {', '.join(DATASETS)}")
    opener, accepted = _LAYOUTS[scheme]
    text, options = split_options(uri, place, accepted=accepted)
    path = named_path(text, name=f"dataset {uri!r}: folder")
    files_too = scheme in ("clips", "still")
    if not text or not (path.is_dir() or (files_too and path.is_file())):
        state = "is not a folder" if text and path.exists() else "does not exist"
        raise UserError(f"dataset {uri!r}: folder {text!r} {state}")
    found = opener(path, options)
    if not options.labelled:
        return found
    return {name: partial(_of_kinds, make, options.labelled, uri) for name, make in found.items()}


def _of_kinds(make: Callable[[], Sequence], kinds: tuple[str, ...], uri: str) -> Sequence:
    """The sequence as one that is judged in these kinds alone."""
    sequence = make()
    classes = of_kinds(sequence.class_set, kinds)
    if sequence.labels is not None and not classes:
        raise UserError(
            f"dataset {uri!r} labels none of {','.join(kinds)}: its classes are {', '.join(sequence.class_set)}"
        )
    return replace(sequence, class_set=classes)


def _check_there(found: Mapping[str, _Found], only: Words[str]) -> None:
    names = tuple(name for sequences in found.values() for name in sequences)
    for wanted in only:
        if not any(fnmatchcase(name, wanted) for name in names):
            where = " and ".join(map(repr, found))
            which = f"dataset {where} has" if len(found) == 1 else f"datasets {where} have"
            there = ", ".join(names[:_SHOWN_NAMES]) + (", …" if len(names) > _SHOWN_NAMES else "")
            raise UserError(f"{which} no sequence {wanted!r}: there are {there}")
