"""The key table: every stream of HVT, its direction and how Zenoh is to deliver it. Nothing else knows a key.

Keys are ``hvt/<edge>/<channel>``; those of a group of grounds are ``hvt-group/<group>/<member>[/<edge>]``. This file
knows strings only; `session` turns the names into Zenoh's own values.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum
from types import MappingProxyType

from hvt_common.errors import UserError

MAX_PAYLOAD_BYTES = 4 * 2**20
"""No access unit and no still is larger; a larger payload is refused unread."""

ROOT = "hvt"
GROUP_ROOT = "hvt-group"

MSGPACK_ENCODING = "application/octet-stream"
"""Zenoh has no short code for MessagePack; spelling it out would cost 22 bytes in each message."""

_EDGE_ID = re.compile(r"[a-z0-9-]{1,32}")
_EDGE_PATTERN = re.compile(r"[a-z0-9*-]{1,64}")


class Channel(StrEnum):
    """The last part of a key."""

    BASE = "base"
    ROI = "roi"
    TRACKS = "tracks"
    POSE = "pose"
    BACKLOG = "backlog"
    STATUS = "status"
    INFO = "info"
    CONTROL = "control"
    FEEDBACK = "feedback"
    ALIVE = "alive"


class Direction(Enum):
    """The sender of a channel."""

    EDGE_TO_GROUND = "edge to ground"
    GROUND_TO_EDGE = "ground to edge"
    GROUND_QUERIES = "ground queries, edge answers"
    PRESENCE = "liveliness token of the edge"


@dataclass(frozen=True, slots=True)
class Delivery:
    """Delivery of one channel over the link."""

    direction: Direction
    priority: str
    """Name of a Zenoh priority. BLOCK and DROP channels never share one: on one priority they disturb each other."""
    congestion: str
    """``BLOCK`` where the application owns a bounded queue of its own, ``DROP`` where the latest value wins."""
    encoding: str = MSGPACK_ENCODING


DELIVERIES: Mapping[Channel, Delivery] = MappingProxyType(
    {
        Channel.BASE: Delivery(Direction.EDGE_TO_GROUND, "DATA_HIGH", "BLOCK", encoding="video/h265"),
        Channel.ROI: Delivery(Direction.EDGE_TO_GROUND, "BACKGROUND", "BLOCK", encoding="image/jpeg"),
        Channel.TRACKS: Delivery(Direction.EDGE_TO_GROUND, "DATA_LOW", "DROP"),
        Channel.POSE: Delivery(Direction.EDGE_TO_GROUND, "DATA_LOW", "DROP"),
        Channel.BACKLOG: Delivery(Direction.EDGE_TO_GROUND, "BACKGROUND", "BLOCK"),
        Channel.STATUS: Delivery(Direction.EDGE_TO_GROUND, "INTERACTIVE_LOW", "DROP"),
        Channel.INFO: Delivery(Direction.GROUND_QUERIES, "INTERACTIVE_HIGH", "BLOCK"),
        Channel.CONTROL: Delivery(Direction.GROUND_QUERIES, "INTERACTIVE_HIGH", "BLOCK"),
        Channel.FEEDBACK: Delivery(Direction.GROUND_TO_EDGE, "INTERACTIVE_LOW", "DROP"),
        Channel.ALIVE: Delivery(Direction.PRESENCE, "DATA", "BLOCK"),
    }
)
"""The one table. The encoding of `Channel.ROI` is that of the default codec; another still codec says its own."""


def _check_name(name: str, what: str) -> None:
    if _EDGE_ID.fullmatch(name) is None:
        raise UserError(f"{what} {name!r} is not usable: 1 to 32 characters of a-z, 0-9 and '-' are accepted")


class EdgeKeys(dict[Channel, str]):
    """Channel → key of one edge, such as ``hvt/uav-1/base``. UserError for an id outside ``[a-z0-9-]{1,32}``."""

    def __init__(self, edge: str) -> None:
        _check_name(edge, "edge id")
        self.edge = edge
        super().__init__({channel: f"{ROOT}/{edge}/{channel}" for channel in Channel})


@dataclass(frozen=True, slots=True)
class GroupKeys:
    """Liveliness tokens of grounds that share a fleet. Raises UserError for a name outside ``[a-z0-9-]{1,32}``."""

    group: str

    def __post_init__(self) -> None:
        _check_name(self.group, "group")

    @property
    def everything(self) -> str:
        """The key expression of all its tokens."""
        return f"{GROUP_ROOT}/{self.group}/**"

    def member(self, member: str) -> str:
        """A ground takes part."""
        return f"{GROUP_ROOT}/{self.group}/{member}"

    def claim(self, member: str, edge: str) -> str:
        """A ground serves an edge, or is about to."""
        return f"{GROUP_ROOT}/{self.group}/{member}/{edge}"

    def parse(self, key: str) -> tuple[str, str | None] | None:
        """The member, and the edge that it claims; None for a key that is none of the group's."""
        root, group, *names = key.split("/")
        if (root, group) != (GROUP_ROOT, self.group) or len(names) not in (1, 2):
            return None
        if any(_EDGE_ID.fullmatch(one) is None for one in names):
            return None
        return names[0], names[1] if len(names) == 2 else None


def check_edge_pattern(pattern: str) -> str:
    """Return the pattern of ``--edges`` unchanged; raise UserError unless it is edge-id characters and ``*``."""
    if _EDGE_PATTERN.fullmatch(pattern) is None:
        raise UserError(
            f"edge pattern {pattern!r} is not usable: characters of a-z, 0-9 and '-', and '*' for any run of them"
        )
    return pattern


def selector(channel: Channel, *, edges: str = "*") -> str:
    """The Zenoh key expression of one channel for all edges that ``edges`` matches, such as ``hvt/uav-$*/base``.

    The sender applies the pattern, so edges that are not selected cost no line bytes.
    """
    pattern = re.sub(r"\*+", "*", check_edge_pattern(edges))
    chunk = pattern if pattern == "*" else pattern.replace("*", "$*")
    return f"{ROOT}/{chunk}/{channel}"


def matches(edge: str, *, edges: str) -> bool:
    """Whether the pattern of ``--edges`` covers this edge id; the same rule as `selector`."""
    return re.fullmatch(re.escape(edges).replace(r"\*", ".*"), edge) is not None


def parse_key(key: str) -> tuple[str, Channel] | None:
    """The edge id and channel of a received key; None for any key that is not ours."""
    parts = key.split("/")
    if len(parts) != 3 or parts[0] != ROOT or _EDGE_ID.fullmatch(parts[1]) is None:
        return None
    try:
        return parts[1], Channel(parts[2])
    except ValueError:
        return None
