"""Probes an endpoint beside Zenoh and explains in one sentence why it gives no link.

A probe connects, does the TLS handshake with the files that Zenoh uses, waits for an alert, and leaves.
"""

from __future__ import annotations

import errno
import re
import socket
import ssl
import time
from contextlib import closing
from dataclasses import dataclass

from hvt_common.errors import UserError
from hvt_fleet.link.certificate import NO_CHECK_TIME, Certificate, TlsFiles, dated, plain_key_only

_STEP_S = 3.0
"""Longest wait for a connection, and again for each answer."""
_ALERT_S = 1.0
"""A refusal of our certificate comes after the handshake is over for us (TLS 1.3, RFC 8446 section 4.4.2.4)."""
_ENDPOINT = re.compile(
    r"(?P<protocol>tcp|tls|ws|udp|quic)/(?P<host>\[[^\]]+\]|[^:/]+):(?P<port>\d{1,5})([?#].*)?"
)

# Verification errors of OpenSSL, x509_vfy.h.
_OTHER_CA = {2, 7, 18, 19, 20, 21}
_OTHER_HOST = {62, 64}

# Alerts, RFC 8446 section 6.2, as OpenSSL's reasons spell them.
_ALERTS = {
    "CERTIFICATE_REQUIRED": "it was signed by none of the CAs that are trusted there",
    "UNKNOWN_CA": "it was signed by another CA than the one trusted there",
    "DECRYPT_ERROR": "it was signed by another CA than the one trusted there, though of the same name",
    "CERTIFICATE_EXPIRED": "it is expired, or not valid yet, by the clock there",
    "CERTIFICATE_REVOKED": "it is revoked",
    "BAD_CERTIFICATE": "it cannot be checked there: signed by another CA, or damaged",
    "CERTIFICATE_UNKNOWN": "it is not accepted there",
    "UNSUPPORTED_CERTIFICATE": "it is not made for this side of a connection",
    "ACCESS_DENIED": "it has no access there",
}


@dataclass(frozen=True, slots=True)
class _Place:
    host: str
    port: int


