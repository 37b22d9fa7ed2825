"""Search for a method's parameters on some sequences, and say what they are worth on others.

Optuna's TPE sampler (Bergstra et al. 2011) proposes, every proposal is flown over all training sequences, and the
worth of a flight is the share of all labelled objects that are shown with their class, at all frames. The sequences
that are held out are flown twice, once as the method is and once with the best that was found, and no proposal hangs
on either. The search begins with the defaults, and where nothing is better it ends with them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import optuna

from hvt_common.errors import UserError
from hvt_edge.stills.policy.registry import METHODS
from hvt_study.matrix.plan import StudyPlan, spec_of
from hvt_study.matrix.schedule import Pool
from hvt_study.matrix.tuning import tuning_texts
from hvt_study.runs.execute import run_spec
from hvt_study.runs.methods import METHODS as FLOWN

_REACH = 4.0
"""A parameter is looked for between its default over this and its default times this, on a logarithmic scale."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """One sequence that the search has not seen."""

    dataset: str
    sequence: str
    regime: str
    default: float
    """Worth with the method's defaults, 0…1."""
    tuned: float
    default_bps: int
    tuned_bps: int


@dataclass(frozen=True, slots=True)
class Tuned:
    """What the search found."""

    method: str
    parameters: Mapping[str, float]
    train_default: float
    """Mean worth over the training flights with the defaults."""
    train_tuned: float
    trials: int
    held_out: tuple[HeldOut, ...]

    @property
    def gain(self) -> float:
        """Mean gain on what was held out: this alone says whether the search found anything."""
        return sum(one.tuned - one.default for one in self.held_out) / len(self.held_out)


def tunable(method: str, names: Iterable[str] = ()) -> dict[str, float]:
    """The parameters to search, with their defaults; all of the method's where none is named.

    Raises `UserError` where the method has none, or not one of these.
    """
    having = {
        name: {key: value for key, value in METHODS[name].parameters.items() if value > 0}
        for name, one in FLOWN.items()
        if one.sends_stills
    }
    known = having.get(method)
    if not known:
        choice = ", ".join(name for name, found in having.items() if found)
        raise UserError(f"--method {method} has nothing to tune: choose one of {choice}")
    for name in names:
        if name not in known:
            raise UserError(f"--parameters {name!r} is not one of {method}: it has {', '.join(known)}")
    return {name: known[name] for name in names} or known


def split(
    sequences: Sequence[tuple[str, str]], *, held_out: float
) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """(training, held out), by a hash of the name: the same sequences in every run, whatever else is in the set.

    Raises `UserError` where there are not two sequences, or the share leaves one side empty.
    """
    if len(sequences) < 2 or not 0 < held_out < 1:
        raise UserError(
            f"{len(sequences)} sequences with --held-out {held_out:g} cannot be split: give two or more, and "
            "a share between 0 and 1"
        )
    order = sorted(sequences, key=lambda one: hashlib.sha256(one[1].encode()).digest())
    count = min(len(order) - 1, max(1, round(held_out * len(order))))
    chosen = set(order[:count])
    return [one for one in sequences if one not in chosen], [one for one in sequences if one in chosen]


def tune(
    plan: StudyPlan,
    *,
    method: str,
    parameters: Mapping[str, float],
    train: Sequence[tuple[str, str]],
    held_out: Sequence[tuple[str, str]],
    trials: int,
    pool: Pool,
    seed: int = 0,
    on_trial: Callable[[int, float, float], None] = lambda *_: None,
) -> Tuned:
    """Search; ``on_trial(number, worth, best)`` is called after each.

    Raises `UserError` where the method cannot be flown with its defaults.
    """
    desk = _Desk(plan, method, pool)
    default = desk.mean_worth(train, ())
    as_it_is = desk.rows(held_out, ())  # what cannot be flown is told before the search, not after
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    search.add_trial(_known(parameters, default))
    for number in range(trials):
        trial = search.ask()
        worth = desk.mean_worth(train, tuning_texts(_proposed(trial, parameters)))
        search.tell(trial, worth)
        on_trial(number + 1, worth, search.best_value)
    better = search.best_trial.number > 0  # the first is the defaults
    best = (
        {name: _rounded(value) for name, value in search.best_params.items()} if better else dict(parameters)
    )
    return Tuned(
        method=method,
        parameters=best,
        train_default=default,
        train_tuned=search.best_value,
        trials=trials,
        held_out=tuple(_pairs(as_it_is, desk.rows(held_out, tuning_texts(best) if better else ()))),
    )


@dataclass(frozen=True, slots=True)
class _Desk:
    """Flies one method with some parameters over some sequences."""

    plan: StudyPlan
    method: str
    pool: Pool

    def mean_worth(self, sequences: Sequence[tuple[str, str]], texts: tuple[str, ...]) -> float:
        rows = self.rows(sequences, texts)
        return sum(_worth(row) for row in rows) / len(rows)

    def rows(self, sequences: Sequence[tuple[str, str]], texts: tuple[str, ...]) -> list[dict[str, Any]]:
        plan = self.plan
        specs = [
            replace(
                spec_of(plan, dataset, sequence, FLOWN[self.method], regime, models, plan.still_codecs[0]),
                tune=texts,
            )
            for dataset, sequence in sequences
            for models in plan.models
            for regime in plan.regimes
        ]
        run = partial(run_spec, cache=plan.cache, folder=Path.cwd())  # as of workers started elsewhere
        rows = [future.result() for future in [self.pool.submit(run, spec) for spec in specs]]
        for row in rows:
            if row["failed"] and not texts:
                raise UserError(f"{self.method} cannot be flown over {row['sequence']}: {row['failed']}")
        return rows


def _known(parameters: Mapping[str, float], worth: float) -> optuna.trial.FrozenTrial:
    """What the defaults are worth, which is known before the first proposal."""
    ranges: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(*_range(default), log=True)
        for name, default in parameters.items()
    }
    return optuna.trial.create_trial(params=dict(parameters), distributions=ranges, value=worth)


def _proposed(trial: optuna.Trial, parameters: Mapping[str, float]) -> dict[str, float]:
    return {
        name: _rounded(trial.suggest_float(name, *_range(default), log=True))
        for name, default in parameters.items()
    }


def _range(default: float) -> tuple[float, float]:
    return default / _REACH, default * _REACH


def _rounded(value: float) -> float:
    """Three digits: what can be typed, and is what was flown."""
    return float(f"{value:.3g}")


def _worth(row: Mapping[str, Any]) -> float:
    return 0.0 if row["failed"] or row["named_f1"] is None else float(row["named_f1"])


def _pairs(default: Sequence[Mapping[str, Any]], tuned: Sequence[Mapping[str, Any]]) -> Iterable[HeldOut]:
    for one, other in zip(default, tuned, strict=True):
        yield HeldOut(
            dataset=one["dataset"],
            sequence=one["sequence"],
            regime=one["regime"],
            default=_worth(one),
            tuned=_worth(other),
            default_bps=one["total_bps"] or 0,
            tuned_bps=other["total_bps"] or 0,
        )
