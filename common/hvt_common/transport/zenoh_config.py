"""Zenoh's configuration: the user's file, our defaults under it, the endpoints on top, all checked."""

from __future__ import annotations

import ipaddress
import json
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hvt_common.errors import UserError, absent
from hvt_common.files import read_text
from hvt_common.protocol.channels import MAX_PAYLOAD_BYTES
from hvt_common.runtime.host_names import is_loopback

if TYPE_CHECKING:
    import zenoh

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"

_MAX_LINKS = "transport/unicast/max_links"

_DEFAULTS: Mapping[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    # With it on, two processes of one host move large payloads past the link.
    "transport/shared_memory/enabled": False,
    # 26 bytes a message saved; our own headers carry the times.
    "timestamping/enabled": False,
    "listen/timeout_ms": 0,
    "listen/exit_on_failure": True,
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5},
    "transport/unicast/open_timeout": 3000,
    # An outage is noticed after about this long in place of 10 s.
    "transport/link/tx/lease": 3000,
    # Small batches and a small socket buffer: back-pressure reaches our own queues, which drop wisely,
    # after some tenths of a second of video. Four batches hold a keyframe.
    "transport/link/tx/batch_size": 16384,
    "transport/link/tx/queue/size/data_high": 4,
    "transport/link/tx/queue/size/background": 1,
    "transport/link/tcp/so_sndbuf": 65536,
    # Without it the kernel lets the buffer of a full TLS link grow to megabytes: seconds of video.
    "transport/link/tls/so_sndbuf": 65536,
    "transport/link/rx/max_message_size": 2 * MAX_PAYLOAD_BYTES,
}

_PRIORITIES = ("1-3", "4-7")
"""Two links to one place: answers, status and reports take the first, pictures, stills and tracks the second."""

_CLIENT: Mapping[str, Any] = {
    "mode": "client",
    # A client waits for its link when it starts; a query should fail soon where there is none.
    "connect/timeout_ms": 3000,
    "connect/exit_on_failure": True,
}


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Settings of Zenoh. With neither endpoint here nor in the file, a ground listens, the others connect.

    A ``client`` only queries: it never listens, and connects in Zenoh's mode of that name, so that a ground or a
    router that it connects to forwards its queries and the answers.
    """

    role: Literal["edge", "ground", "client"]
    listen: tuple[str, ...] = ()
    """Such as ``tcp/127.0.0.1:7447``; these replace the file's."""
    connect: tuple[str, ...] = ()
    zenoh_config: Path | None = None
    """A JSON5 file of Zenoh's own settings, which go before our defaults."""
    insecure: bool = False
    """Allow listening beyond loopback without keys."""
    links: Literal[1, 2] = 1
    """How many links to each place that we connect to over TCP or TLS: with two, small urgent messages do not wait
    behind pictures in a full socket. ``max_links: 2`` in the file says the same."""
    name: str | None = None
    """The id of this edge, which its certificate has to bear; None for any name in the certificate."""


def configure(settings: LinkSettings) -> tuple[zenoh.Config, tuple[str, ...]]:
    """Zenoh's configuration and the endpoints it will listen on; UserError if it is unusable."""
    config, said = _read_config(settings.zenoh_config)
    for path, value in {**_DEFAULTS, **(_CLIENT if settings.role == "client" else {})}.items():
        if not _mentions(said, path):
            config.insert_json5(path, json.dumps(value))
    listen, connect = (tuple(dict.fromkeys(side)) for side in (settings.listen, settings.connect))
    whole = {one.replace("/[::]:", "/0.0.0.0:") for one in listen if "/[::]:" in one}
    listen = tuple(one for one in listen if one not in whole)  # [::] takes IPv4 too, on the same port
    file_listen = _endpoints(said, "listen")
    if not (listen or connect or file_listen or _endpoints(said, "connect")):
        listen = (DEFAULT_ENDPOINT,) if settings.role == "ground" else ()
        connect = () if settings.role == "ground" else (DEFAULT_ENDPOINT,)
    _check_endpoints("listen", listen)
    _check_endpoints("connect", connect)
    if listen or not file_listen:
        # Never Zenoh's own default: a peer that listens on every address.
        _insert_endpoints(config, "listen", listen)
    effective = listen or file_listen
    several = settings.links == 2 or (isinstance(most := _value(said, _MAX_LINKS), int) and most > 1)
    two = settings.role != "client" and several
    if connect:
        _insert_endpoints(config, "connect", _split(connect) if two else connect)
    if settings.links == 2 or (effective and not _mentions(said, _MAX_LINKS)):
        # A listener takes either number. Asking for more than one makes every handshake a kilobyte longer.
        config.insert_json5(_MAX_LINKS, "2")
    if settings.role == "ground" and (connect or _endpoints(said, "connect")) and not _mentions(said, "mode"):
        # Since Zenoh 1.9 a router does not pass messages between two peers, but it does between a peer and a router.
        # An edge that listens is served just as well. ("client" would wait at its start, deaf to Ctrl-C.)
        config.insert_json5("mode", '"router"')
    for endpoint in effective:
        # With keys a client must show a certificate.
        keys = _value(said, "transport/link/tls/enable_mtls") is True and endpoint.startswith(
            ("tls/", "quic/")
        )
        _check_reach(endpoint, allowed=settings.insecure or keys)
    return config, effective


