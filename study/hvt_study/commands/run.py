"""``hvt-study run``: every method at every budget on every sequence, at matched totals; table and report."""

import argparse
import logging
from contextlib import suppress
from itertools import count
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import say
from hvt_study.commands import arguments as common
from hvt_study.commands.output import RunProgress, alone, check_out, writing
from hvt_study.matrix.plan import RunRow, StudyPlan, check_parameters, first_runs, in_order, run_all, staying
from hvt_study.metrics.bits import in_accounting
from hvt_study.report.data.table_file import RESULTS, read_results, write_results
from hvt_study.report.example.choice import Example, choose_run, load_example, save_example
from hvt_study.report.example.fly_again import fly_again
from hvt_study.report.write import write_report
from hvt_study.runs.execute import runner


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The plan to compare, and where it is done and written."""
    common.add_plan_arguments(parser)
    common.option(parser, "--accounting", default="span")
    common.add_pool_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run all, and write the table and the report; the table also where something ends the study.

    Rows of an earlier table in ``--out`` stay, behind those of this study: of methods, budgets, sequences or
    conditions that this study does not have, and of runs that it was not given the time to do. Its own
    rows replace those that were there. A table that cannot be read (an older version wrote it) is set aside. Raises
    `UserError` where the plan is impossible, an earlier table has the same methods with other parameters, or every
    run failed.
    """
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    plan = common.study_plan(arguments, common.open_sequences(arguments))
    table = check_out(arguments.out, name=RESULTS)
    with writing(arguments.out), alone(arguments.out):
        check_parameters(plan, _earlier(table), out=arguments.out)
    rows = _flown(plan, arguments, table)
    others = _write(rows, plan, arguments, table)
    example = new_example(rows, plan, arguments.out)
    with alone(arguments.out):
        if example is not None:
            save_example(arguments.out, example)
        write_report(arguments.out)
    failed = [row for row in rows if row["failed"]]
    if len(failed) == len(rows):
        raise UserError(f"every run failed, the first: {_failure(failed[0])}")
    say(f"{len(rows)} runs, {len(failed)} failed: {arguments.out / 'report.html'}")
    if others:
        say(f"{others} runs of earlier studies stay beside them: for these alone name another --out")
    return 0


def _earlier(table: Path) -> list[RunRow]:
    if not table.exists():
        return []
    try:
        return read_results(table)
    except UserError as error:
        aside = table.with_name(f"earlier-{table.name}")
        try:
            table.replace(aside)
        except OSError as why:
            raise UserError(f"{table} cannot be moved ({why.strerror}): name another --out") from None
        say(f"{error}; it is {aside.name} from now on")
        return []


def _write(rows: list[RunRow], plan: StudyPlan, arguments: argparse.Namespace, table: Path) -> int:
    """Write them, and behind them the remaining rows of the present table; returns the number of those.

    They go beside a table that another study with other parameters has written since: `UserError`.
    """
    with writing(arguments.out), alone(arguments.out):
        earlier = _earlier(table)
        try:
            check_parameters(plan, earlier, out=arguments.out)
        except UserError as error:
            names = (table.with_name(f"{table.stem}-{number}{table.suffix}") for number in count(2))
            beside = next(path for path in names if not path.exists())
            write_results(in_accounting(rows, arguments.accounting), beside)
            raise UserError(f"{error}; the runs of this study are in {beside}") from None
        others = staying(rows, earlier)
        write_results(in_accounting([*rows, *others], arguments.accounting), table)
    return len(others)


def _flown(plan: StudyPlan, arguments: argparse.Namespace, table: Path) -> list[RunRow]:
    done: list[RunRow] = []
    pool, at_once = common.open_pool(arguments)
    progress = RunProgress("runs")

    def on_row(row: RunRow, count: int, of: int) -> None:
        done.append(row)
        if row["failed"]:
            progress.note(_failure(row))
        progress.update(count, of, failed=sum(bool(one["failed"]) for one in done))

    try:
        with progress, pool as workers:
            return run_all(plan, pool=workers, run=runner(plan.cache), at_once=at_once, on_row=on_row)
    except BaseException as ended:
        if done:
            try:
                others = _write(in_order(plan, done), plan, arguments, table)
            except UserError as error:
                if not isinstance(ended, UserError):  # a full disk is told once
                    progress.note(str(error))
            else:
                beside = f", and {others} of before" if others else ""
                progress.note(
                    f"{len(done)} finished runs are in {table}{beside}; the same command goes on from there"
                )
        raise


def _failure(row: RunRow) -> str:
    matching = (
        f" at the bits of {row['matched_to']} {row['matched_codec']}".rstrip() if row["matched_to"] else ""
    )
    method = f"{row['method']} {row['still_codec']}".rstrip()
    return f"{method}{matching} on {row['sequence']}, {row['regime']}, failed: {row['failed']}"


def new_example(rows: list[RunRow], plan: StudyPlan, folder: Path) -> Example | None:
    """The report shows one flight in pictures; it is flown again for them, unless the folder has it."""
    choice = choose_run(rows)
    if choice is None:
        return None
    digest = next(row["digest"] for row in rows if row["key"] == choice.key)
    known = None
    with suppress(UserError):  # one that was cut off is made again
        known = load_example(folder)
    if known is not None and (known.key, known.digest, known.rule) == (choice.key, digest, choice.rule):
        return None
    spec = next(one for one in first_runs(plan) if one.key == choice.key)
    return fly_again(spec, plan, rule=choice.rule)
