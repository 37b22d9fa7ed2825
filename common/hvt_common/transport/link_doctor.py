"""The door for an extra for fleets, by the entry point ``hvt.link``: it explains links, mends and shares them.

Without it nobody does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, Self, cast

from hvt_common.errors import not_installed
from hvt_common.protocol.channels import EdgeKeys
from hvt_common.runtime.plug_ins import loaded, the_one

if TYPE_CHECKING:  # the configuration asks here, and a wrong setting is told without a link
    import zenoh

    from hvt_common.runtime.failures import Failures
    from hvt_common.transport.zenoh_config import LinkSettings

_GROUP = "hvt.link"


class LinkWatch:
    """Watches the links of one session while the context lasts; this one finds nothing."""

    @property
    def trouble(self) -> str:
        """Why there is no link, in a sentence; empty while there is one, or nothing is known."""
        return ""

    def may_command(self, edge: str) -> bool:  # noqa: ARG002
        """Whether our own configuration lets questions on ``control`` of this edge out at all."""
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End it."""


class LinkDoctor:
    """Explains and mends links, and shares edges out to grounds; this one does nothing."""

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

    def refusals(self, settings: LinkSettings) -> Callable[[str], str]:  # noqa: ARG002
        """Says of an edge why its ``control`` need not be tried; empty where our own configuration allows it."""
        return lambda _edge: ""

    def sharer(self) -> Callable[..., AbstractContextManager[Any]]:
        """``(session, group, page=…)`` makes this ground a member, which a ``page`` shows to others.

        The context is a `hvt_ground.session.subscribe.Group`. Raises `UserError` where nothing shares.
        """
        raise not_installed("--group", "hvt[ground]")

    def mend(
        self,
        session: zenoh.Session,  # noqa: ARG002
        config: zenoh.Config,  # noqa: ARG002
        failures: Failures,  # noqa: ARG002
        *,
        on_deaf: Callable[[], None] | None,  # noqa: ARG002
    ) -> AbstractContextManager[object]:
        """Frees a session of sockets that a dark line leaves behind, until the context ends.

        ``failures`` learns of a listener that hears nothing any more, and ``on_deaf()`` is called, in a thread.
        """
        return nullcontext()

    def watch(
        self,
        session: zenoh.Session,  # noqa: ARG002
        settings: LinkSettings,  # noqa: ARG002
        *,
        served: Callable[[str], bool],  # noqa: ARG002
    ) -> LinkWatch:
        """``served(name)`` says whether an edge of that name has appeared, or a ground subscribes (any thread)."""
        return LinkWatch()


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
