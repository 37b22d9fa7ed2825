"""Names and addresses at which this machine serves, and by which a browser may ask for it.

A site may have its own name lead to an address of this machine (DNS rebinding): its pages could then read all that
a server answers, and command. So a server answers only to names that no stranger can have.
"""

import ipaddress
import re
import socket
from collections.abc import Sequence
from importlib.util import find_spec
from urllib.parse import urlsplit

from hvt_common.errors import UserError, telling


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches it: `localhost`, or an address of loopback and nothing like one."""
    address = _address(host)
    return host == "localhost" if address is None else address.is_loopback


def is_group(host: str | None) -> bool:
    """Whether it is the address of a multicast group."""
    address = _address(host or "")
    return address is not None and address.is_multicast


def names_this_machine(host: str, *, served_at: str) -> bool:
    """Whether no other site can be called so. ``served_at`` is the host on which is listened.

    On loopback these are its own names; elsewhere any address, a name without a dot, and the one listened on.
    """
    if is_loopback(served_at) or not host:
        return is_loopback(host)
    return host in (served_at, socket.gethostname().lower()) or "." not in host or _address(host) is not None


def requested_host(header: str) -> str:
    """The host of a header ``Host``, in small letters and without brackets and port; empty where it is none."""
    try:
        parts = urlsplit(f"//{header}")
        valid = parts.port != 0  # raises where the port is no number
    except ValueError:
        return ""
    # The parser drops text before or after brackets, which may be all of another site's name.
    plain = parts.netloc == header and re.fullmatch(r"(?:\[[^][]*\]|[^][@]*)(?::\d*)?", header) is not None
    return parts.hostname or "" if valid and plain else ""


def with_small_scheme(url: str) -> str:
    """The same address: RFC 3986, 3.1, knows no capitals in a scheme, and FFmpeg and pytak take none."""
    scheme, mark, rest = url.partition("://")
    return f"{scheme.lower()}{mark}{rest}" if mark else url


def host_and_port(address: str, *, name: str, example: str) -> tuple[str, int]:
    """Split ``HOST:PORT``. Raises `UserError`, which names the option, for anything else."""
    try:
        parts = urlsplit(f"//{address}")
        host, port = parts.hostname or "", parts.port or 0
    except ValueError:
        host, port = "", 0
    if not re.fullmatch(r"[\w.:%-]+", host) or not port or parts.path or parts.query:
        raise UserError(f"{name} {address!r} is not accepted: give HOST:PORT, such as {example}")
    return host, port


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host.removeprefix("[").removesuffix("]"))
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def check_port(address: str, *, name: str, packages: Sequence[str] = ()) -> None:
    """Raise `UserError` where HOST:PORT cannot be listened on now, or a package is missing that serves there."""
    for package in packages:
        if find_spec(package) is None:
            raise UserError(f"{name} needs the package {package!r}: pip install 'hvt[{name.strip('-')}]'")
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and 0 < int(port) < 2**16):
        raise UserError(f"{name} {address!r} is not accepted: give HOST:PORT")
    with telling(f"{name} {address} cannot be listened on (", "): give another"):
        family, *_, where = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(where)
