"""Parts that other packages install behind an entry point: found by name, loaded when named, never a traceback."""

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, cast

from hvt_common.errors import UserError, foreign, needs_extra, not_installed
from hvt_common.runtime.failures import Failures


@cache  # unknown names come from the network too, and a search of all packages takes tens of milliseconds
def installed(group: str) -> dict[str, tuple[EntryPoint, ...]]:
    """The entry points of a group by name; more than one where two packages bring the same name."""
    # One installed package can be found twice, by two paths of sys.path: same value, same part.
    found: dict[str, dict[str, EntryPoint]] = {}
    for entry in entry_points(group=group):
        found.setdefault(entry.name, {}).setdefault(entry.value, entry)
    return {name: tuple(entries.values()) for name, entries in found.items()}


def the_one(group: str, name: str, *, what: str, built_in: bool) -> EntryPoint | None:
    """The entry point of that name, or None; the sentence of an error calls it ``what``.

    Raises:
        UserError: several packages bring it, or HVT has one of that name itself (``built_in``).
    """
    found = installed(group).get(name, ())
    if found and built_in:
        raise UserError(
            f"{what} {name!r} is built in, and {origin(found[0])} brings another of that name: "
            "remove that package"
        )
    if len(found) > 1:
        raise UserError(
            f"{what} {name!r} comes from both {origin(found[0])} and {origin(found[1])}: remove one of them"
        )
    return found[0] if found else None


def loaded(entry: EntryPoint, make: Callable[[Any], Any], *, what: str, install: str | None = None) -> Any:
    """The result of ``make`` for the entry's object; `UserError` for whatever foreign code raises.

    Where a package is missing that the object needs, it names ``install``, such as ``'hvt[ground]'``.
    """
    try:
        with needs_extra(install) if install else nullcontext():
            part = entry.load()
        return make(part)
    except UserError:  # its own sentence
        raise
    except foreign() as error:
        raise UserError(
            f"{what} {entry.name!r} of {origin(entry)} does not load: {type(error).__name__}: {error}"
        ) from error


def origin(entry: EntryPoint) -> str:
    """The package that brings it, and the object in it."""
    return f"package {entry.dist.name} ({entry.value})" if entry.dist is not None else entry.value


def brought(
    group: str,
    name: str,
    *,
    what: str,
    option: str,
    package: str,
    make: Callable[[Any], Any] = lambda found: found,
) -> Any:
    """The result of ``make`` for an extra's object; `UserError` without it: ``option`` takes ``package``."""
    entry = the_one(group, name, what=what, built_in=False)
    if entry is None:
        raise not_installed(option, package)
    return loaded(entry, make, what=what, install=f"'{package}'")


def library_part(side: str, name: str) -> Any:
    """The function of that name with which another program runs a side; `UserError` without its extra."""
    return brought("hvt.library", side, what="library", option=f"hvt_{side}.{name}", package=f"hvt[{side}]")


def extra_command(side: str, words: Sequence[str], *, known: Collection[str]) -> Callable[[], int] | None:
    """The command of an extra that a command line of ``hvt-edge`` or ``hvt-ground`` begins with; None for others.

    It returns the exit code. Raises `UserError` for one of the ``known``, which come with HVT, without its extra.
    """
    name, group = words[0] if words else "", f"hvt.{side}_commands"
    if name in known:
        run = brought(group, name, what="command", option=f"hvt-{side} {name}", package=f"hvt[{side}]")
    elif not name.startswith("-") and (entry := the_one(group, name, what="command", built_in=False)):
        run = loaded(entry, lambda found: found, what="command")
    else:
        return None
    return lambda: int(run(words[1:]))


def health_server(
    side: Literal["edge", "ground"],
    address: str,
    newest: Callable[[], Any],
    *,
    clock: Callable[[], int],
    stuck_s: float,
    failures: Failures,
    lacks: Callable[[Any], str] = lambda _state: "",
) -> AbstractContextManager[object]:
    """A server of a program's ``newest()`` state (None: none yet) at HOST:PORT while the context lasts.

    After ``stuck_s`` without a newer state the program counts as stuck; ``lacks(state)`` says why a living program is
    not ready, empty if it is. Raises `UserError` where nothing can ever listen on the address, or the extra is not
    installed.
    """
    # Only now: who is not watched needs no Prometheus.
    serve = brought("hvt.health", side, what="health server", option="--metrics", package="hvt[metrics]")
    server = serve(address, newest, clock=clock, stuck_s=stuck_s, failures=failures, lacks=lacks)
    return cast("AbstractContextManager[object]", server)
