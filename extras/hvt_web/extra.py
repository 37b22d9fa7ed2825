"""The settings of the page for browsers, and how the ground comes to serve it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from hvt_common.config import TEXT, Group
from hvt_common.errors import UserError, needs_extra
from hvt_ground.config import GroundConfig
from hvt_ground.extras import Extra, Service

if TYPE_CHECKING:  # who serves none starts faster
    from hvt_common.runtime.failures import Failures
    from hvt_common.runtime.reporting import Finding

_PAGE = Group("page for browsers")
_HERE = "127.0.0.1:8080"


@dataclass(frozen=True)
class WebOptions(GroundConfig):
    """The settings of ``hvt-ground`` for it."""

    web: str | None = _PAGE.option(
        TEXT,
        None,
        f"also serve the page for browsers at HOST:PORT, without a value {_HERE}; other machines need a token",
        bare=_HERE,
    )
    web_proxy: str | None = replace(_PAGE, rare=True).option(
        TEXT,
        None,
        "host at which a reverse proxy shows the page; the proxy sets X-HVT-Role to viewer or operator",
    )


class WebExtra(Extra[WebOptions]):
    """One page for all edges."""

    options = WebOptions

    def check(self, config: WebOptions) -> None:
        if config.web_proxy is not None and config.web is None:
            raise UserError(f"--web-proxy {config.web_proxy} is given without --web: give --web too")

    def checks(self, config: WebOptions) -> Mapping[str, Callable[[], Finding]]:
        if config.web is None:
            return {}
        return {"page": partial(_found, config.web)}

    def serve(self, config: WebOptions, *, clock: Callable[[], int], failures: Failures) -> Service | None:
        """Serve the page, encrypted by the keys of the link."""
        if config.web is None:
            return None
        with needs_extra("'hvt[web]'"):
            from hvt_web.server import WebPage  # noqa: PLC0415
        from hvt_common.transport.zenoh_config import key_pair  # noqa: PLC0415

        return WebPage(
            config.web, clock=clock, failures=failures, keys=key_pair(config.link), proxy=config.web_proxy
        )


def _found(address: str) -> Finding:
    from hvt_common.runtime.host_names import check_port  # noqa: PLC0415
    from hvt_common.runtime.reporting import Finding  # noqa: PLC0415

    check_port(address, name="--web", packages=("starlette", "uvicorn", "websockets"))
    return Finding("ok", f"{address} is free")
