"""Every method by name: the one table that ``--method`` and the study read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import Any

from hvt_common.errors import UserError
from hvt_edge.stills.policy.base import Method
from hvt_edge.stills.policy.m6 import ExpectedGain
from hvt_edge.stills.policy.paper import (
    SELECTORS,
    OnStart,
    Periodic,
    Small,
    TracksFirst,
    Uncertain,
    Utility,
    VideoOnly,
)


@dataclass(frozen=True, slots=True)
class MethodEntry:
    """A row of the table."""

    make: Callable[..., Method]
    parameters: Mapping[str, float]
    """Name and default of the parameters of ``--tune``."""


_PAPER: tuple[type[Any], ...] = (VideoOnly, Periodic, OnStart, Uncertain, Small, Utility)
_OURS: tuple[type[Any], ...] = (ExpectedGain, TracksFirst)
METHODS: Mapping[str, MethodEntry] = MappingProxyType(
    {kind.name: MethodEntry(kind, MappingProxyType(asdict(kind()))) for kind in _PAPER + _OURS}
    | {row.name: MethodEntry(lambda row=row: row, MappingProxyType({})) for row in SELECTORS}
)


def method(name: str, **parameters: float) -> Method:
    """The method of that name (case does not matter), with these parameters in place of its defaults.

    Raises `UserError` for an unknown name, an unknown parameter, or a value that is not a finite number from 0.
    """
    entry = METHODS.get({known.casefold(): known for known in METHODS}.get(name.casefold(), ""))
    if entry is None:
        raise UserError(f"method {name!r} is not known: choose one of {', '.join(METHODS)}")
    for key, value in parameters.items():
        if key not in entry.parameters:
            known = ", ".join(entry.parameters) or "none"
            raise UserError(f"method {name} has no parameter {key!r}: it has {known}")
        if not math.isfinite(value) or value < 0:
            raise UserError(f"parameter {key} of method {name} is {value!r}: write a number from 0")
    return entry.make(**parameters)


def tuning(texts: Iterable[str]) -> dict[str, float]:
    """The parameters of ``--tune KEY=VALUE`` for `method`; each text may hold several, with commas between.

    Raises `UserError` for a text that is not of that form; `method` checks that the parameters exist.
    """
    parameters: dict[str, float] = {}
    for part in (part.strip() for text in texts for part in text.split(",")):
        key, equals, value = part.partition("=")
        try:
            parameters[key.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals or not key.strip().isidentifier():
            raise UserError(f"--tune {part!r} is not accepted: write KEY=VALUE, such as min_gain=0.05")
    return parameters
