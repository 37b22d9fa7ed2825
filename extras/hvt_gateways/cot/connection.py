"""One connection to where Cursor on Target goes, over pytak: UDP, TCP or TLS, in a thread and loop of its own.

pytak makes the connection, so that its environment variables mean the same for certificates and multicast as in its
other programs. Of these only `VARIABLES` are used: no enrolment, which alone needs aiohttp.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import os
import re
import socket
import ssl
import threading
import warnings
from collections.abc import Mapping
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # that aiohttp is missing
    import pytak
    from pytak.client_functions import get_ssl_ctx, get_tls_config

from hvt_common.errors import UserError, absent
from hvt_common.files import read_bytes
from hvt_common.runtime.host_names import is_group
from hvt_gateways.cot.event import CotMessage
from hvt_ground.sinks import SinkWriter

_log = logging.getLogger(__name__)

VARIABLES: Final = (
    "PYTAK_TLS_CLIENT_CERT",
    "PYTAK_TLS_CLIENT_KEY",
    "PYTAK_TLS_CLIENT_PASSWORD",
    "PYTAK_TLS_CLIENT_CAFILE",
    "PYTAK_TLS_CLIENT_CIPHERS",
    "PYTAK_TLS_DONT_VERIFY",
    "PYTAK_TLS_DONT_CHECK_HOSTNAME",
    "PYTAK_TLS_SERVER_EXPECTED_HOSTNAME",
    "PYTAK_MULTICAST_LOCAL_ADDR",
    "PYTAK_MULTICAST_LOCAL_ADDRS",
    "PYTAK_MULTICAST_TTL",
)
_CERT, _KEY, _CAFILE = "PYTAK_TLS_CLIENT_CERT", "PYTAK_TLS_CLIENT_KEY", "PYTAK_TLS_CLIENT_CAFILE"
_PASSWORD = "PYTAK_TLS_CLIENT_PASSWORD"  # noqa: S105 - its name
_DONT_VERIFY = "PYTAK_TLS_DONT_VERIFY"
_ADDR, _ADDRS = "PYTAK_MULTICAST_LOCAL_ADDR", "PYTAK_MULTICAST_LOCAL_ADDRS"
_TTL: Final = "PYTAK_MULTICAST_TTL"
_MOST_TTL: Final = 127
"""pytak packs it into a signed byte."""
CONNECT_S: Final = 5.0
SEND_S: Final = 10.0
END_S: Final = 1.0
_MOST_EVENTS: Final = 2048
_SOCKET_BYTES: Final = 64 * 1024
"""The kernel's buffer: events in it cannot be replaced by newer ones."""
_BUFFER_BYTES: Final = 4096
"""The same in Python. Not 0: at that asyncio's TLS pauses and does not go on."""
_READ_BYTES: Final = 64 * 1024


def check_connection(url: str, environment: Mapping[str, str] = os.environ) -> None:
    """Refuse certificates and interfaces that cannot be used, before anything is received; `UserError`."""
    settings = _settings(url, environment)
    if urlsplit(url).scheme == "udp":
        _check_multicast(settings)
    if urlsplit(url).scheme != "tls":
        return
    if _CERT not in settings:
        raise UserError(
            f"--cot {url} needs a certificate of this client: set {_CERT} to FILE.pem or FILE.p12 in the environment"
        )
    for name in (_CERT, _KEY, _CAFILE):
        if name in settings:
            _check_file(name, Path(settings[name].replace("%%", "%")), password=_PASSWORD in settings)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            context = get_ssl_ctx(get_tls_config(settings))
    except Exception as error:  # noqa: BLE001 - pytak raises SyntaxError, ValueError and others
        reason = str(error.__cause__ or error) or type(error).__name__
        raise UserError(
            f"--cot {url} cannot use the certificate {settings[_CERT]} ({reason}): set {_CERT}, and where it needs "
            "them PYTAK_TLS_CLIENT_KEY, _PASSWORD and _CAFILE"
        ) from None
    if context.verify_mode == ssl.CERT_NONE:
        _log.warning("CoT %s: the server's certificate is not verified (%s)", url, _DONT_VERIFY)
    # pytak says so at each connection, on standard error.
    warnings.filterwarnings("ignore", message="Disabled TLS", category=UserWarning)


