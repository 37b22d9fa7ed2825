"""Checks, before the start, the keys that the Zenoh configuration names, and reads the rights in it.

Python's own ``ssl`` reads the certificates, by a TLS handshake in memory: no package for certificates is needed.
Zenoh drops messages that the rights forbid, and says nothing.
"""

from __future__ import annotations

import datetime as dt
import json
import logging
import ssl
import stat
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import zenoh

from hvt_common.errors import UserError, absent
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.transport.zenoh_config import LinkSettings, configure, connect_endpoints

_log = logging.getLogger(__name__)

NO_CHECK_TIME = ssl.VerifyFlags(0x200000)
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which ``ssl`` passes on but does not name."""
SOON_S = 30 * 86_400.0
_SECURED = ("tls/", "quic/")


@dataclass(frozen=True, slots=True)
class Certificate:
    """The fields of a certificate."""

    name: str
    """Its common name: who the machine is for the other side's access control. Empty where it has none."""
    hosts: tuple[str, ...]
    """Host names and addresses at which it may be reached."""
    not_before_s: float
    """Unix time."""
    not_after_s: float
    """Unix time."""

    @classmethod
    def of(cls, said: dict[str, Any]) -> Certificate:
        """From the answer of ``SSLSocket.getpeercert``."""
        names = [value for group in said.get("subject", ()) for key, value in group if key == "commonName"]
        return cls(
            name=names[0] if names else "",
            hosts=tuple(
                value for kind, value in said.get("subjectAltName", ()) if kind in ("DNS", "IP Address")
            ),
            not_before_s=float(ssl.cert_time_to_seconds(said["notBefore"])),
            not_after_s=float(ssl.cert_time_to_seconds(said["notAfter"])),
        )


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate and its private key, PEM."""

    certificate: Path
    key: Path

    def read(self, *, as_server: bool) -> Certificate:
        """Read the certificate as the other side would; UserError for unusable files. Checks neither time nor CA."""
        try:
            said = _shown(self, as_server=as_server)
        except ssl.SSLError as error:
            raise UserError(_unusable(self, error)) from None
        return Certificate.of(said)


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """The files that the ``transport.link.tls`` part of a Zenoh configuration names."""

    root_ca: Path | None = None
    connect: KeyPair | None = None
    """Shown where we connect."""
    listen: KeyPair | None = None
    """Shown where we listen."""
    verify_name: bool = True
    """Whether the host that we connect to has to be in its certificate."""

    @classmethod
    def of(cls, config: zenoh.Config) -> TlsFiles:
        """UserError where half of a pair is missing. Keys given as base64 text are Zenoh's own affair."""
        said = json.loads(config.get_json("transport/link/tls")) or {}
        root = said.get("root_ca_certificate")
        return cls(
            root_ca=Path(root) if root else None,
            connect=_pair(said, "connect"),
            listen=_pair(said, "listen"),
            verify_name=said.get("verify_name_on_connect") is not False,
        )


def check_own_keys(config: zenoh.Config, *, listen: Sequence[str], name: str | None, now_s: float) -> None:
    """Raise UserError for keys that no other side would accept; warn of coming and possible faults.

    ``name`` is who this machine has to be by its certificate: the id of an edge; None for anybody. ``now_s`` is
    Unix time.
    """
    files = TlsFiles.of(config)
    listening, connecting = _any_secured(listen), _any_secured(connect_endpoints(config))
    if not (listening or connecting):
        return
    if files.root_ca is not None:
        _check_readable(files.root_ca, setting="root_ca_certificate")
        _check_ca(files.root_ca)
    for pair, in_use, side in ((files.listen, listening, "listen"), (files.connect, connecting, "connect")):
        if pair is not None and in_use:
            _check_pair(pair, side=side, name=name, now_s=now_s)
    if listening and files.listen is None and not _in_base64(config, "listen"):
        raise UserError(
            f"listening on {next(one for one in listen if one.startswith(_SECURED))} takes listen_certificate and "
            "listen_private_key in --zenoh-config: hvt-ground keys makes them"
        )


def shown_to_callers(config: zenoh.Config, *, listen: Sequence[str]) -> Certificate | None:
    """The certificate with which this machine listens: Zenoh reads it once. None without; UserError if unusable."""
    pair = TlsFiles.of(config).listen
    return pair.read(as_server=True) if pair is not None and _any_secured(listen) else None


def dated(time_s: float) -> str:
    """A moment as people read it, UTC."""
    return dt.datetime.fromtimestamp(time_s, dt.UTC).strftime("%Y-%m-%d %H:%M UTC")


