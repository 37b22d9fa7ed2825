"""A small certificate authority in a folder: one CA for the fleet, a key with a certificate for each machine.

The common name of a certificate is the name of the machine: an edge's id, a ground's name. Zenoh's access control
goes by it (`zenoh_files`). ECDSA on P-256 as in RFC 5480; private keys are PKCS #8 and readable by their owner only.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from hvt_common.errors import UserError, telling

CA_DAYS = 3650
MACHINE_DAYS = 825
"""The longest that common TLS libraries accept for a server."""
_CLOCKS_APART = dt.timedelta(hours=1)
"""A drone's clock may be behind: a certificate holds from a little before it was made."""
_HOST_NAME = re.compile(r"(\*\.)?[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*")


class Authority:
    """The CA of one fleet. ``ca.key`` signs for all of it: it stays in this folder."""

    def __init__(self, folder: Path, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate) -> None:
        self.folder = folder
        self._key = key
        self._certificate = certificate

    @classmethod
    def create(cls, folder: Path) -> Authority:
        """Make a new CA in the folder; `UserError` where one is there already, or the folder cannot be written."""
        if (folder / "ca.key").exists() or (folder / "ca.pem").exists():
            raise UserError(f"{folder} already holds a CA: use it, or name another folder with --dir")
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "hvt-ca")])
        public = key.public_key()
        usage = x509.KeyUsage(
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=True,
            encipher_only=False,
            decipher_only=False,
        )
        certificate = (
            _dated(x509.CertificateBuilder(), days=CA_DAYS)
            .subject_name(name)
            .issuer_name(name)
            .public_key(public)
            .serial_number(x509.random_serial_number())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(usage, critical=True)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
            .sign(key, hashes.SHA256())
        )
        with telling(f"the folder {folder} cannot be made (", ")"):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _write_pair(folder, "ca", key, certificate)
        return cls(folder, key, certificate)

    @classmethod
    def open(cls, folder: Path) -> Authority:
        """The CA of the folder; `UserError` if there is none, or its files are not a CA's."""
        try:
            key = serialization.load_pem_private_key((folder / "ca.key").read_bytes(), password=None)
            certificate = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
        except FileNotFoundError:
            raise UserError(f"{folder} holds no CA: make one with hvt-ground keys new-ca") from None
        except (OSError, ValueError, TypeError) as error:
            raise UserError(f"the CA in {folder} cannot be read: {error}") from None
        if not isinstance(key, ec.EllipticCurvePrivateKey) or certificate.public_key() != key.public_key():
            raise UserError(f"ca.key and ca.pem in {folder} do not belong together: restore them from a copy")
        return cls(folder, key, certificate)

    def issue(self, name: str, *, hosts: Sequence[str] = (), now: dt.datetime | None = None) -> None:
        """Write ``name.key`` and ``name.pem``; an older pair of that name is replaced, but not withdrawn.

        ``name`` is the common name, also accepted as a host name; others connect to this machine at ``hosts``.
        Validity counts from ``now``, with a time zone; None for this moment. It ends with the CA's at the latest;
        `UserError` where that has ended.
        """
        if self.until < dt.datetime.now(dt.UTC):
            raise UserError(
                f"the CA in {self.folder} ended on {self.until:%Y-%m-%d}: make another one with hvt-ground keys "
                "new-ca in another --dir, and new keys for all machines"
            )
        key = ec.generate_private_key(ec.SECP256R1())
        authority_id = x509.SubjectKeyIdentifier.from_public_key(self._key.public_key())
        certificate = (
            _dated(x509.CertificateBuilder(), days=MACHINE_DAYS, now=now, last=self.until)
            .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
            .issuer_name(self._certificate.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(
                x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]),
                critical=False,
            )
            .add_extension(
                x509.SubjectAlternativeName([_host(one) for one in (name, *hosts)]), critical=False
            )
            .add_extension(
                x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(authority_id), critical=False
            )
            .sign(self._key, hashes.SHA256())
        )
        _write_pair(self.folder, name, key, certificate)

    @property
    def until(self) -> dt.datetime:
        """When the CA ends: Zenoh does not look at that, other programs do."""
        return self._certificate.not_valid_after_utc

    def valid_until(self, name: str) -> str:
        """The day on which a machine's certificate ends; says so where it cannot be read."""
        try:
            certificate = x509.load_pem_x509_certificate((self.folder / f"{name}.pem").read_bytes())
        except (OSError, ValueError):
            return f"? ({name}.pem cannot be read)"
        return f"{certificate.not_valid_after_utc:%Y-%m-%d}"

    def forget(self, name: str) -> None:
        """Delete the files of a machine. A copy elsewhere still holds: only rules without its name end it."""
        for suffix in ("key", "pem", "json5"):
            path = self.folder / f"{name}.{suffix}"
            with telling(f"{path} cannot be deleted (", ")"):
                path.unlink(missing_ok=True)


def _dated(
    builder: x509.CertificateBuilder,
    *,
    days: int,
    now: dt.datetime | None = None,
    last: dt.datetime | None = None,
) -> x509.CertificateBuilder:
    now = now or dt.datetime.now(dt.UTC)
    until = now + dt.timedelta(days=days)
    return builder.not_valid_before(now - _CLOCKS_APART).not_valid_after(min(until, last or until))


def _host(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        pass
    if _HOST_NAME.fullmatch(text) is None:
        raise UserError(f"--host {text!r} is neither an address nor a host name: give it without a port")
    return x509.DNSName(text)


def _write_pair(
    folder: Path, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate
) -> None:
    """Both, or as they were: a key is of no use beside another's certificate. The key is never readable by others."""
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    fresh: dict[Path, Path] = {}
    try:
        for path, content, mode in (
            (folder / f"{name}.key", pem, 0o600),
            (folder / f"{name}.pem", public, 0o644),
        ):
            fresh[path] = path.with_name(path.name + ".new")
            fresh[path].unlink(missing_ok=True)
            with os.fdopen(os.open(fresh[path], os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(content)
        for path, made in fresh.items():
            made.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror})") from None
    finally:
        for made in fresh.values():
            with suppress(OSError):
                made.unlink(missing_ok=True)