def _check_multicast(settings: Mapping[str, str]) -> None:
    ttl = settings.get(_TTL, "1")
    if not ttl.isascii() or not ttl.isdigit() or int(ttl) > _MOST_TTL:
        raise UserError(f"{_TTL} {ttl!r} is not accepted: give a whole number from 0 to {_MOST_TTL}")
    for name in (_ADDR, _ADDRS):
        given = settings.get(name, "")
        if given.strip().lower() == "auto":  # to pytak as if there were none
            continue
        for address in re.split(r"[\s,]+", given.strip()):
            try:
                if address:
                    ipaddress.IPv4Address(address)
            except ValueError:
                raise UserError(
                    f"{name} {given!r} is not accepted: give IPv4 addresses of this machine"
                ) from None


def _check_file(name: str, path: Path, *, password: bool) -> None:
    """OpenSSL would ask for a password at the terminal, at each connection; pytak opens a .p12 for writing."""
    try:
        data = read_bytes(path)
    except OSError as error:
        raise absent(path)(
            f"{name} {path} cannot be read ({error.strerror}): give a file that is there"
        ) from None
    if name != _CAFILE and path.suffix.lower() in (".p12", ".pfx"):
        if not os.access(path, os.W_OK):
            raise UserError(f"{name} {path} can only be read, and pytak writes to it: give a copy")
    elif name != _CAFILE and b"ENCRYPTED" in data and not password:
        raise UserError(f"{name} {path} has an encrypted key: set {_PASSWORD}")


def _settings(url: str, environment: Mapping[str, str]) -> dict[str, str]:
    """The settings for pytak, from ``environment``."""
    parts = urlsplit(url)
    # It reads values through a `ConfigParser`, to which a percent sign is a beginning.
    settings = {name: environment[name].replace("%", "%%") for name in VARIABLES if environment.get(name)}
    certificate = settings.get(_CERT, "")
    if certificate and not certificate.endswith(".p12"):
        settings.setdefault(_KEY, certificate)  # both in one file
    system = ssl.get_default_verify_paths().cafile
    if system is not None:
        settings.setdefault(_CAFILE, system)
    scheme = parts.scheme
    if scheme == "udp":  # write-only, or it would also bind the port; of a broadcast no refusal is noticed
        broadcast = (parts.hostname or "").endswith(".255")
        scheme = "udp+broadcast+wo" if broadcast else "udp+wo"
    return {**settings, "COT_URL": f"{scheme}://{parts.netloc}"}


