"""Parameters of methods other than their defaults, as ``--tune`` of ``hvt-study run`` names them."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_common.files import read_text
from hvt_edge.stills.policy.registry import METHODS, method, tuning
from hvt_study.runs.methods import METHODS as FLOWN

_ACCEPTED = (
    "give METHOD:KEY=VALUE, such as M5:small_weight=0.5, or the tune.json that hvt-study tune has written"
)


def tuned_methods(words: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """`RunSpec.tune` by method: each word is ``METHOD:KEY=VALUE,…`` or a tune.json. Later words win.

    Raises:
        UserError: a word is neither, the method sends no stills or has no such parameter, or its value is none.
    """
    found: dict[str, dict[str, float]] = {}
    for word in words:
        name, parameters = _from_file(Path(word)) if word.endswith(".json") else _from_words(word)
        known = {row.casefold(): row for row, one in FLOWN.items() if one.sends_stills}
        own = known.get(name.casefold())
        if own is None:
            raise UserError(f"--tune {word!r} is of {name!r}: choose one of {', '.join(known.values())}")
        method(own, **parameters)
        found[own] = found.get(own, {}) | parameters
    changed = {  # a method with its defaults is that method
        name: {key: value for key, value in one.items() if value != METHODS[name].parameters[key]}
        for name, one in found.items()
    }
    return {name: texts for name, one in changed.items() if (texts := tuning_texts(one))}


def tuning_texts(parameters: Mapping[str, float]) -> tuple[str, ...]:
    """``KEY=VALUE`` as the edge takes them, by name: equal parameters are equal texts."""
    return tuple(f"{name}={value:g}" for name, value in sorted(parameters.items()))


def _from_words(word: str) -> tuple[str, dict[str, float]]:
    name, colon, said = word.partition(":")
    if not colon:
        raise UserError(f"--tune {word!r} is not accepted: {_ACCEPTED}")
    return name.strip(), tuning((said,))


def _from_file(path: Path) -> tuple[str, dict[str, float]]:
    try:
        found: Any = json.loads(read_text(path))
        name, parameters = found["method"], found["parameters"]
        return str(name), {str(key): float(value) for key, value in parameters.items()}
    except OSError as error:
        raise UserError(f"--tune {path} cannot be read ({error.strerror}): {_ACCEPTED}") from None
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        raise UserError(f"--tune {path} is no result of a search: {_ACCEPTED}") from None
