"""Access to the page: tokens, roles, and requests that come from our own page alone.

On loopback everybody on this machine is an operator, or a reverse proxy says who somebody is; elsewhere a token does.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import socket
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import urlsplit

import platformdirs
from starlette.requests import cookie_parser

from hvt_common.errors import UserError
from hvt_common.runtime.host_names import is_loopback, requested_host

Role = Literal["viewer", "operator"]

ROLE_HEADER = "X-HVT-Role"
"""A reverse proxy names the role in it; once, and only under the proxy's own host, it counts."""
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; media-src blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_LEAST_TOKEN = 16
_FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")


@dataclass(frozen=True, slots=True)
class Access:
    """``tokens`` by role, empty on loopback, where are none; ``proxy`` is the host for which one answers there."""

    tokens: Mapping[Role, str]
    proxy: str | None = None

    def role(self, headers: Mapping[str, str], *, token: str | None = None) -> Role | None:
        """The role of a request; None for none. ``token`` is that of a link, else the cookie counts."""
        if not self.tokens:
            # Another site's name may be made to lead here: only our own names are answered.
            host = requested_host(headers.get("host", ""))
            if self.proxy is None:  # a request through an undeclared proxy may come from anywhere
                through = any(one in headers for one in (*_FORWARDED, ROLE_HEADER.lower()))
                return "operator" if is_loopback(host) and not through else None
            if host != self.proxy:  # a page under another name can set the header itself
                return None
            said = headers.get(ROLE_HEADER.lower())
            return next((role for role in get_args(Role) if role == said), None)
        given = (token or _cookie(headers)).encode()
        found = [role for role, known in self.tokens.items() if hmac.compare_digest(given, known.encode())]
        return found[0] if found else None

    @property
    def refusal(self) -> tuple[str, int]:
        """The answer to a request without a role, and its status."""
        if self.tokens:
            return "give the link that hvt-ground showed at its start", 401
        if self.proxy is not None:
            return (
                f"the proxy of {self.proxy} has to pass that host on and say in {ROLE_HEADER} who is viewer or "
                "operator"
            ), 403
        return "unknown host, or a reverse proxy without --web-proxy", 403

    def foreign(self, headers: Mapping[str, str]) -> str:
        """Empty where a page of ours asks; else why it is taken for one of another site, open beside it."""
        origin, host = _place(headers.get("origin", "")), _place(f"https://{headers.get('host', '')}")
        plain = _place(f"http://{headers.get('host', '')}")
        if origin and origin in (host, plain):
            return ""
        if self.proxy is not None and origin[:1] == host[:1] == (self.proxy,):
            return (
                "the proxy takes the port off the header Host, so that this looks like another site: have it pass "
                "Host as the browser sent it (nginx: proxy_set_header Host $http_host)"
            )
        return "this comes from another site"


def cookie_name(headers: Mapping[str, str]) -> str:
    """A name by the port that the browser sees: cookies know no port, and another ground of this host has its own."""
    port = _place(f"http://{headers.get('host', '')}")[1:]
    return f"hvt-{port[0]}" if port else "hvt"


def crowding(places: Iterable[str], newcomer: str) -> str | None:
    """Without room, the address whose connection is closed, for it has more than a newcomer's; else None.

    The addresses that one party may have count as one: all of an IPv6 network of 64 bits.
    """
    known = list(places)
    counts = Counter(map(_party, known))
    most = max(known, key=lambda one: counts[_party(one)], default=newcomer)
    return most if counts[_party(most)] > counts[_party(newcomer)] + 1 else None


def _party(address: str) -> bytes:
    try:
        whole = socket.inet_pton(socket.AF_INET6, address.partition("%")[0])
    except OSError:
        return address.encode()
    return whole if whole.startswith(bytes(10) + b"\xff\xff") else whole[:8]


def _place(url: str) -> tuple[str, ...]:
    # Host and port of an origin; nothing where it is none.
    try:
        parts = urlsplit(url)
        port = parts.port or {"http": 80, "https": 443}.get(parts.scheme)
    except ValueError:
        return ()
    return (parts.hostname, str(port)) if parts.hostname and port else ()


def _cookie(headers: Mapping[str, str]) -> str:
    # Others on this host set cookies too: a strict parser gives up at the first that is out of form.
    cookies = cookie_parser(headers.get("cookie", ""))
    # A proxy sends the name without a port, and browsers have it from an earlier HVT.
    return cookies.get(cookie_name(headers)) or cookies.get("hvt", "")


def own_tokens(folder: Path | None = None) -> Mapping[Role, str]:
    """The tokens of this machine's page, made when first needed; readable by this user alone.

    Raises `UserError` where the file cannot be used.
    """
    folder = folder or platformdirs.user_state_path("hvt")
    file = folder / "web-tokens.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not file.exists():
            made = {"operator": secrets.token_urlsafe(24), "viewer": secrets.token_urlsafe(24)}
            # Whole or not at all, and never in place of those that another ground has just made.
            with tempfile.NamedTemporaryFile("w", dir=folder, encoding="utf-8") as out:
                json.dump(made, out)
                out.flush()
                with suppress(FileExistsError):
                    os.link(out.name, file)
        if file.stat().st_mode & 0o077:
            raise UserError(f"{file} can be read by others: chmod 600 it, or remove it for new tokens")
        known = json.loads(file.read_text(encoding="utf-8"))
        tokens: dict[Role, str] = {"operator": str(known["operator"]), "viewer": str(known["viewer"])}
    except OSError as error:
        raise UserError(
            f"the tokens of --web cannot be kept in {file} ({error.strerror}): XDG_STATE_HOME names another place"
        ) from None
    except (ValueError, RecursionError, KeyError, TypeError):
        tokens = {}
    if not tokens or any(len(one) < _LEAST_TOKEN for one in tokens.values()):
        raise UserError(f"{file} holds no tokens: remove it, and new ones are made")
    return tokens
