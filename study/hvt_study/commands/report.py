"""``hvt-study report``: the pages and figures of a study, made again from its table."""

import argparse
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.runtime.reporting import say
from hvt_study.commands.arguments import option
from hvt_study.commands.output import alone
from hvt_study.report.write import join_studies, write_report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The study's folder, or several that are to be one."""
    parser.add_argument(
        "folders",
        nargs="+",
        type=Path,
        metavar="DIR",
        help="with results.parquet; sweep.csv of hvt-study sweep is taken in where it is there",
    )
    there = (
        "write there, with one results.parquet of all; needed where there are several (default: DIR itself)"
    )
    option(parser, "--out", required=False, help=there)
    option(parser, "--accounting")


def run(arguments: argparse.Namespace) -> int:
    out: Path | None = getattr(arguments, "out", None)
    if out is None and len(arguments.folders) > 1:
        raise UserError(
            f"{len(arguments.folders)} studies are given, and no place for the one: add --out DIR"
        )
    where = arguments.folders[0] if out is None else out
    with alone(where):
        if out is not None:
            join_studies(arguments.folders, out)
        write_report(where, accounting=getattr(arguments, "accounting", None))
    say(str(where / "report.html"))
    return 0
