"""Who may open the page, and what for: tokens, roles, and requests that come from our own page alone.

On loopback everybody on this machine is an operator, or a reverse proxy says who somebody is; elsewhere a token does.
"""

from __future__ import annotations

import hmac
import json
import os
import secrets
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import urlsplit

import platformdirs

from hvt_common.errors import UserError

__all__ = ["COOKIE", "HEADERS", "ROLE_HEADER", "Access", "Role", "is_loopback", "own_tokens"]

Role = Literal["viewer", "operator"]

COOKIE = "hvt"
ROLE_HEADER = "X-HVT-Role"
"""In it a reverse proxy names the role."""
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
_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it."""
    return host in _LOOPBACK or host.startswith("127.")


@dataclass(frozen=True, slots=True)
class Access:
    """``tokens`` by role, empty on loopback, where are none; ``proxy`` is the host for which one answers there."""

    tokens: Mapping[Role, str]
    proxy: str | None = None

    def role(self, headers: Mapping[str, str], *, token: str | None = None) -> Role | None:
        """What a request may do; None is nothing. ``token`` is that of a link, else the cookie counts."""
        if not self.tokens:
            # Another site's name may be made to lead here: only our own names are answered.
            host = urlsplit(f"//{headers.get('host', '')}").hostname or ""
            if not is_loopback(host) and host != self.proxy:
                return None
            if self.proxy is None:  # what came through a proxy that nobody told of may come from anywhere
                return None if any(one in headers for one in _FORWARDED) else "operator"
            said = headers.get(ROLE_HEADER.lower())
            return next((role for role in get_args(Role) if role == said), None)
        given = (token or _cookie(headers.get("cookie", ""))).encode()
        found = [role for role, known in self.tokens.items() if hmac.compare_digest(given, known.encode())]
        return found[0] if found else None

    @property
    def refusal(self) -> tuple[str, int]:
        """What somebody without a role is told, and the status."""
        if self.tokens:
            return "give the link that hvt-ground showed at its start", 401
        if self.proxy is not None:
            return f"the proxy of {self.proxy} has to say in {ROLE_HEADER} who is viewer or operator", 403
        return "unknown host, or a reverse proxy without --web-proxy", 403

    @staticmethod
    def same_origin(headers: Mapping[str, str]) -> bool:
        """Whether a page of ours asks, not one of another site that a browser has open beside it."""
        origin = headers.get("origin", "")
        return bool(origin) and urlsplit(origin).netloc == headers.get("host", "")


def _cookie(header: str) -> str:
    try:
        found = SimpleCookie(header).get(COOKIE)
    except CookieError:
        return ""
    return "" if found is None else found.value


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
    except (ValueError, KeyError, TypeError):
        tokens = {}
    if not tokens or any(len(one) < _LEAST_TOKEN for one in tokens.values()):
        raise UserError(f"{file} holds no tokens: remove it, and new ones are made")
    return tokens