def key_pair(settings: LinkSettings) -> tuple[Path, Path] | None:
    """The certificate and the key with which this machine listens; None without. Raises like `configure`."""
    _, said = _read_config(settings.zenoh_config)
    try:
        tls = said["transport"]["link"]["tls"]
        return Path(tls["listen_certificate"]), Path(tls["listen_private_key"])
    except (KeyError, TypeError):
        return None


def _read_config(path: Path | None) -> tuple[zenoh.Config, dict[str, Any]]:
    import json5  # noqa: PLC0415 - settings alone need neither
    import zenoh  # noqa: PLC0415

    if path is None:
        return zenoh.Config(), {}
    what = f"--zenoh-config {path}"
    try:
        text = read_text(path)
    except OSError as error:
        raise absent(path)(f"{what} cannot be read ({error.strerror}): give a JSON5 file") from None
    try:
        said = json5.loads(text)
    except (ValueError, RecursionError) as error:
        line, reason = _located(str(error))
        raise UserError(f"{what}{line} is not JSON5: {reason}") from None
    if not isinstance(said, dict):
        raise UserError(f"{what} is a {type(said).__name__}: give Zenoh's settings, an object in braces")
    try:
        return zenoh.Config.from_json5(text), said
    except zenoh.ZError as error:
        reason = without_build_paths(str(error))
        # ``:LINE`` of the field or value that the reason quotes, where it stands in the file only once.
        found = re.search(r"`(\w+)`", reason)
        lines = [number for number, line in enumerate(text.splitlines(), 1) if found and found[1] in line]
        where = f":{lines[0]}" if len(lines) == 1 else ""
        raise UserError(f"{what}{where} is not accepted by Zenoh: {reason}") from None


def _mentions(said: dict[str, Any], path: str) -> bool:
    # Whether the user's file says anything at this path, or a value in place of one of its parents.
    value: Any = said
    for part in path.split("/"):
        if not isinstance(value, dict):
            return True
        if part not in value:
            return False
        value = value[part]
    return True


def _value(said: dict[str, Any], path: str) -> Any:
    value: Any = said
    for part in path.split("/"):
        value = value.get(part) if isinstance(value, dict) else None
    return value


def _endpoints(said: dict[str, Any], side: str) -> tuple[str, ...]:
    # The endpoints of a file: a list, or one list for each of Zenoh's modes.
    listed = _value(said, f"{side}/endpoints")
    groups = listed.values() if isinstance(listed, dict) else [listed]
    return tuple(str(endpoint) for group in groups if isinstance(group, list) for endpoint in group)


def connect_endpoints(config: zenoh.Config) -> tuple[str, ...]:
    """The endpoints that a configuration connects to; a link-local address with its interface in it."""
    said = {"connect": {"endpoints": json.loads(config.get_json("connect/endpoints"))}}
    return tuple(_IFACE.sub(r"\1%\3\2", one) for one in _endpoints(said, "connect"))


