"""The options behind a dataset's path in its URI: ``?fps=24&labels=none``."""

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from hvt_common.errors import UserError

_MOST_SEEDS = 10_000
_HIGHEST_SEED = 2**32 - 1


@dataclass(frozen=True, slots=True)
class Options:
    """All of them, with the defaults."""

    fps: float | None = None
    """Rate at which the images were taken, other than the dataset's own."""
    annotated: bool = True
    """False with ``labels=none``: pictures alone."""
    view: float | None = None
    """Height that the virtual camera sees at its lowest, in heights of the picture."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the virtual camera's ways; each gives sequences of its own."""
    classes: tuple[str, ...] = ()
    """Names of the classes of YOLO's labels; none: those of ``classes.txt``."""
    labelled: tuple[str, ...] = ()
    """Kinds that the dataset labels, such as ``vehicle``: objects of others count neither way. None: all that
    its classes name."""


def split_options(uri: str, place: str, *, accepted: Collection[str]) -> tuple[str, Options]:
    """The path and the options behind the scheme.

    A `UserError` names the option that is not one, or its value.
    """
    path, mark, query = place.rpartition("?")
    if not mark or Path(place).exists():
        return place, Options()
    pairs = parse_qsl(query, keep_blank_values=True)
    given: dict[str, Any] = {}
    for name, value in pairs:
        if name not in accepted:
            words = ", ".join(sorted(accepted)) or "none"
            raise UserError(f"dataset {uri!r} has the unknown option {name!r}: accepted here are {words}")
        field, parse = _OPTIONS[name]
        given[field] = parse(uri, value)
    return path, Options(**given)


def missing_labels(whose: str, file: Path | str) -> UserError:
    """Error for a sequence or set, in words, whose annotations are not there."""
    return UserError(
        f"{whose} has no annotations {file}: add them, or ask for pictures alone with ?labels=none"
    )


def parse_numbers(uri: str, text: str) -> tuple[int, ...]:
    """``0-4`` or ``1,5`` or both, sorted, each once; `UserError` for anything else, or more than can be meant."""
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,10})(?:-([0-9]{1,10}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if last < first or last > _HIGHEST_SEED or last - first >= _MOST_SEEDS:
            raise UserError(
                f"dataset {uri!r} asks for the seeds {text!r}: accepted are whole numbers from 0 to {_HIGHEST_SEED}, "
                f"at most {_MOST_SEEDS} of them, such as 0-4 or 1,5"
            )
        numbers |= set(range(first, last + 1))
    return tuple(sorted(numbers))


def _words(uri: str, text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(","))
    if not all(words):
        raise UserError(f"dataset {uri!r} names {text!r}: accepted are names between commas")
    return words


def _annotated(uri: str, text: str) -> bool:
    if text not in ("annotations", "none"):
        raise UserError(f"dataset {uri!r} says labels={text}: accepted are annotations and none")
    return text == "annotations"


def _number(uri: str, text: str, *, name: str, least: float, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise UserError(
            f"dataset {uri!r} says {name}={text}: accepted is a number from {least:g} to {most:g}"
        )
    return value


_OPTIONS: Mapping[str, tuple[str, Callable[[str, str], Any]]] = {
    "fps": ("fps", partial(_number, name="fps", least=0.1, most=1000)),
    "labels": ("annotated", _annotated),
    "view": ("view", partial(_number, name="view", least=0.1, most=3)),
    "seeds": ("seeds", parse_numbers),
    "classes": ("classes", _words),
    "labelled": ("labelled", _words),
}
