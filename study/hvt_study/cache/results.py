"""Results that are never worked out twice: small JSON files, named by the content that decides them.

Each carries a checksum of its own. One that was cut off or changed is thrown away with a warning and made again.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError

_log = logging.getLogger(__name__)
_CHUNK_BYTES = 1 << 20
FLIGHTS = "flights"
"""Of the cache: results of flights."""


class CacheError(UserError):
    """What was worked out cannot be kept (the disk is full): that is no fault of one run, and ends the study."""


def content_key(*parts: object) -> str:
    """One name for all that decides a result; parts are anything that JSON can hold."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal.

    Raises:
        UserError: it cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                digest.update(chunk)
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name a file that can") from None
    return digest.hexdigest()


class ResultCache:
    """A folder of results. Several processes may use it at once.

    Raises:
        UserError: the folder cannot be made.
        CacheError: from `put`, it cannot be written any further.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cache {folder} cannot be made ({error.strerror}): name a folder") from None

    def get(self, key: str) -> dict[str, Any] | None:
        """What was put under this key; None where there is nothing, or nothing whole."""
        path = self._path(key)
        try:
            checksum, _, text = path.read_text(encoding="utf-8").partition("\n")
        except FileNotFoundError:
            return None
        except (OSError, UnicodeDecodeError) as error:
            _log.warning("%s cannot be read (%s) and is made again", path, error)
            return None
        if checksum != _checksum(text):
            _log.warning("%s is damaged and is made again", path)
            path.unlink(missing_ok=True)
            return None
        found: dict[str, Any] = json.loads(text)
        return found

    def count(self) -> int:
        """How many there are."""
        return sum(1 for _ in self._folder.glob("*/*.json"))

    def put(self, key: str, result: Mapping[str, Any]) -> None:
        """Keep a result; whole or not at all, whenever the process dies."""
        path = self._path(key)
        text = json.dumps(result, separators=(",", ":"))
        scratch = path.with_suffix(f".{os.getpid()}")
        try:
            path.parent.mkdir(exist_ok=True)
            scratch.write_text(f"{_checksum(text)}\n{text}", encoding="utf-8")
            scratch.replace(path)
        except OSError as error:
            scratch.unlink(missing_ok=True)
            raise CacheError(
                f"cache {self._folder} cannot be written ({error.strerror}): what is in it stays; make room, or name "
                "another with --cache"
            ) from None

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