def _split(endpoints: tuple[str, ...]) -> tuple[str, ...]:
    # Each endpoint once for each range of priorities; one with metadata of its own, or no stream, stays as it is.
    split: list[str] = []
    for endpoint in endpoints:
        place, hash_sign, settings = endpoint.partition("#")
        if "?" in place or not place.startswith(("tcp/", "tls/")):
            split.append(endpoint)
        else:
            split += [f"{place}?prio={one}{hash_sign}{settings}" for one in _PRIORITIES]
    return tuple(split)


_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls|udp|quic|ws)/(?P<host>\[[0-9a-fA-F:.%\w-]+\]|[\w.-]+):(?P<port>\d{1,5})"
    r"(\?[!\"$-~]*)?(#[!-~]*)?",
    re.ASCII,
)
_SCOPE = re.compile(r"(\[fe[89ab][^%\]]*)%(?!\d+\])([^\]]+)(\][^#]*)#?", re.IGNORECASE)
_IFACE = re.compile(r"(\[fe[89ab][^%\]]*)(\][^#]*)#(?:.*;)?iface=([^;]+).*", re.IGNORECASE)
"""In ``[fe80::1%eth0]`` Zenoh takes numbers alone, which change with the interface; as ``iface`` it takes names."""


def _check_endpoints(side: str, endpoints: tuple[str, ...]) -> None:
    for endpoint in endpoints:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is None or not 1 <= int(found["port"]) <= 65535:
            raise UserError(
                f"--{side} {endpoint!r} is not usable: PROTOCOL/HOST:PORT is accepted, such as {DEFAULT_ENDPOINT}, "
                "with tcp, tls, udp, quic or ws and a port of 1 to 65535"
            )


def _insert_endpoints(config: zenoh.Config, side: str, endpoints: tuple[str, ...]) -> None:
    import zenoh  # noqa: PLC0415

    scoped = [_scoped(one, listening=side == "listen") for one in endpoints]
    try:
        config.insert_json5(f"{side}/endpoints", json.dumps(scoped))
    except zenoh.ZError as error:  # Zenoh judges the text behind ? and #
        reason = without_build_paths(re.sub(r".*msg: \"|\", location: .*", "", str(error)))
        raise UserError(f"--{side} {' '.join(endpoints)}: Zenoh does not accept it: {reason}") from None


def _scoped(endpoint: str, *, listening: bool) -> str:
    found = _SCOPE.search(endpoint)
    if listening and found and endpoint.startswith(("udp/", "quic/")):
        # There Zenoh binds the address before the interface, and Linux wants to know which it is.
        with suppress(OSError):
            return endpoint.replace(f"%{found[2]}]", f"%{socket.if_nametoindex(found[2])}]")
    return _SCOPE.sub(r"\1\3#iface=\2;", endpoint).rstrip(";")


def _check_reach(endpoint: str, *, allowed: bool) -> None:
    found = _ENDPOINT.fullmatch(endpoint)
    if allowed or (found is not None and is_loopback(found["host"])) or endpoint.startswith("unixsock"):
        return
    raise UserError(
        f"listening on {endpoint} without keys would let anybody on its network watch and command: listen on "
        "127.0.0.1 or [::1], give certificates with enable_mtls in --zenoh-config, or accept it with --insecure"
    )


def without_build_paths(text: str) -> str:
    """Zenoh's errors name source files of the machine that built it."""
    short = re.sub(r" at /\S+?\.rs:\d+\.?", "", text)
    return re.sub(r",? expected one of `.*", "", " ".join(short.split())).strip()


def _located(text: str) -> tuple[str, str]:
    found = re.match(r"<string>:(\d+) (.*)", text, re.DOTALL)
    return (f":{found[1]}", " ".join(found[2].split())) if found else ("", " ".join(text.split()))


def end_of(locator: object) -> str:
    """The end that a locator of Zenoh's names, such as ``tcp/[::1]:7447?prio=1-3``: ``[::1]:7447``."""
    host, _, port = re.sub(r"^\w+/|[?#].*", "", str(locator)).rpartition(":")
    with suppress(ValueError):  # no address of a network
        host = host_of(ipaddress.ip_address(host.strip("[]").partition("%")[0]))
    return f"{host}:{port}"


def host_of(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> str:
    """As it stands in an end; an IPv4 address in IPv6 as itself."""
    if isinstance(address, ipaddress.IPv6Address):
        return str(address.ipv4_mapped or f"[{address}]")
    return str(address)
