"""The members of a fleet and their rights: ``fleet.json`` beside the keys."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hvt_common.errors import UserError, telling
from hvt_common.protocol.channels import EdgeKeys, check_edge_pattern, matches

_FILE = "fleet.json"
_RESERVED = ("ca", "fleet")
"""Names of files that are the fleet's own."""


@dataclass(frozen=True, slots=True)
class GroundMember:
    """A ground and its rights."""

    name: str
    hosts: tuple[str, ...] = ()
    """Where edges connect to it."""
    command: bool = True
    """Whether it may use ``control``: ask for keyframes and stills, set budgets. Without it it may only watch."""
    edges: str = "*"
    """Which edges it may watch (and command), as ``hvt-ground --edges`` says it."""

    def may_watch(self, edge: str) -> bool:
        return matches(edge, edges=self.edges)


@dataclass(frozen=True, slots=True)
class RouterMember:
    """A router: it sees everything, and lets each machine through to its own keys."""

    name: str
    hosts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Roster:
    """Edges, grounds and routers; no two have the same name."""

    edges: tuple[str, ...] = ()
    grounds: tuple[GroundMember, ...] = field(default_factory=tuple)
    routers: tuple[RouterMember, ...] = field(default_factory=tuple)

    @classmethod
    def read(cls, folder: Path) -> Roster:
        """The roster of a folder; empty where there is none yet."""
        path = folder / _FILE
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            edges = tuple(EdgeKeys(str(one)).edge for one in said["edges"])
            grounds = tuple(
                GroundMember(
                    str(one["name"]),
                    tuple(map(str, one["hosts"])),
                    command=bool(one["command"]),
                    edges=check_edge_pattern(str(one["edges"])),
                )
                for one in said["grounds"]
            )
            routers = tuple(
                RouterMember(str(one["name"]), tuple(map(str, one["hosts"]))) for one in said["routers"]
            )
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, RecursionError, KeyError, TypeError, UserError) as error:
            raise UserError(f"{path} is not a roster as hvt-ground keys writes it ({error})") from None
        return cls(edges, grounds, routers)

    def write(self, folder: Path) -> None:
        path = folder / _FILE
        fresh = path.with_name(_FILE + ".new")
        with telling(f"{path} cannot be written (", ")"):
            fresh.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")
            fresh.replace(path)

    @property
    def names(self) -> dict[str, str]:
        return (
            dict.fromkeys(self.edges, "edge")
            | {one.name: "ground" for one in self.grounds}
            | {one.name: "router" for one in self.routers}
        )

    def with_edge(self, name: str) -> Roster:
        """The same with this edge; `UserError` where the name is another machine's."""
        self._check(name, kind="edge")
        return replace(self, edges=tuple(sorted({*self.edges, name})))

    def with_ground(self, ground: GroundMember) -> Roster:
        """The same with this ground, in place of an older one of its name."""
        self._check(ground.name, kind="ground")
        check_edge_pattern(ground.edges)
        others = [one for one in self.grounds if one.name != ground.name]
        return replace(self, grounds=tuple(sorted([*others, ground], key=lambda one: one.name)))

    def with_router(self, router: RouterMember) -> Roster:
        """The same with this router, in place of an older one of its name."""
        self._check(router.name, kind="router")
        others = [one for one in self.routers if one.name != router.name]
        return replace(self, routers=tuple(sorted([*others, router], key=lambda one: one.name)))

    def with_hosts(self, name: str, hosts: tuple[str, ...]) -> Roster:
        """The same with this ground or router at other places; of an edge none are known."""
        return replace(
            self,
            grounds=tuple(replace(one, hosts=hosts) if one.name == name else one for one in self.grounds),
            routers=tuple(replace(one, hosts=hosts) if one.name == name else one for one in self.routers),
        )

    def without(self, name: str) -> Roster:
        """The same without this machine; `UserError` where there is none of the name."""
        if name not in self.names:
            raise UserError(f"{name!r} is not in this fleet: {', '.join(self.names) or 'nobody'} is")
        return Roster(
            edges=tuple(one for one in self.edges if one != name),
            grounds=tuple(one for one in self.grounds if one.name != name),
            routers=tuple(one for one in self.routers if one.name != name),
        )

    def _check(self, name: str, *, kind: str) -> None:
        EdgeKeys(name)  # the same characters are safe in file names and certificates
        other = self.names.get(name)
        if name in _RESERVED or other not in (None, kind):
            raise UserError(
                f"{name!r} is {f'the name of a {other}' if other else 'reserved'}: take another name"
            )
