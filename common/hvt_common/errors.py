"""The one error that a user is meant to read."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

__all__ = ["UserError", "exit_with_sentence", "needs_extra"]


class UserError(Exception):
    """Something the user can mend: one sentence that names the thing, its value and what is accepted.

    Command-line tools print it without a traceback and exit with code 2. Raise it only for what comes from
    outside (arguments, files, the machine); a wrong value between our own functions is a bug and crashes
    loudly.
    """


def exit_with_sentence(
    run: Callable[[Sequence[str] | None], int], *, program: str, argv: Sequence[str] | None
) -> int:
    """Return the exit code of ``run(argv)``; a `UserError` becomes one sentence on stderr and code 2."""
    try:
        return run(argv)
    except UserError as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2


@contextmanager
def needs_extra(install: str) -> Iterator[None]:
    """Within it a missing package is a `UserError` that names what to ``pip install``, such as ``'hvt[study]'``."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("hvt_"):
            raise
        raise UserError(f"the package {error.name!r} is missing: pip install {install}") from None
