"""Why a question came to nothing, as far as whoever asks can know: Zenoh drops what is not allowed in silence."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.transport.rights import Rights
from hvt_common.transport.zenoh_config import LinkSettings, configure

__all__ = ["Requester", "who_is_seen_by_way_of"]


@dataclass(frozen=True, slots=True)
class Requester:
    """What our own file lets us do."""

    file: Path | None = None
    rights: Rights = field(default_factory=Rights)

    @classmethod
    def of(cls, settings: LinkSettings) -> Requester:
        """From the settings of the session; `UserError` where they cannot be used."""
        return cls(settings.zenoh_config, Rights.of(configure(settings)[0]))

    def refusal(self, edge: str) -> str:
        """Why ``control`` of this edge need not be tried; empty where our own file allows it."""
        key = EdgeKeys(edge).key(Channel.CONTROL)
        if self.rights.allow_somebody(flow="egress", message="query", key=key):
            return ""
        if self.rights.allow_somebody(flow="egress", message="query", key=EdgeKeys(edge).key(Channel.INFO)):
            return (
                f"{self.file} lets us watch {edge}, not command it: a key that hvt-ground keys add-ground makes "
                "without --watch-only may"
            )
        return (
            f"{self.file} does not name {edge}: hvt-ground keys list shows who may watch it, and a file that was "
            "written before the edge was added has to be copied again"
        )


def who_is_seen_by_way_of(session: zenoh.Session) -> str:
    """Where an edge that does not show itself may be stopped: what stands at the other end of our links, by its key.

    Empty where there are no keys. An asker has one link.
    """
    names = sorted({link.auth_identifier for link in session.info.links() if link.auth_identifier})
    if not names:
        return ""
    return (
        f"; {names[0]}, to which we are linked, passes on only what its file lets our key see (hvt-ground keys list; "
        f"a {names[0]}.json5 from before our key was made does not name it)"
    )
