"""The subcommands of ``hvt-study``, one file each.

A subcommand is a module with `SUMMARY`, `add_arguments` and `run`; `COMMANDS` is the list of them, by name.
"""

from __future__ import annotations

import argparse
from typing import Final, Protocol

from hvt_study.commands import compare as sight
from hvt_study.commands import plan, report, run, score, sweep, track, tune

__all__ = ["COMMANDS", "Command"]


class Command(Protocol):
    """What `hvt_study.cli` needs of a subcommand's module."""

    SUMMARY: str
    """One line for ``hvt-study --help``."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the subcommand's own arguments."""

    def run(self, arguments: argparse.Namespace) -> int:
        """Do it; the exit code. What the user can mend is a `hvt_common.errors.UserError`."""


COMMANDS: Final[dict[str, Command]] = {
    "plan": plan,
    "run": run,
    "report": report,
    "tune": tune,
    "score": score,
    "sight": sight,
    "sweep": sweep,
    "track": track,
}
