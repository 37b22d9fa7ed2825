"""``hvt-study tune``: better weights for a method, judged on sequences that the search has not seen."""

import argparse
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import optuna

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_edge.stills.policy.registry import METHODS
from hvt_study.commands import arguments as common
from hvt_study.commands.output import RunProgress, check_out, print_columns, print_lines, writing
from hvt_study.matrix.plan import StudyPlan, spec_of
from hvt_study.matrix.tuning import tuning_texts
from hvt_study.report.data.arms import picture_of
from hvt_study.runs.execute import runner
from hvt_study.runs.methods import METHODS as FLOWN

_REACH = 4.0
"""A parameter is looked for between its default over this and its default times this, on a logarithmic scale."""


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

    Of several over one picture (`picture_of`) none goes to the other side. Raises `UserError` where there are not two
    names, or the share leaves one side empty.
    """
    names = [picture_of(f"{uri}#{name}").rpartition("#")[2] for uri, name in sequences]
    order = sorted(set(names), key=lambda name: hashlib.sha256(name.encode()).digest())
    if len(order) < 2 or not 0 < held_out < 1:
        of = "" if len(order) == len(names) else f" of {len(order)} pictures"
        raise UserError(
            f"{len(names)} sequences{of} with --held-out {held_out:g} cannot be split: give two or more, and "
            "a share between 0 and 1"
        )
    count = min(len(order) - 1, max(1, round(held_out * len(order))))
    sides: tuple[list[tuple[str, str]], list[tuple[str, str]]] = ([], [])
    for one, name in zip(sequences, names, strict=True):
        sides[name in order[:count]].append(one)
    return sides


def tune(
    plan: StudyPlan,
    *,
    method: str,
    parameters: Mapping[str, float],
    train: Sequence[tuple[str, str]],
    held_out: Sequence[tuple[str, str]],
    trials: int,
    pool: Executor,
    seed: int = 0,
    on_trial: Callable[[int, float, float], None] = lambda *_: None,
) -> dict[str, Any]:
    """Search, and return the content of ``tune.json``; ``on_trial(number, worth, best)`` is called after each.

    Only ``held_out_gain``, the mean gain on sequences that the search has not seen, tells whether the result is
    better. Raises `UserError` where the method cannot be flown with its defaults.
    """

    def mean_worth(texts: tuple[str, ...]) -> float:
        rows = _flown(plan, method, pool, train, texts)
        return sum(map(_worth, rows)) / len(rows)

    default = mean_worth(())
    as_it_is = _flown(plan, method, pool, held_out, ())  # an impossible flight fails before the search
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=seed))
    search.add_trial(_known(parameters, default))
    for number in range(trials):
        trial = search.ask()
        worth = mean_worth(tuning_texts(_proposed(trial, parameters)))
        search.tell(trial, worth)
        on_trial(number + 1, worth, search.best_value)
    better = search.best_trial.number > 0  # the first is the defaults
    best = (
        {name: _rounded(value) for name, value in search.best_params.items()} if better else dict(parameters)
    )
    tuned = _flown(plan, method, pool, held_out, tuning_texts(best) if better else ())
    pairs = [
        {
            **{name: one[name] for name in ("dataset", "sequence", "regime")},
            "default": _worth(one),
            "tuned": _worth(other),
            "default_bps": one["total_bps"] or 0,
            "tuned_bps": other["total_bps"] or 0,
        }
        for one, other in zip(as_it_is, tuned, strict=True)
    ]
    return {
        "method": method,
        "parameters": best,
        "train_default": default,  # mean worth over the training flights
        "train_tuned": search.best_value,
        "trials": trials,
        "held_out": pairs,
        "held_out_gain": sum(one["tuned"] - one["default"] for one in pairs) / len(pairs),
    }


def _flown(
    plan: StudyPlan,
    method: str,
    pool: Executor,
    sequences: Sequence[tuple[str, str]],
    texts: tuple[str, ...],
) -> list[dict[str, Any]]:
    """The rows of one method with some parameters over some sequences."""
    specs = [
        replace(
            spec_of(plan, dataset, sequence, FLOWN[method], regime, models, plan.still_codecs[0]), tune=texts
        )
        for dataset, sequence in sequences
        for models in plan.models
        for regime in plan.regimes
    ]
    run = runner(plan.cache)
    rows = [future.result() for future in [pool.submit(run, spec) for spec in specs]]
    for row in rows:
        if row["failed"] and not texts:
            raise UserError(f"{method} cannot be flown over {row['sequence']}: {row['failed']}")
        if not row["failed"] and row["recall"] is None:
            raise UserError(f"{row['sequence']} has no object that counts, to tune for: leave it out")
    return rows


def _known(parameters: Mapping[str, float], worth: float) -> optuna.trial.FrozenTrial:
    """The worth of the defaults, which is known before the first proposal."""
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
    """Three digits, which can be typed and are flown."""
    return float(f"{value:.3g}")


def _worth(row: Mapping[str, Any]) -> float:
    figure = row["recall"] if row["named_f1"] is None else row["named_f1"]  # of one target
    return 0.0 if row["failed"] else float(figure or 0.0)


_MOST_TRIALS = 100_000
_HIGHEST_SEED = 2**32 - 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    common.add_plan_arguments(parser, methods=False)
    common.add_pool_arguments(parser)
    parser.add_argument("--method", required=True, help="method to tune, such as M5")
    add = parser.add_argument
    add("--parameters", metavar="NAME,…", help="which of its parameters (default: all)")
    add("--trials", type=int, default=40, metavar="N", help="sets of parameters to try")
    add(
        "--held-out",
        type=float,
        default=0.34,
        metavar="SHARE",
        help="share of sequences for the report alone",
    )
    add("--seed", type=int, default=0, help="seed of the search")


def run(arguments: argparse.Namespace) -> int:
    common.check_whole("--trials", arguments.trials, 1, _MOST_TRIALS)
    common.check_whole("--seed", arguments.seed, 0, _HIGHEST_SEED)
    parameters = tunable(arguments.method, common.names_of(arguments.parameters))
    sequences = common.open_sequences(arguments)
    plan = common.study_plan(arguments, sequences)
    if len(plan.still_codecs) > 1:
        raise UserError(
            f"--still-codecs {arguments.still_codecs} are several: parameters are searched for one, name it"
        )
    train, held_out = split(plan.sequences, held_out=arguments.held_out)
    written = check_out(arguments.out, name="tune.json")
    pool, _ = common.open_pool(arguments)
    progress = RunProgress(f"{arguments.method}, trials")

    def on_trial(number: int, worth: float, best: float) -> None:
        progress.note(f"trial {number}: {worth:.4f}, best {best:.4f}")
        progress.update(number, arguments.trials)

    with progress, pool as workers:
        found = tune(
            plan,
            method=arguments.method,
            parameters=parameters,
            train=train,
            held_out=held_out,
            trials=arguments.trials,
            pool=workers,
            seed=arguments.seed,
            on_trial=on_trial,
        )
    with writing(arguments.out):
        write_json(written, found)
    _print(found, written)
    return 0


def _print(found: Mapping[str, Any], written: Path) -> None:
    rows = (
        (
            *(one["sequence"], one["regime"], f"{one['default']:.4f}", f"{one['tuned']:.4f}"),
            *(f"{one['default_bps'] / 1e3:.0f}", f"{one['tuned_bps'] / 1e3:.0f}"),
        )
        for one in found["held_out"]
    )
    heads = ("sequence", "regime", "default", "tuned", "kbps", "kbps")
    title = "held out: named F1; of one target recall"
    print_columns(title, heads, rows, words=("sequence", "regime"), gap=2)
    flags = ",".join(f"{name}={value:g}" for name, value in found["parameters"].items())
    print_lines(
        f"training {found['train_default']:.4f} to {found['train_tuned']:.4f}, "
        f"held out {found['held_out_gain']:+.4f}: --method {found['method']} --tune {flags}",
        f"against video of the same bits: hvt-study run … --methods M0,{found['method']} --tune {written}",
    )
