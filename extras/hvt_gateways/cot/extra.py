"""The settings of Cursor on Target, and how the ground comes to send it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from hvt_common.config import PATH, Group, SettingType
from hvt_common.errors import UserError, needs_extra
from hvt_common.runtime.host_names import with_small_scheme
from hvt_common.units import SECOND_NS
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra, Flight, Opening, OpenSinks

if TYPE_CHECKING:
    from hvt_common.runtime.reporting import Finding
    from hvt_ground.sinks import Outputs

_GATEWAYS = Group("gateways", rare=True)


def _url(text: str, *, name: str) -> str:
    """``udp``, ``tcp`` or ``tls``, a host and a port. No IPv6 address: the client, pytak, knows none."""
    text = with_small_scheme(text)
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("udp", "tcp", "tls") and bool(parts.hostname) and bool(parts.port)
    except ValueError:
        good = False
    if not good or re.fullmatch(r"[a-z]+://[\w.-]+:[0-9]+", text, re.ASCII) is None:
        raise UserError(
            f"{name} {text!r} is not accepted: give udp://HOST:PORT, tcp://HOST:PORT or tls://HOST:PORT, with a "
            "name or an IPv4 address"
        )
    return text


@dataclass(frozen=True)
class CotOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    cot: tuple[str, ...] = _GATEWAYS.option(
        SettingType("URL", _url),
        (),
        "also report the camera and the tracks to ATAK as Cursor on Target, for example udp://239.2.3.1:6969 or "
        "tls://takserver:8089 (docs/atak.md)",
        many=True,
    )
    cot_types: Path | None = _GATEWAYS.option(
        PATH, None, "with --cot: FILE.toml with the CoT type of each class and edge (docs/atak.md)"
    )


class CotExtra(Extra[CotOptions]):
    """A reporter a session, and a connection a target that all of them share."""

    options = CotOptions

    def check(self, config: CotOptions) -> None:
        if config.cot_types is not None and not config.cot:
            raise UserError(f"--cot-types {config.cot_types} is given without --cot: give --cot too")

    def reads(self, config: CotOptions) -> Iterable[Path]:
        return [config.cot_types] if config.cot_types is not None else []

    def check_outputs(self, config: CotOptions) -> None:
        """Refuse types and certificates that cannot be used."""
        if config.cot:
            with needs_extra("'hvt[cot]'"):
                from hvt_gateways.cot.connection import check_connection  # noqa: PLC0415 - who has none needs no pytak
                from hvt_gateways.cot.event import read_types  # noqa: PLC0415
            read_types(config.cot_types)
            for url in config.cot:
                check_connection(url)

    def checks(self, config: CotOptions) -> Mapping[str, Callable[[], Finding]]:
        """Whether reports could be sent; not whether anybody is there, for who connects is shown to others."""
        return {"reports": partial(self._found, config)} if config.cot else {}

    def _found(self, config: CotOptions) -> Finding:
        self.check_outputs(config)
        from hvt_common.runtime.reporting import Finding  # noqa: PLC0415

        return Finding("ok", f"to {', '.join(config.cot)}; types and certificates can be read")

    def start(self, config: CotOptions, outputs: Outputs) -> OpenSinks:
        if not config.cot:
            return lambda _flight: ()
        self.check_outputs(config)
        from hvt_gateways.cot.connection import CotConnection  # noqa: PLC0415 - as above
        from hvt_gateways.cot.event import read_types  # noqa: PLC0415 - as above
        from hvt_gateways.cot.reporter import SessionReporter  # noqa: PLC0415 - as above
        from hvt_gateways.cot.schedule import STALE_NS  # noqa: PLC0415 - as above

        # A server that cuts one connection shall not see everything go stale before the next.
        pause_s = STALE_NS / SECOND_NS / 3
        targets = [
            outputs.open(f"CoT {url}", partial(CotConnection, url), longest_pause_s=pause_s)
            for url in config.cot
        ]
        reporter = partial(SessionReporter, targets=targets, types=read_types(config.cot_types))

        def sinks(flight: Flight) -> Iterable[Opening]:
            opens = partial(reporter, flight.info, clock=flight.clock, still_address=flight.still_address)
            yield Opening(f"CoT of {flight.info.edge}", opens, waits=False)

        return sinks
