"""The rights in our own Zenoh configuration: Zenoh drops what they forbid and says nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.transport.zenoh_config import LinkSettings, configure


@dataclass(frozen=True, slots=True)
class Rights:
    """The access control of our own Zenoh configuration, read as Zenoh reads it.

    A subject is known by the common name of its certificate. Zenoh drops forbidden messages silently; with its own
    rules a side can say so.
    """

    enabled: bool = False
    default_allow: bool = True
    rules: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """The rules by id."""
    granted: tuple[tuple[frozenset[str] | None, tuple[str, ...]], ...] = ()
    """For each policy: the names that it is for (None: anybody), and the ids of its rules."""

    @classmethod
    def of(cls, config: zenoh.Config) -> Rights:
        """From a configuration that Zenoh has accepted."""
        said = json.loads(config.get_json("access_control")) or {}
        named = {one["id"]: one.get("cert_common_names") for one in said.get("subjects") or ()}
        subjects = {one: None if names is None else frozenset(names) for one, names in named.items()}
        granted = tuple(
            (subjects.get(subject, frozenset()), tuple(policy["rules"]))
            for policy in said.get("policies") or ()
            for subject in policy["subjects"]
        )
        return cls(
            enabled=said.get("enabled") is True,
            default_allow=said.get("default_permission") == "allow",
            rules={one["id"]: one for one in said.get("rules") or ()},
            granted=granted,
        )

    def knows(self, name: str) -> bool:
        return not self.enabled or self.default_allow or bool(self._rules_for(name))

    def allow(self, name: str, *, flow: str, message: str, key: str) -> bool:
        """Whether the rules let this pass between us and that common name of a certificate.

        ``flow`` is ``ingress`` from there or ``egress`` to there; ``message`` is Zenoh's word, such as ``put``,
        ``query``, ``reply`` or ``declare_subscriber``.
        """
        if not self.enabled:
            return True
        requested = zenoh.KeyExpr(key)
        said = {
            rule["permission"]
            for rule in self._rules_for(name)
            if flow in (rule.get("flows") or (flow,))
            and message in rule["messages"]
            and any(zenoh.KeyExpr(one).includes(requested) for one in rule["key_exprs"])
        }
        return "deny" not in said and ("allow" in said or self.default_allow)

    def allow_somebody(self, *, flow: str, message: str, key: str) -> bool:
        """Whether the rules let this pass between us and anybody at all."""
        names = {name for group, _ in self.granted for name in group or {""}}
        return not self.enabled or any(
            self.allow(name, flow=flow, message=message, key=key) for name in names or {""}
        )

    def may_query(self, edge: str, channel: Channel) -> bool:
        """Whether questions on this channel of an edge get out at all."""
        return self.allow_somebody(flow="egress", message="query", key=EdgeKeys(edge)[channel])

    def _rules_for(self, name: str) -> list[Mapping[str, Any]]:
        return [
            self.rules[rule]
            for names, rules in self.granted
            if names is None or name in names
            for rule in rules
            if rule in self.rules
        ]


def refusals(settings: LinkSettings) -> Callable[[str], str]:
    """Says of an edge why its ``control`` need not be tried; empty where our own file allows it."""
    rights, file = Rights.of(configure(settings)[0]), settings.zenoh_config

    def refusal(edge: str) -> str:
        if rights.may_query(edge, Channel.CONTROL):
            return ""
        if rights.may_query(edge, Channel.INFO):
            return (
                f"{file} lets us watch {edge}, not command it: a key that hvt-ground keys add-ground makes without "
                "--watch-only may"
            )
        return (
            f"{file} does not name {edge}: hvt-ground keys list shows who may watch it, and a file that was written "
            "before the edge was added has to be copied again"
        )

    return refusal
