"""What commands print, and what they write into ``--out``."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table

from hvt_common.errors import FlightError, UserError
from hvt_common.runtime.reporting import check_writable

_WIDTH = 100


def print_columns(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    words: Collection[str],
    gap: int = 0,
    caption: str | None = None,
) -> None:
    """Print a table; the columns of these heads hold ``words``, the others figures, flush right.

    Without a ``gap`` between its columns it has a frame.
    """
    frame: dict[str, Any] = {"box": None, "padding": (0, gap, 0, 0), "pad_edge": False} if gap else {}
    table = Table(title=title, title_justify="left", title_style="bold", caption=caption, **frame)
    table.caption_justify = "left"
    for head in heads:
        word = head in words
        side: Literal["left", "right"] = "left" if word else "right"
        table.add_column(head, justify=side, style="cyan" if word else None, no_wrap=bool(gap))
    for row in rows:
        table.add_row(*row)
    _console().print(table)


def print_lines(*lines: str) -> None:
    """Print text as it is, whatever its length."""
    for line in lines:
        _console().print(line, soft_wrap=True)


def decimals(value: float | None, digits: int = 3) -> str:
    """A figure, a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def share(value: float | None, digits: int = 3) -> str:
    """The same of what is from 0 to 1, without its 0."""
    return decimals(value, digits).replace("0.", ".", 1)


def make_out(folder: Path, *, name: str) -> Path:
    """The file of that name in ``--out``, which is made; `UserError` now where it could not be written later."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out {folder} cannot be made ({error.strerror}): name a folder") from None
    check_writable(folder / name, name="--out")
    return folder / name


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Within it, what cannot be written is a `UserError` that names ``--out``."""
    try:
        yield
    except (OSError, FlightError) as error:
        cause = error if isinstance(error, OSError) else error.__cause__
        why = cause.strerror if isinstance(cause, OSError) else error
        raise UserError(f"--out {folder} cannot be written ({why}): name another") from None


def _console() -> Console:
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:  # a file has room for every column
        console.width = max(console.width, _WIDTH)
    return console
