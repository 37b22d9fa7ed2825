"""The door for an extra that explains a missing link, by the entry point ``hvt.link``; without it nobody does."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self, cast

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.runtime.plug_ins import loaded, the_one
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

    def _rules_for(self, name: str) -> list[Mapping[str, Any]]:
        return [
            self.rules[rule]
            for names, rules in self.granted
            if names is None or name in names
            for rule in rules
            if rule in self.rules
        ]


_GROUP = "hvt.link"


class LinkWatch:
    """Watches the links of one session while the context lasts; this one finds nothing."""

    def __init__(self, settings: LinkSettings) -> None:
        self.config, self.listen = configure(settings)
        self.rights = Rights.of(self.config)

    @property
    def trouble(self) -> str:
        """Why there is no link, in a sentence; empty while there is one, or nothing is known."""
        return ""

    def may_command(self, edge: str) -> bool:
        """Whether our own configuration lets questions on ``control`` of this edge out at all."""
        return self.rights.allow_somebody(flow="egress", message="query", key=EdgeKeys(edge)[Channel.CONTROL])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""


class LinkDoctor:
    """Explains links; this one explains nothing."""

    def check_keys(
        self, config: zenoh.Config, *, listen: Sequence[str], name: str | None, now_s: float
    ) -> None:
        """Raise `UserError` for keys that no other side would accept.

        ``name`` is who this machine has to be by its certificate: the id of an edge; None for anybody. ``now_s`` is
        Unix time.
        """

    def check_id(self, settings: LinkSettings, keys: EdgeKeys) -> None:
        """Raise `UserError` where another edge with these keys lives on the link. May take some seconds."""

    def why_no_link(self, config: zenoh.Config) -> list[str]:  # noqa: ARG002
        """One sentence for each endpoint that it connects to. Blocks for some seconds an endpoint."""
        return []

    def watch(
        self,
        session: zenoh.Session,  # noqa: ARG002
        settings: LinkSettings,
        *,
        served: Callable[[str], bool],  # noqa: ARG002
    ) -> LinkWatch:
        """``served(name)`` says whether an edge of that name has appeared, or a ground subscribes (any thread)."""
        return LinkWatch(settings)


def link_doctor() -> LinkDoctor:
    """The one that is installed; `UserError` where it does not load."""
    entry = the_one(_GROUP, "doctor", what="link doctor", built_in=False)
    return (
        LinkDoctor()
        if entry is None
        else cast("LinkDoctor", loaded(entry, lambda of: of(), what="link doctor"))
    )


def control_unanswered(session: zenoh.Session, edge: str, *, who: str = "this ground") -> str:
    """The sentence for a request on ``control`` without an answer, while the edge is present.

    With keys the edge itself, or a ground or a router on the way, may have dropped it: all of them check rights.
    """
    if not any(link.auth_identifier for link in session.info.links()):
        return f"{edge} does not answer on control: the link is full, or has lost it"
    return (
        f"{edge} does not answer on control: {who} may lack the right to command it (hvt-ground keys list shows who "
        f"has it; add-ground without --watch-only gives it, then copy {edge}.json5 to the edge, and the others that "
        "changed with it), or the link is full"
    )