def plain_key_only() -> str:
    """For ``load_cert_chain``: an encrypted key would wait for a password on the terminal, for ever."""
    raise _EncryptedKeyError


class _EncryptedKeyError(ssl.SSLError):
    reason = "ENCRYPTED_KEY"


def _any_secured(endpoints: Sequence[str]) -> bool:
    # An endpoint may carry files of its own behind '#': those are Zenoh's affair.
    return any(one.startswith(_SECURED) and "certificate" not in one for one in endpoints)


def _in_base64(config: zenoh.Config, side: str) -> bool:
    with suppress(zenoh.ZError):
        return json.loads(config.get_json(f"transport/link/tls/{side}_certificate_base64")) is not None
    return False


def _pair(said: dict[str, Any], side: str) -> KeyPair | None:
    certificate, key = said.get(f"{side}_certificate"), said.get(f"{side}_private_key")
    if certificate is None or key is None:
        if certificate != key:
            given, missing = ("certificate", "private_key") if key is None else ("private_key", "certificate")
            if said.get(f"{side}_{missing}_base64") is None:
                raise UserError(f"--zenoh-config gives {side}_{given} but no {side}_{missing}: give both")
        return None
    return KeyPair(Path(certificate), Path(key))


def _check_pair(pair: KeyPair, *, side: str, name: str | None, now_s: float) -> None:
    _check_readable(pair.certificate, setting=f"{side}_certificate")
    _check_readable(pair.key, setting=f"{side}_private_key")
    if pair.key.stat().st_mode & (stat.S_IROTH | stat.S_IWOTH):
        _log.warning("%s: every user of this machine can read this key; chmod 640 %s", pair.key, pair.key)
    certificate = pair.read(as_server=side == "listen")
    if certificate.not_after_s < now_s:
        raise UserError(
            f"{pair.certificate}: this certificate expired on {dated(certificate.not_after_s)} (it is "
            f"{dated(now_s)} here): make a new one with hvt-ground keys"
        )
    if name is not None and certificate.name != name:
        raise UserError(
            f"--edge-id {name}: {pair.certificate} is the certificate of {certificate.name!r}, which may write as "
            f"{certificate.name!r} only: use that --edge-id, or the keys of {name} (hvt-ground keys add-edge {name})"
        )
    # No error: a machine without a clock of its own learns the time later.
    if certificate.not_before_s > now_s:
        _log.warning(
            "%s: this certificate holds from %s, and it is %s here: nobody lets it in before; is the clock right?",
            pair.certificate,
            dated(certificate.not_before_s),
            dated(now_s),
        )
    elif certificate.not_after_s < now_s + SOON_S:
        _log.warning(
            "%s: this certificate expires on %s: make a new one in time with hvt-ground keys",
            pair.certificate,
            dated(certificate.not_after_s),
        )


def _check_readable(path: Path, *, setting: str) -> None:
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise absent(path)(
            f"{path}, the {setting} of --zenoh-config, cannot be read ({error.strerror}): name a file that "
            "this user can read"
        ) from None


def _check_ca(path: Path) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(path)
    except ssl.SSLError:
        raise UserError(
            f"{path}, the root_ca_certificate of --zenoh-config, holds no certificate in PEM"
        ) from None


def _shown(pair: KeyPair, *, as_server: bool) -> dict[str, Any]:
    # The pair shown in a handshake in memory to a side that trusts just this certificate, whatever the date.
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname = False
    client.verify_mode = ssl.CERT_NONE
    for context in (server, client):
        context.load_cert_chain(pair.certificate, pair.key, password=plain_key_only)
    judge = client if as_server else server
    judge.load_verify_locations(pair.certificate)
    judge.verify_mode = ssl.CERT_REQUIRED
    judge.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN | NO_CHECK_TIME
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(to_client, to_server, server_side=False),
        server.wrap_bio(to_server, to_client, server_side=True),
    )
    for _ in range(2):  # hello and answer, then the client's own certificate
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return ends[0 if as_server else 1].getpeercert() or {}


def _unusable(pair: KeyPair, error: ssl.SSLError) -> str:
    both = f"{pair.certificate} and {pair.key}"
    if isinstance(error, _EncryptedKeyError):
        return f"{pair.key}: this key is encrypted; a key without a password is needed"
    if error.reason == "KEY_VALUES_MISMATCH":
        return f"{both} do not belong together: copy the pair again"
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"{pair.certificate}: this certificate cannot be used here ({error.verify_message})"
    return f"{both} are not a certificate and its key in PEM ({(error.reason or 'no PEM').lower().replace('_', ' ')})"


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
