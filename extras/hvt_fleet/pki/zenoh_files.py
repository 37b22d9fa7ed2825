"""The Zenoh configurations of a fleet: mutual TLS, and access control that allows the named keys alone.

Both ends of a link check. A ground or a router lets an edge write under its own id only and gives each only its own
messages; an edge or a router answers the grounds it knows, and passes ``control`` on from those that may command.
Zenoh identifies who is at the other end by the common name of the certificate. Forbidden messages are dropped in
silence, so `hvt_fleet.link.diagnose` says in its own words why nothing comes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from hvt_common.protocol.channels import DELIVERIES, GROUP_ROOT, ROOT, Channel, Direction, EdgeKeys
from hvt_common.protocol.messages import MAX_PAYLOAD_BYTES
from hvt_fleet.pki.roster import GroundMember, Roster, RouterMember

KEYS_FOLDER = "/etc/hvt/tls"
"""The default folder of the files on the machines."""

_EVERYBODY = f"{ROOT}/**"
_GROUPS = f"{GROUP_ROOT}/**"

_Rule = dict[str, Any]

_ROUTER_SETTINGS: dict[str, Any] = {
    "mode": "router",
    "listen": {"endpoints": ["tls/0.0.0.0:7447"]},
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "timestamping": {"enabled": False},
    "transport": {
        "shared_memory": {"enabled": False},
        "unicast": {"max_links": 2},
        "link": {
            "tx": {"lease": 3000},
            "rx": {"max_message_size": 2 * MAX_PAYLOAD_BYTES},
            "tls": {"so_sndbuf": 65536},
        },
    },
}
"""Like deploy/zenoh/router.json5, open to the network."""


def edge_file(name: str, roster: Roster, *, folder: str = KEYS_FOLDER) -> str:
    """``--zenoh-config`` of an edge, JSON5: it knows the grounds of the roster with their rights, and the routers."""
    grants = {
        ground.name: _toward_ground([name], command=ground.command, label="self")
        for ground in roster.grounds
        if ground.may_watch(name)
    }
    grants |= {router.name: _toward_ground([name], command=True, label="self") for router in roster.routers}
    called = [one.hosts for one in roster.grounds] + [one.hosts for one in roster.routers]
    hosts = [f"[{host}]" if ":" in host else host for one in called for host in one]
    head = f"hvt-edge --edge-id {name} --connect tls/{(*hosts, 'HOST')[0]}:7447 --zenoh-config {name}.json5"
    return _text(head, {}, name=name, grants=grants, folder=folder)


def ground_file(ground: GroundMember, roster: Roster, *, folder: str = KEYS_FOLDER) -> str:
    """``--zenoh-config`` of a ground, JSON5: it lets the edges that it may watch in, each to its own keys."""
    edges = [edge for edge in roster.edges if ground.may_watch(edge)]
    grants = {edge: _toward_edge(edge, command=ground.command) for edge in edges}
    through = [rule for edge in edges for rule in _toward_edge(edge, command=ground.command)]
    grants |= {router.name: [*through, *_AMONG_GROUNDS] for router in roster.routers if edges}
    # A second program of this ground, or another ground, may ask by way of this one: it gets its own answers.
    for other in roster.grounds:
        shared = [edge for edge in edges if other.may_watch(edge)]
        if shared:
            command = ground.command and other.command
            theirs = [rule for edge in shared for rule in _toward_edge(edge, command=ground.command)]
            theirs += _toward_ground(shared, command=command, label=other.name)
            grants[other.name] = [*theirs, *_AMONG_GROUNDS]
    head = f"hvt-ground --listen tls/0.0.0.0:7447 --zenoh-config {ground.name}.json5"
    return _text(head, {}, name=ground.name, grants=grants, folder=folder)


def router_file(router: RouterMember, roster: Roster, *, folder: str = KEYS_FOLDER) -> str:
    """The configuration of a router, JSON5: it lets each edge and each ground through to its own keys."""
    grants = {edge: _toward_edge(edge, command=True) for edge in roster.edges}
    for ground in roster.grounds:
        edges = [edge for edge in roster.edges if ground.may_watch(edge)]
        if edges:
            rules = _toward_ground(edges, command=ground.command, label=ground.name)
            grants[ground.name] = [*rules, *_AMONG_GROUNDS]
    others = [one.name for one in roster.routers if one.name != router.name]
    everything = [
        *(rule for edge in roster.edges for rule in _toward_edge(edge, command=True)),
        *_toward_ground(list(roster.edges), command=True, label="all"),
        *_AMONG_GROUNDS,
    ]
    grants |= {name: everything for name in others if roster.edges}
    head = f"python deploy/router.py --zenoh-config {router.name}.json5"
    return _text(head, _ROUTER_SETTINGS, name=router.name, grants=grants, folder=folder)


def _toward_edge(edge: str, *, command: bool) -> list[_Rule]:
    keys = EdgeKeys(edge)
    requested = [keys[Channel.INFO], *([keys[Channel.CONTROL]] if command else [])]
    return [
        _rule("subscribe", "egress", ["declare_subscriber"], [_EVERYBODY]),
        _rule("watch", "egress", ["declare_liveliness_subscriber", "liveliness_query"], [_EVERYBODY]),
        _rule(f"{edge}-publishes", "ingress", ["put"], _written([edge])),
        _rule(f"{edge}-answers", "ingress", ["declare_queryable", "reply"], _answered([edge])),
        _rule(f"{edge}-is-present", "ingress", ["liveliness_token"], [keys[Channel.ALIVE]]),
        _rule(f"{edge}-listens", "ingress", ["declare_subscriber"], [keys[Channel.FEEDBACK]]),
        _rule(f"{edge}-is-told", "egress", ["put"], [keys[Channel.FEEDBACK]]),
        _rule(f"{edge}-is-asked", "egress", ["query"], requested),
    ]


def _toward_ground(edges: Sequence[str], *, command: bool, label: str) -> list[_Rule]:
    """The messages to and from a ground that may watch these edges."""
    keys = [EdgeKeys(edge) for edge in edges]
    requested = [Channel.INFO, *([Channel.CONTROL] if command else [])]
    named = f"{label}-{'commands' if command else 'watches'}"
    return [
        _rule("subscribed", "ingress", ["declare_subscriber"], [_EVERYBODY]),
        _rule("watched", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], [_EVERYBODY]),
        _rule(f"{label}-receives", "egress", ["put"], _written(edges)),
        _rule(f"{label}-hears-answers", "egress", ["declare_queryable", "reply"], _answered(edges)),
        _rule(f"{label}-sees", "egress", ["liveliness_token"], [one[Channel.ALIVE] for one in keys]),
        _rule(f"{label}-is-heard", "egress", ["declare_subscriber"], [one[Channel.FEEDBACK] for one in keys]),
        _rule(f"{label}-reports", "ingress", ["put"], [one[Channel.FEEDBACK] for one in keys]),
        _rule(named, "ingress", ["query"], [one[row] for one in keys for row in requested]),
    ]


def _written(edges: Sequence[str]) -> list[str]:
    rows = [row for row in Channel if DELIVERIES[row].direction is Direction.EDGE_TO_GROUND]
    return [EdgeKeys(edge)[row] for edge in edges for row in rows]


def _answered(edges: Sequence[str]) -> list[str]:
    rows = [row for row in Channel if DELIVERIES[row].direction is Direction.GROUND_QUERIES]
    return [EdgeKeys(edge)[row] for edge in edges for row in rows]


def _rule(name: str, flow: str, messages: Sequence[str], key_exprs: Sequence[str]) -> _Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(key_exprs),
    }


_GROUP_MESSAGES = (
    *("liveliness_token", "declare_liveliness_subscriber", "liveliness_query"),
    *("declare_queryable", "query", "reply"),
)
_AMONG_GROUNDS = [_rule(f"groups-{flow}", flow, _GROUP_MESSAGES, [_GROUPS]) for flow in ("ingress", "egress")]
"""Messages between grounds of a group, by way of routers too; no edge receives or sends them."""


def _access(grants: dict[str, list[_Rule]]) -> dict[str, Any]:
    """Each name with its rules; a rule that several share is written once. Zenoh refuses empty lists."""
    rules = {rule["id"]: rule for own in grants.values() for rule in own}
    return {
        "enabled": True,
        "default_permission": "deny",
        "subjects": [{"id": name, "cert_common_names": [name]} for name in grants],
        "rules": list(rules.values()),
        "policies": [
            {"subjects": [name], "rules": [rule["id"] for rule in own]} for name, own in grants.items()
        ],
    }


def _text(
    head: str, settings: dict[str, Any], *, name: str, grants: dict[str, list[_Rule]], folder: str
) -> str:
    pair = (f"{folder}/{name}.pem", f"{folder}/{name}.key")
    tls = {
        "root_ca_certificate": f"{folder}/ca.pem",
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "listen_certificate": pair[0],
        "listen_private_key": pair[1],
        "connect_certificate": pair[0],
        "connect_private_key": pair[1],
    }
    transport = settings.get("transport", {})
    link = transport.get("link", {})
    said = settings | {
        "transport": transport | {"link": link | {"tls": tls | link.get("tls", {})}},
        "access_control": _access(grants),
    }
    return (
        f"// {head}\n// Written by hvt-ground keys; a change of the fleet writes it anew.\n"
        f"{json.dumps(said, indent=2)}\n"
    )
