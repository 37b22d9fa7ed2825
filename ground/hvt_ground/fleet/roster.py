"""Who belongs to a fleet and may do what: ``fleet.json`` beside the keys."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hvt_common.errors import UserError
from hvt_common.link.keys import EdgeKeys

__all__ = ["Ground", "Roster"]

_FILE = "fleet.json"


@dataclass(frozen=True, slots=True)
class Ground:
    """A ground and its rights."""

    name: str
    hosts: tuple[str, ...] = ()
    """Where edges connect to it."""
    command: bool = True
    """Whether it may use ``control``: ask for keyframes and stills, set budgets. Without it it may only watch."""


@dataclass(frozen=True, slots=True)
class Roster:
    """Edges and grounds, each by its name once."""

    edges: tuple[str, ...] = ()
    grounds: tuple[Ground, ...] = field(default_factory=tuple)

    @classmethod
    def read(cls, folder: Path) -> Roster:
        """The roster of a folder; empty where there is none yet."""
        path = folder / _FILE
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            edges = tuple(EdgeKeys(str(one)).edge for one in said["edges"])
            grounds = tuple(
                Ground(str(one["name"]), tuple(map(str, one["hosts"])), bool(one["command"]))
                for one in said["grounds"]
            )
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} is not a roster as hvt-ground keys writes it ({error})") from None
        return cls(edges, grounds)

    def write(self, folder: Path) -> None:
        """Write it into the folder."""
        path = folder / _FILE
        fresh = path.with_name(_FILE + ".new")
        try:
            fresh.write_text(json.dumps(asdict(self), indent=2) + "\n", encoding="utf-8")
            fresh.replace(path)
        except OSError as error:
            raise UserError(f"{path} cannot be written ({error.strerror})") from None

    def with_edge(self, name: str) -> Roster:
        """The same with this edge; `UserError` where a ground has that name."""
        name = EdgeKeys(name).edge
        if name in {one.name for one in self.grounds}:
            raise UserError(f"{name!r} is a ground of this fleet: give the edge another name")
        return replace(self, edges=tuple(sorted({*self.edges, name})))

    def with_ground(self, ground: Ground) -> Roster:
        """The same with this ground, in place of an older one of its name."""
        EdgeKeys(ground.name)  # the same characters are safe in file names and certificates
        if ground.name in self.edges or ground.name == "ca":
            raise UserError(f"{ground.name!r} is taken: give the ground another name")
        others = [one for one in self.grounds if one.name != ground.name]
        return replace(self, grounds=tuple(sorted([*others, ground], key=lambda one: one.name)))
