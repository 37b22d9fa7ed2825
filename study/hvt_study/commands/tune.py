"""``hvt-study tune``: better weights for a method, judged on sequences that the search has not seen."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import write_json
from hvt_study.commands.arguments import (
    add_plan_arguments,
    add_pool_arguments,
    check_whole,
    names_of,
    open_pool,
    open_sequences,
    study_plan,
)
from hvt_study.commands.output import RunProgress, make_out, print_columns, print_lines, writing
from hvt_study.matrix.tune import Tuned, split, tunable, tune

_MOST_TRIALS = 100_000
_HIGHEST_SEED = 2**32 - 1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Those of ``run``, and what to search."""
    add_plan_arguments(parser, methods=False)
    add_pool_arguments(parser)
    parser.add_argument("--method", required=True, help="the one to tune, such as M5")
    add = parser.add_argument
    add("--parameters", default="", metavar="NAME,…", help="which of its parameters (default: all)")
    add("--trials", type=int, default=40, metavar="N", help="proposals that are flown")
    add(
        "--held-out", type=float, default=0.34, metavar="SHARE", help="of the sequences, for the report alone"
    )
    add("--seed", type=int, default=0, help="of the search")


def run(arguments: argparse.Namespace) -> int:
    """Search, print, write tune.json."""
    check_whole("--trials", arguments.trials, 1, _MOST_TRIALS)
    check_whole("--seed", arguments.seed, 0, _HIGHEST_SEED)
    parameters = tunable(arguments.method, names_of(arguments.parameters))
    plan = study_plan(arguments, open_sequences(arguments))
    if len(plan.still_codecs) > 1:
        raise UserError(
            f"--still-codecs {arguments.still_codecs} are several: parameters are searched for one, name it"
        )
    train, held_out = split(plan.sequences, held_out=arguments.held_out)
    written = make_out(arguments.out, name="tune.json")
    pool, _ = open_pool(arguments)
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
        write_json(written, {**asdict(found), "held_out_gain": found.gain})
    _print(found, written)
    return 0


def _print(found: Tuned, written: Path) -> None:
    rows = (
        (
            *(one.sequence, one.regime, f"{one.default:.4f}", f"{one.tuned:.4f}"),
            *(f"{one.default_bps / 1e3:.0f}", f"{one.tuned_bps / 1e3:.0f}"),
        )
        for one in found.held_out
    )
    heads = ("sequence", "regime", "default", "tuned", "kbps", "kbps")
    title = "held out: objects shown with their class, of all"
    print_columns(title, heads, rows, words=("sequence", "regime"), gap=2)
    flags = ",".join(f"{name}={value:g}" for name, value in found.parameters.items())
    print_lines(
        f"training {found.train_default:.4f} to {found.train_tuned:.4f}, held out {found.gain:+.4f}: "
        f"--method {found.method} --tune {flags}",
        f"against video of the same bits: hvt-study run … --methods M0,{found.method} --tune {written}",
    )
