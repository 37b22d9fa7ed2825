"""``hvt-study run``: every method at every budget on every sequence, at matched totals."""

from __future__ import annotations

import argparse

from hvt_common.errors import UserError
from hvt_study.commands.arguments import add_accounting, add_plan_arguments, add_pool_arguments

__all__ = ["SUMMARY", "add_arguments", "run"]

SUMMARY = (
    "Fly every method at every budget on datasets, at matched totals; write results.parquet and a report."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to compare, and where it is done and written."""
    add_plan_arguments(parser)
    add_accounting(parser, default="span")
    add_pool_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run all, write the table and the report."""
    try:
        from hvt_study.commands.run_study import run_study  # noqa: PLC0415 - the other commands do without
    except ImportError as error:
        raise UserError(f"a study needs {error.name}: pip install 'hvt[study]'") from None
    return run_study(arguments)
