"""``hvt-ground keys``: a CA for the fleet, keys for each machine, and the Zenoh configurations that go with them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hvt_common.errors import UserError
from hvt_common.report import say
from hvt_ground.fleet.roster import Ground, Roster
from hvt_ground.fleet.zenoh_files import KEYS_FOLDER, edge_file, ground_file

__all__ = ["run"]

_DIR = Path("hvt-keys")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; see {self.prog} --help")


def run(argv: Sequence[str]) -> int:
    """Run ``hvt-ground keys …``; `UserError` where the user can mend something."""
    arguments = _parser().parse_args(argv)
    try:  # only now: a ground that uses no keys needs no cryptography
        from hvt_ground.fleet.authority import Authority  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise UserError(
            f"the package {error.name!r} is missing: install HVT with its extra, 'hvt[ground]'"
        ) from None
    folder: Path = arguments.dir
    if arguments.command == "new-ca":
        Authority.create(folder)
        say(
            f"{folder}/ca.pem is the fleet's CA; {folder}/ca.key signs for all of it: keep it on this machine"
        )
        return 0
    authority = Authority.open(folder)
    roster = Roster.read(folder)
    if arguments.command == "add-edge":
        roster = roster.with_edge(arguments.name)
        authority.issue(arguments.name)
    elif arguments.command == "add-ground":
        ground = Ground(arguments.name, tuple(arguments.host), command=not arguments.watch_only)
        roster = roster.with_ground(ground)
        authority.issue(arguments.name, hosts=arguments.host)
    if arguments.command != "list":
        roster.write(folder)
        _write_files(roster, folder, keys_folder=arguments.keys_folder)
        name = arguments.name
        say(f"{name}: copy ca.pem, {name}.pem, {name}.key and {name}.json5 from {folder} to the machine")
        _say_others(roster, name, edge=arguments.command == "add-edge")
    else:
        _list(roster)
    return 0


def _write_files(roster: Roster, folder: Path, *, keys_folder: str) -> None:
    files = {name: edge_file(name, roster, folder=keys_folder) for name in roster.edges}
    files |= {one.name: ground_file(one, roster, folder=keys_folder) for one in roster.grounds}
    for name, text in files.items():
        path = folder / f"{name}.json5"
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise UserError(f"{path} cannot be written ({error.strerror})") from None


def _say_others(roster: Roster, name: str, *, edge: bool) -> None:
    others = [one.name for one in roster.grounds] if edge else list(roster.edges)
    if others:
        files = ", ".join(f"{one}.json5" for one in others)
        say(f"{files}: written anew, because {name} is in them; copy them again")


def _list(roster: Roster) -> None:
    for edge in roster.edges:
        print(f"edge    {edge}")
    for ground in roster.grounds:
        rights = "watches and commands" if ground.command else "watches"
        print(f"ground  {ground.name}  {rights}  {' '.join(ground.hosts)}".rstrip())


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="hvt-ground keys", description=__doc__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    new_ca = commands.add_parser("new-ca", help="make the CA of a fleet, once")
    add_edge = commands.add_parser("add-edge", help="a key for an edge; NAME is its --edge-id")
    add_ground = commands.add_parser("add-ground", help="a key for a ground")
    listing = commands.add_parser("list", help="who belongs to the fleet")
    for one in (new_ca, add_edge, add_ground, listing):
        one.add_argument("--dir", type=Path, default=_DIR, help="folder of the fleet's keys [hvt-keys]")
    for one in (add_edge, add_ground):
        one.add_argument("name", metavar="NAME")
        one.add_argument(
            "--keys-folder", default=KEYS_FOLDER, help=f"where the keys lie on that machine [{KEYS_FOLDER}]"
        )
    add_ground.add_argument(
        "--host", action="append", required=True, help="name or address that edges connect to; repeatable"
    )
    add_ground.add_argument("--watch-only", action="store_true", help="without the right to command")
    return parser
