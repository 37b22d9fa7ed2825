"""``hvt-study``: the command line of the study."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import NoReturn

from hvt_common.errors import UserError, exit_with_sentence
from hvt_study.commands import COMMANDS

__all__ = ["main"]

_PROGRAM = "hvt-study"
_INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """Says what is wrong with the arguments in one sentence, without the usage above it."""

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see {self.prog} --help")


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``hvt-study``; 0, or 2 after one sentence on stderr where the user can mend something.

    130, as of a shell, where the user has interrupted it.
    """
    try:
        return exit_with_sentence(_run, program=_PROGRAM, argv=argv)
    except KeyboardInterrupt:
        print(f"{_PROGRAM}: interrupted", file=sys.stderr)
        return _INTERRUPTED


def _run(argv: Sequence[str] | None) -> int:
    parser = _Parser(prog=_PROGRAM, description="Experiments with the stages of HVT, without a network.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        own = commands.add_parser(
            name,
            help=command.SUMMARY,
            description=command.SUMMARY,
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        )
        command.add_arguments(own)
    arguments = parser.parse_args(argv)
    return COMMANDS[arguments.command].run(arguments)