class CotConnection(SinkWriter[CotMessage]):
    """An open connection; the sink of a `QueuedSink`, which makes it anew once it has failed.

    `log` never waits: of each uid the newest event is to be sent, in turn. Messages of the other side are read and
    thrown away. Raises `UserError` where it cannot be opened within five seconds; `log` does so after it has failed.
    """

    def __init__(self, url: str, environment: Mapping[str, str] = os.environ) -> None:
        self._url = url
        self._settings = _settings(url, environment)
        self._lock = threading.Lock()
        self._unsent: dict[str, bytes] = {}
        """Events by uid, in the order in which they came first."""
        self._ending = False
        self._error: UserError | None = None
        self._opened: Future[None] = Future()
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_say_quietly)
        self._wake = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-cot", daemon=True)
        self._thread.start()
        self._opened.result()

    def log(self, item: CotMessage) -> None:
        """Send it soon; in place of one of the same uid that is not sent yet."""
        with self._lock:
            if self._error is not None:
                raise self._error
            self._unsent[item.uid] = item.data
            if len(self._unsent) > _MOST_EVENTS:
                del self._unsent[next(iter(self._unsent))]
        self._notify()

    def close(self, hurry: threading.Event | None = None) -> None:
        """Send waiting events, within a second, and close."""
        with self._lock:
            self._ending = True
            if hurry is not None and hurry.is_set():
                self._unsent.clear()
        self._notify()
        self._thread.join(2 * END_S)

    def _notify(self) -> None:
        with suppress(RuntimeError):  # the loop has ended, and `_error` says why
            self._loop.call_soon_threadsafe(self._wake.set)

    def _take(self) -> bytes | None:
        with self._lock:
            for uid in self._unsent:
                return self._unsent.pop(uid)
        return None

    # In its own thread

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._use())
        except Exception as error:  # noqa: BLE001 - pytak and the network raise anything
            failure = UserError(f"{self._url}: {_reason(error, self._url)}")
            with self._lock:
                self._error = failure
                self._unsent.clear()
            if not self._opened.done():
                self._opened.set_exception(failure)
        finally:
            self._loop.close()

    async def _use(self) -> None:
        reader, writer = await asyncio.wait_for(pytak.protocol_factory(self._settings), CONNECT_S)
        tasks = []
        try:
            _bound_buffers(writer)
            self._opened.set_result(None)
            tasks = [asyncio.ensure_future(self._send(writer)), asyncio.ensure_future(_read(reader))]
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for one in done:
                one.result()
        finally:
            for one in tasks:
                one.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await _close(writer)

    async def _send(self, writer: Any) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while (data := self._take()) is not None:
                await asyncio.wait_for(_send_one(writer, data), END_S if self._ending else SEND_S)
            if self._ending:
                return


async def _send_one(writer: Any, data: bytes) -> None:
    """Over pytak's writer of datagrams, or a stream."""
    if isinstance(writer, asyncio.StreamWriter):
        writer.write(data)
        await writer.drain()
    else:
        await writer.send(data)


async def _read(reader: asyncio.StreamReader | None) -> None:
    """A server passes on messages of others; a client that does not read them is cut off."""
    if reader is None:
        await asyncio.Event().wait()
        return
    while await reader.read(_READ_BYTES):
        pass
    raise ConnectionError("the server has closed the connection")


def _bound_buffers(writer: Any) -> None:
    if not isinstance(writer, asyncio.StreamWriter):
        return
    writer.transport.set_write_buffer_limits(high=_BUFFER_BYTES)
    made = writer.get_extra_info("socket")
    made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BYTES)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # a server that is gone without a word
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(SEND_S * 1000))


async def _close(writer: Any) -> None:
    writer.close()
    if isinstance(writer, asyncio.StreamWriter):
        with suppress(Exception):  # it may be broken, which is why it is closed
            await asyncio.wait_for(writer.wait_closed(), END_S)
        writer.transport.abort()  # of a server that does not answer the farewell of TLS
    await asyncio.sleep(0)  # transports close in the loop's next round


def _reason(error: BaseException, url: str) -> str:
    """The cause in a few words; pytak wraps OpenSSL's message into advice not to verify."""
    root = error.__cause__ if isinstance(error, SyntaxError) and error.__cause__ is not None else error
    if isinstance(root, ssl.SSLCertVerificationError):
        return f"the server's certificate is not accepted ({root.verify_message}); {_CAFILE} names its CA"
    if isinstance(root, TimeoutError):
        return "it does not answer"
    if isinstance(root, socket.gaierror):
        return "there is no host of this name"
    if isinstance(root, ssl.SSLError):
        return f"TLS failed ({root.reason or root})"
    if isinstance(root, OSError) and root.strerror:
        return _os_reason(root, url)
    return str(root) or type(root).__name__


def _os_reason(error: OSError, url: str) -> str:
    if error.errno == errno.ENETUNREACH and is_group(urlsplit(url).hostname):
        return f"no route leads to the group: set {_ADDRS} to this machine's address in the network of its receivers"
    return os.strerror(error.errno) if error.errno and error.errno > 0 else str(error.strerror)


def _say_quietly(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    _log.debug("CoT: %s", context.get("message"))
