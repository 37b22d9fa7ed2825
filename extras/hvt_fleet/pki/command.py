"""``hvt-ground keys``: a CA for the fleet, keys for each machine, and the Zenoh configurations that go with them."""

from __future__ import annotations

import argparse
import datetime as dt
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hvt_common.errors import Parser, UserError, needs_extra, telling
from hvt_common.runtime.reporting import say
from hvt_fleet.pki.roster import GroundMember, Roster, RouterMember
from hvt_fleet.pki.zenoh_files import KEYS_FOLDER, edge_file, ground_file, router_file

if TYPE_CHECKING:
    from hvt_fleet.pki.authority import Authority

_DIR = Path("hvt-keys")


def run(argv: Sequence[str]) -> int:
    """Run ``hvt-ground keys …``; `UserError` where the user can mend something."""
    arguments = _parser().parse_args(argv)
    with needs_extra("'hvt[ground]'"):  # only now: a ground that uses no keys needs no cryptography
        from hvt_fleet.pki.authority import MACHINE_DAYS, Authority  # noqa: PLC0415
    folder: Path = arguments.dir
    if arguments.command == "new-ca":
        Authority.create(folder)
        say(
            f"{folder}/ca.pem is the fleet's CA; {folder}/ca.key signs for all of it: keep it on this machine"
        )
        return 0
    authority = Authority.open(folder)
    if authority.until < dt.datetime.now(dt.UTC) + dt.timedelta(days=MACHINE_DAYS):
        say(
            f"the CA in {folder} ends on {authority.until:%Y-%m-%d}, and its keys with it: make another one in time, "
            "with new-ca in another --dir, and new keys for all machines"
        )
    before = Roster.read(folder)
    if arguments.command == "list":
        _list(before, authority)
        return 0
    name: str = arguments.name
    if arguments.command == "renew":
        known = _hosts_of(before, name)  # first of all: a machine that nobody knows may be the CA
        hosts = tuple(arguments.host) or known
        authority.issue(name, hosts=hosts)
        say(f"{name}: copy {name}.pem and {name}.key from {folder} to the machine")
        if hosts != known:  # the next renewal would go back to where it was
            after = before.with_hosts(name, hosts)
            after.write(folder)
            _write_files(after, folder, given={})
        return 0
    after = _changed(before, arguments)
    if arguments.command == "remove":
        authority.forget(name)
    else:
        authority.issue(name, hosts=arguments.host)
    after.write(folder)
    keys_folder = None if arguments.command == "remove" else arguments.keys_folder
    changed = _write_files(after, folder, given={} if keys_folder is None else {name: keys_folder})
    if arguments.command != "remove":
        say(f"{name}: copy ca.pem, {name}.pem, {name}.key and {name}.json5 from {folder} to the machine")
    if others := ", ".join(f"{one}.json5" for one in changed if one != name):
        say(f"changed with it, copy again and restart what uses them: {others}")
    return 0


def _changed(roster: Roster, arguments: argparse.Namespace) -> Roster:
    name: str = arguments.name
    if arguments.command == "add-edge":
        return roster.with_edge(name)
    if arguments.command != "remove":
        _refuse_known(roster, name, kind=arguments.command.removeprefix("add-"))
    if arguments.command == "add-router":
        return roster.with_router(RouterMember(name, tuple(arguments.host)))
    if arguments.command == "add-ground":
        command = not arguments.watch_only
        return roster.with_ground(
            GroundMember(name, tuple(arguments.host), command=command, edges=arguments.edges)
        )
    return roster.without(name)


def _refuse_known(roster: Roster, name: str, *, kind: str) -> None:
    """A key that is only to be renewed must not come with other rights, or without its host names."""
    if roster.names.get(name) == kind:
        raise UserError(
            f"{name!r} is in this fleet already: hvt-ground keys renew {name} makes a new key with the same rights; "
            "for other rights remove it first"
        )


def _hosts_of(roster: Roster, name: str) -> tuple[str, ...]:
    """Where others connect to a machine of the roster."""
    if name not in roster.names:
        raise UserError(f"{name!r} is not in this fleet: hvt-ground keys list shows who is")
    machines: list[GroundMember | RouterMember] = [*roster.grounds, *roster.routers]
    return next((one.hosts for one in machines if one.name == name), ())


def _write_files(roster: Roster, folder: Path, *, given: Mapping[str, str]) -> list[str]:
    """The names of those whose file is new or another than before.

    The keys of each machine lie where ``given`` says, or where its file has said so far.
    """

    def where(name: str) -> str:
        return given.get(name) or _keys_folder(folder / f"{name}.json5")

    files = {name: edge_file(name, roster, folder=where(name)) for name in roster.edges}
    files |= {one.name: ground_file(one, roster, folder=where(one.name)) for one in roster.grounds}
    files |= {one.name: router_file(one, roster, folder=where(one.name)) for one in roster.routers}
    changed = []
    for name, text in files.items():
        path = folder / f"{name}.json5"
        with telling(f"{path} cannot be written (", ")"):
            if path.exists() and path.read_text(encoding="utf-8") == text:
                continue
            path.write_text(text, encoding="utf-8")
        changed.append(name)
    return changed


def _keys_folder(file: Path) -> str:
    """Where the keys of a machine lie, as its file says it; the usual folder where there is no file yet."""
    try:
        found = re.search(r'"root_ca_certificate": "(.*)/ca\.pem"', file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        found = None
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read ({error}): it says where that machine has its keys") from None
    return KEYS_FOLDER if found is None else str(json.loads(f'"{found[1]}"'))


def _list(roster: Roster, authority: Authority) -> None:
    rights = {
        one.name: f"{'watches and commands' if one.command else 'watches'} {one.edges}"
        for one in roster.grounds
    }
    for name, kind in roster.names.items():
        print(
            f"{kind:<7} {name:<20} key until {authority.valid_until(name)}  {rights.get(name, '')}".rstrip()
        )


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="hvt-ground keys", description=__doc__)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    new_ca = commands.add_parser("new-ca", help="make the CA of a fleet, once")
    add_edge = commands.add_parser("add-edge", help="a key for an edge; NAME is its --edge-id")
    add_ground = commands.add_parser("add-ground", help="a key for a ground")
    add_router = commands.add_parser("add-router", help="a key for a router between them")
    reissue = commands.add_parser(
        "renew", help="a new key for a machine of the fleet, with the rights that it has"
    )
    remove = commands.add_parser("remove", help="take all rights from a machine, such as one that is lost")
    listing = commands.add_parser("list", help="who belongs to the fleet, and until when")
    for one in (new_ca, add_edge, add_ground, add_router, reissue, remove, listing):
        one.add_argument("--dir", type=Path, default=_DIR, help=f"folder of the fleet's keys [{_DIR}]")
    for one in (add_edge, add_ground, add_router, reissue, remove):
        one.add_argument("name", metavar="NAME")
    for one in (add_edge, add_ground, add_router):
        one.add_argument(
            "--keys-folder", help=f"where the keys of NAME lie on its machine [{KEYS_FOLDER}, or as before]"
        )
    for one in (add_edge, add_ground, add_router, reissue):
        one.add_argument(
            "--host",
            action="append",
            default=[],
            required=one is add_router,
            help="name or address that others connect to, where this machine listens; repeatable",
        )
    add_ground.add_argument("--edges", default="*", help="which edges it may watch, for example 'uav-*' [*]")
    add_ground.add_argument("--watch-only", action="store_true", help="without the right to command")
    return parser
