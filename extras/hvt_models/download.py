"""Resumable download of one file over HTTP.

The usual library, pooch, cannot resume: on a thin link 100 MB would start over at each interruption. Resuming
takes a Range header and care with the server's answer (RFC 9110, sections 14 and 15.3.7).
"""

from __future__ import annotations

import http.client
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

from hvt_common import __version__
from hvt_common.errors import telling

Progress = Callable[[int], None]
"""Gets the bytes that are there so far; they may become fewer when a server starts over."""

_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30.0
_TRANSIENT_STATUS = frozenset({408, 425, 429, 500, 502, 503, 504})


class DownloadError(Exception):
    """This address does not give the file; the text says why, in half a sentence that begins with the address."""


class _InterruptedError(Exception):
    """The connection failed in a way that another try may mend."""


def download(
    url: str, part: Path, *, size_bytes: int, progress: Progress, pauses_s: Sequence[float] = (1.0, 2.0, 4.0)
) -> None:
    """Bring ``part`` to ``size_bytes``, continuing after the bytes that it holds; its content is not checked here.

    A try that brought bytes is followed by another; after ``pauses_s`` tries in a row that brought none it gives up.

    Raises:
        DownloadError: The address does not answer, lacks the file, or has one of another size; the bytes so far stay
            in ``part``.
        UserError: ``part`` cannot be written.
    """
    failures = 0
    while (before := _held(part)) != size_bytes:
        if before > size_bytes:
            part.unlink()
            continue
        try:
            _one_try(url, part, size_bytes=size_bytes, progress=progress)
        except _InterruptedError as error:
            failures = 0 if _held(part) > before else failures + 1
            if failures >= len(pauses_s):
                raise DownloadError(f"{url} {error}") from error
            time.sleep(pauses_s[failures])


def _held(part: Path) -> int:
    return part.stat().st_size if part.exists() else 0


def _one_try(url: str, part: Path, *, size_bytes: int, progress: Progress) -> None:
    offset = _held(part)
    headers = {"User-Agent": f"hvt-models/{__version__}", "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    # Addresses come from manifests, which accept http and https only; urllib follows redirects to no other scheme
    # but ftp.
    request = urllib.request.Request(url, headers=headers)  # noqa: S310
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:  # noqa: S310
            start = _start_of(url, response, offset=offset, size_bytes=size_bytes)
            with telling(f"{part} cannot be written (", "): free space, or set HVT_MODELS"):
                file = part.open("ab" if start else "wb")
            with file:
                _copy(response, file, start=start, size_bytes=size_bytes, progress=progress)
    except urllib.error.HTTPError as error:
        _answer_failed(url, part, error, offset=offset)
    except urllib.error.URLError as error:
        if isinstance(error.reason, socket.gaierror | ConnectionRefusedError):
            raise DownloadError(f"{url} cannot be reached ({error.reason})") from error
        raise _InterruptedError(f"cannot be reached ({error.reason})") from error
    except (http.client.HTTPException, OSError) as error:
        raise _InterruptedError(f"broke off ({str(error) or type(error).__name__})") from error


def _answer_failed(url: str, part: Path, error: urllib.error.HTTPError, *, offset: int) -> None:
    text = f"answers {error.code} {error.reason}"
    error.close()
    if error.code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
        part.unlink()  # the file there is shorter than our part: this is part of something else
        return
    if error.code in _TRANSIENT_STATUS:
        raise _InterruptedError(text) from error
    raise DownloadError(f"{url} {text}") from error


def _start_of(url: str, response: http.client.HTTPResponse, *, offset: int, size_bytes: int) -> int:
    # The offset at which the answer begins; 0 where the server knows no ranges and sends the whole.
    if response.status == http.client.PARTIAL_CONTENT:
        words = response.headers.get("Content-Range", "").removeprefix("bytes ").partition("/")
        total = int(words[2]) if words[2].isdecimal() else size_bytes
        if words[0].partition("-")[0] != str(offset):
            raise DownloadError(f"{url} answers with a range that was not asked for")
        start = offset
    else:
        length = response.headers.get("Content-Length", "")
        total = int(length) if length.isdecimal() else size_bytes
        start = 0
    if total != size_bytes:
        raise DownloadError(f"{url} has {total} bytes, not the {size_bytes} that are pinned")
    return start


def _copy(
    response: http.client.HTTPResponse, file: BinaryIO, *, start: int, size_bytes: int, progress: Progress
) -> None:
    held = start
    while chunk := response.read(_CHUNK_BYTES):
        held += len(chunk)
        if held > size_bytes:
            raise DownloadError(f"{response.url} sends more than the {size_bytes} bytes that are pinned")
        rest = f"): free {size_bytes - held} bytes, or set HVT_MODELS"
        with telling(f"{file.name} cannot be written (", rest):
            file.write(chunk)
            file.flush()
        progress(held)
    if held < size_bytes:
        raise _InterruptedError(f"broke off after {held} of {size_bytes} bytes")
