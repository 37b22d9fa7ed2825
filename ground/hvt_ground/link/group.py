"""A group of grounds that share a fleet: each edge is served by one of them, and by another once that one is gone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Elsewhere:
    """The member that serves an edge instead of this one."""

    member: str
    page: str
    """The address of its page for browsers; empty where it has none, or has not said."""


class Group(Protocol):
    """This ground as a member."""

    member: str

    @property
    def elsewhere(self) -> Mapping[str, Elsewhere]:
        """The other member that serves each edge."""

    def serves(self, edge: str) -> bool:
        """Whether the edge is to be served here now; claims it where it is this member's."""

    def release(self, edge: str) -> None:
        """It is not served here any more, and may be elsewhere; unless it is this member's again."""

    def forget(self, *, except_for: Iterable[str]) -> None:
        """Withdraw claims of edges that are gone."""
