"""The Zenoh configurations of a fleet: mutual TLS, and access control that denies what it does not name.

Both ends of a link check. A ground lets an edge write under its own id only and tells each only what is meant for it;
an edge answers the grounds it knows, and serves ``control`` to those that may command. Zenoh identifies who is at
the other end by the common name of the certificate. What is not allowed is dropped in silence, so `hvt_common.link`
says in its own words why nothing comes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from hvt_common.link.keys import DELIVERIES, ROOT, Direction, EdgeKeys, Row
from hvt_ground.fleet.roster import Ground, Roster

__all__ = ["KEYS_FOLDER", "edge_file", "ground_file"]

KEYS_FOLDER = "/etc/hvt/tls"
"""Where the files lie on the machines, unless said otherwise."""

_EVERYBODY = f"{ROOT}/**"


def edge_file(name: str, roster: Roster, *, folder: str = KEYS_FOLDER) -> str:
    """``--zenoh-config`` of an edge, JSON5: it knows the grounds of the roster and their rights."""
    keys = EdgeKeys(name)
    rules = [
        _rule("publish", "egress", ["put"], _written(keys)),
        _rule(
            "answer", "egress", ["declare_queryable", "reply"], [keys.key(Row.INFO), keys.key(Row.CONTROL)]
        ),
        _rule("present", "egress", ["liveliness_token"], [keys.key(Row.ALIVE)]),
        _rule("listen", "egress", ["declare_subscriber"], [keys.key(Row.FEEDBACK)]),
        _rule("subscribed", "ingress", ["declare_subscriber"], [_EVERYBODY]),
        _rule("watched", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], [_EVERYBODY]),
        _rule("feedback", "ingress", ["put"], [keys.key(Row.FEEDBACK)]),
        _rule("info", "ingress", ["query"], [keys.key(Row.INFO)]),
        _rule("control", "ingress", ["query"], [keys.key(Row.CONTROL)]),
    ]
    watch = [rule["id"] for rule in rules if rule["id"] != "control"]
    policies = [
        {"subjects": [ground.name], "rules": [*watch, *(["control"] if ground.command else [])]}
        for ground in roster.grounds
    ]
    access = _access(rules, policies, [ground.name for ground in roster.grounds])
    tls = {
        "connect_certificate": f"{folder}/{name}.pem",
        "connect_private_key": f"{folder}/{name}.key",
    }
    where = next((host for ground in roster.grounds for host in ground.hosts), "HOST")
    head = f"hvt-edge --edge-id {name} --connect tls/{where}:7447 --zenoh-config {name}.json5"
    return _text(head, tls, access, folder=folder)


def ground_file(ground: Ground, roster: Roster, *, folder: str = KEYS_FOLDER) -> str:
    """``--zenoh-config`` of a ground, JSON5: it lets the edges of the roster in, each to its own keys."""
    rules: list[dict[str, Any]] = [
        _rule("ask", "egress", ["declare_subscriber"], [_EVERYBODY]),
        _rule("look", "egress", ["declare_liveliness_subscriber", "liveliness_query"], [_EVERYBODY]),
    ]
    policies = []
    for edge in roster.edges:
        keys = EdgeKeys(edge)
        own = [
            _rule(f"{edge}-publishes", "ingress", ["put"], _written(keys)),
            _rule(
                f"{edge}-answers",
                "ingress",
                ["declare_queryable", "reply"],
                [keys.key(Row.INFO), keys.key(Row.CONTROL)],
            ),
            _rule(f"{edge}-is-present", "ingress", ["liveliness_token"], [keys.key(Row.ALIVE)]),
            _rule(f"{edge}-listens", "ingress", ["declare_subscriber"], [keys.key(Row.FEEDBACK)]),
            _rule(f"to-{edge}", "egress", ["put"], [keys.key(Row.FEEDBACK)]),
            _rule(f"ask-{edge}", "egress", ["query"], [keys.key(Row.INFO), keys.key(Row.CONTROL)]),
        ]
        rules += own
        policies.append({"subjects": [edge], "rules": ["ask", "look", *(rule["id"] for rule in own)]})
    access = _access(rules, policies, roster.edges)
    tls = {
        "listen_certificate": f"{folder}/{ground.name}.pem",
        "listen_private_key": f"{folder}/{ground.name}.key",
    }
    head = f"hvt-ground --listen tls/0.0.0.0:7447 --zenoh-config {ground.name}.json5"
    return _text(head, tls, access, folder=folder)


def _written(keys: EdgeKeys) -> list[str]:
    """What an edge publishes."""
    return [keys.key(row) for row in Row if DELIVERIES[row].direction is Direction.EDGE_TO_GROUND]


def _rule(name: str, flow: str, messages: Sequence[str], key_exprs: Sequence[str]) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(key_exprs),
    }


def _access(
    rules: Sequence[dict[str, Any]], policies: Sequence[dict[str, Any]], names: Sequence[str]
) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "deny",
        "subjects": [{"id": name, "cert_common_names": [name]} for name in names],
        "rules": list(rules),
        "policies": list(policies),
    }


def _text(head: str, tls: dict[str, str], access: dict[str, Any], *, folder: str) -> str:
    said = {
        "transport": {
            "link": {"tls": {"root_ca_certificate": f"{folder}/ca.pem", "enable_mtls": True, **tls}}
        },
        "access_control": access,
    }
    return (
        f"// {head}\n// Written by hvt-ground keys; a change of the fleet writes it anew.\n"
        f"{json.dumps(said, indent=2)}\n"
    )