def why_no_link(endpoint: str, files: TlsFiles) -> str:
    """One sentence on the obstacle to the endpoint, which it begins with. Blocks for some seconds at most.

    A name is looked up by the system's resolver, which has time limits of its own.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        return f"{endpoint}: no link"
    place = _Place(found["host"].strip("[]"), int(found["port"]))
    try:
        match found["protocol"]:
            case "tls":
                reason = _tls(place, files)
            case "udp":
                reason = _datagrams(place)
            case "quic":  # RFC 9000 section 14: UDP payloads of 1200 bytes
                reason = _datagrams(place) + "; QUIC needs a path that carries packets of 1280 bytes"
            case protocol:
                reason = _plain(place, protocol)
    except UnicodeError:  # a part of a name has 63 characters at most
        reason = f"{place.host!r} is no name that a machine can have"
    except OSError as error:
        reason = _unreachable(place, error)
    return f"{found['protocol']}/{found['host']}:{found['port']}: {reason}"


# Not reachable at all


def _unreachable(place: _Place, error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return f"no machine of the name {place.host!r} is known here"
    if isinstance(error, TimeoutError):
        return "no answer: is the address right, the link up, and the port open in the firewall?"
    if error.errno == errno.ECONNREFUSED:
        return f"nobody listens on port {place.port} there: is the other side running?"
    if error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return f"no route to {place.host}: is the link up?"
    return f"no connection ({error.strerror or error})"


# Without a connection that could be tried


def _datagrams(place: _Place) -> str:
    found = socket.getaddrinfo(place.host, place.port, type=socket.SOCK_STREAM)
    first, *others = dict.fromkeys(str(one[4][0]) for one in found)
    reason = "no link; whether somebody listens there cannot be seen from outside with this protocol"
    if others:
        reason += (
            f"; of its addresses {first} alone is tried: if it is dark, connect to {' or '.join(others)}"
        )
    return reason


# Plain


def _plain(place: _Place, protocol: str) -> str:
    with closing(socket.create_connection((place.host, place.port), timeout=_STEP_S)) as tcp:
        try:
            tls = _is_tls(tcp, place)
        except TimeoutError:  # Zenoh too says nothing to it
            return (
                "somebody listens there and says nothing: a tunnel or proxy whose line is dark, or a side of HVT "
                "that stands still?"
            )
        if tls:
            return (
                f"this is a TLS port, and plain {protocol} does not get in: connect to tls/… with the keys of this "
                "machine in --zenoh-config"
            )
    return "somebody listens there, but no Zenoh link comes of it: is it the other side of HVT?"


def _is_tls(tcp: socket.socket, place: _Place) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        with context.wrap_socket(tcp, server_hostname=place.host):
            return True
    except ssl.SSLError as error:
        return "ALERT" in (error.reason or "")
    except ConnectionError:
        return False


# TLS


def _tls(place: _Place, files: TlsFiles) -> str:
    context = _context(files)
    tcp = socket.create_connection((place.host, place.port), timeout=_STEP_S)
    try:
        tls = context.wrap_socket(tcp, server_hostname=place.host)
    except ssl.SSLCertVerificationError as error:
        return _their_certificate(place, files, error)
    except ssl.SSLError as error:
        return _alert(error, files) or _no_tls(place)
    except TimeoutError:
        return (
            f"what listens there does not answer TLS within {_STEP_S:g} s: it is a plain tcp/… port, its program "
            "stands still, or the link carries next to nothing"
        )
    except OSError:  # hung up at once
        return _no_tls(place)
    finally:
        tcp.close()
    with closing(tls):
        return _out_of_date(Certificate.of(tls.getpeercert() or {})) or _after_handshake(tls, files)


def _after_handshake(tls: ssl.SSLSocket, files: TlsFiles) -> str:
    tls.settimeout(_ALERT_S)
    began_s = time.monotonic()
    try:
        closed = tls.recv(1) == b""
    except TimeoutError:
        closed = False
    except ssl.SSLError as error:
        return _alert(error, files) or f"the TLS connection broke ({error.reason})"
    except OSError:
        closed = True
    if closed and time.monotonic() - began_s < _ALERT_S:
        return "TLS works, but the other side hangs up: is it the other side of HVT?"
    return "TLS works, both certificates are in order, but no Zenoh link comes of it: is it the other side of HVT?"


def _their_certificate(place: _Place, files: TlsFiles, error: ssl.SSLCertVerificationError) -> str:
    code = error.verify_code
    if code in _OTHER_CA:
        return (
            f"its certificate was not signed by the CA in {files.root_ca or 'this system'} (a CA of the same name "
            "may still be another): both sides need the ca.pem of one fleet"
        )
    seen = _shown_certificate(place, files)
    if code in _OTHER_HOST and seen is not None:
        return (
            f"its certificate{_whose(seen)} is for {', '.join(seen.hosts) or 'no host at all'}, not for "
            f"{place.host!r}: connect to one of these, or make its keys again with --host {place.host}"
        )
    return f"its certificate is not accepted ({error.verify_message})"


def _out_of_date(seen: Certificate) -> str:
    now_s = time.time()
    if seen.not_after_s < now_s:
        return (
            f"the other side's certificate{_whose(seen)} expired on {dated(seen.not_after_s)}; it is "
            f"{dated(now_s)} here"
        )
    if seen.not_before_s > now_s:
        return (
            f"the other side's certificate{_whose(seen)} is not valid until {dated(seen.not_before_s)}; it is "
            f"{dated(now_s)} here: is the clock right?"
        )
    return ""


def _whose(seen: Certificate) -> str:
    return f" of {seen.name!r}" if seen.name else ""


def _shown_certificate(place: _Place, files: TlsFiles) -> Certificate | None:
    # The other side's certificate, whatever its host says; it must be of our CA all the same.
    context = _context(files)
    context.check_hostname = False
    try:
        with (
            closing(socket.create_connection((place.host, place.port), timeout=_STEP_S)) as tcp,
            context.wrap_socket(tcp) as tls,
        ):
            said = tls.getpeercert()
    except OSError:
        return None
    return Certificate.of(said) if said else None


def _no_tls(place: _Place) -> str:
    return (
        f"what listens there does not speak TLS: connect to tcp/{place.host}:{place.port} where that is meant, "
        "or give the other side keys and tls/…"
    )


def _alert(error: ssl.SSLError, files: TlsFiles) -> str:
    alert = (error.reason or "").partition("ALERT_")[2]
    if not alert:
        return ""
    if files.connect is None:
        return (
            "the other side wants a certificate of this machine, and --zenoh-config names none "
            "(connect_certificate and connect_private_key; hvt-ground keys makes them)"
        )
    why = _ALERTS.get(alert, f"alert {alert.lower().replace('_', ' ')}")
    return f"the other side refused our certificate {files.connect.certificate}: {why}"


def _context(files: TlsFiles) -> ssl.SSLContext:
    # A TLS context like Zenoh's, which takes a CA of any date (`_out_of_date` judges certificates); UserError for
    # files that have become unusable since the start.
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = files.verify_name
    context.verify_flags |= NO_CHECK_TIME
    try:
        if files.root_ca is None:
            context.load_default_certs()
        else:
            context.load_verify_locations(files.root_ca)
        if files.connect is not None:
            context.load_cert_chain(files.connect.certificate, files.connect.key, password=plain_key_only)
    except (OSError, ssl.SSLError) as error:
        raise UserError(
            f"the keys of this machine can no longer be read ({error.strerror or error})"
        ) from None
    return context
