"""A model in a manifest, and its reader.

``manifest.toml`` beside this file is the built-in one; ``added.toml`` in the cache folder has the same form and holds
the models that the user added. A table's name is the model's name; its keys are the fields of `ModelEntry`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.resources import files
from typing import Any
from urllib.parse import urlsplit

from hvt_common.errors import UserError
from hvt_common.files import toml_table

MAX_SIZE_BYTES = 1 << 30
"""1 GiB, as much as a model may have when it is opened."""

_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,47}")
_PIN = ("size_bytes", "sha256", "urls")
_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class PinnedFile:
    """One file of a model."""

    size_bytes: int
    sha256: str
    """64 hexadecimal digits in lower case."""
    urls: tuple[str, ...] = ()
    """Where the file is, best first; empty for a model that only came by hand."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelEntry(PinnedFile):
    """One pinned model; the fields of `PinnedFile` are those of its first file."""

    name: str
    weights: PinnedFile | None = None
    """The .bin beside the .xml of an OpenVINO model; None for an ONNX file."""
    task: str = ""
    """detector or classifier."""
    about: str = ""
    classes: str = ""
    """The data set and a number, or the names by commas where the file does not hold them."""
    licence: str = ""
    preprocessing: Mapping[str, Any] | None = None
    """channels, mean and scale (network value = (pixel - mean) * scale), fit. The adapters do not need it:
    it is for use of the file elsewhere, and a test compares both."""

    @property
    def files(self) -> dict[str, PinnedFile]:
        """The files that the model is, by suffix; the one that is opened comes first."""
        return {".onnx": self} if self.weights is None else {".xml": self, ".bin": self.weights}

    @property
    def total_bytes(self) -> int:
        return sum(file.size_bytes for file in self.files.values())


def builtin_manifest() -> dict[str, ModelEntry]:
    text = (files("hvt_models") / "manifest.toml").read_text(encoding="utf-8")
    return parse_manifest(text, origin="the built-in manifest")


def parse_manifest(text: str, *, origin: str) -> dict[str, ModelEntry]:
    """Read a manifest. Raises `UserError` where it is none, in a sentence that names ``origin``."""
    try:
        tables = toml_table(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{origin} is not valid TOML ({error})") from error
    return {name: _entry(name, table, origin=origin) for name, table in tables.items()}


def check_name(name: str) -> str:
    """Return ``name``; `UserError` where it cannot be a model's name."""
    if not _NAME.fullmatch(name):
        raise UserError(f"model name '{name}' is not accepted: 1 to 48 of a-z, 0-9 and -")
    return name


def check_digest(digest: str) -> str:
    """Return the SHA-256 in lower case; `UserError` where it is none."""
    if not _DIGEST.fullmatch(digest.lower()):
        raise UserError(f"SHA-256 '{digest}' is not accepted: 64 hexadecimal digits are")
    return digest.lower()


def _entry(name: str, table: Any, *, origin: str) -> ModelEntry:
    pin = _pin(name, table, ModelEntry, origin=origin)
    weights = table.get("weights")
    rest = {key: value for key, value in table.items() if key not in (*_PIN, "weights")}
    return ModelEntry(
        name=check_name(name),
        weights=None
        if weights is None
        else PinnedFile(**_pin(f"{name}.weights", weights, PinnedFile, origin=origin)),
        **pin,
        **rest,
    )


def _pin(name: str, table: Any, kind: type[PinnedFile], *, origin: str) -> dict[str, Any]:
    # The fields of a `PinnedFile` out of a table that holds those of ``kind``.
    known = {field.name for field in fields(kind)} - {"name"}
    if not isinstance(table, dict) or not {"size_bytes", "sha256"} <= table.keys() <= known:
        raise UserError(
            f"{origin} has a model '{name}' that needs size_bytes and sha256 and takes {', '.join(sorted(known))}"
        )
    size, urls = table["size_bytes"], table.get("urls", [])
    if not isinstance(size, int) or not 0 < size <= MAX_SIZE_BYTES:
        raise UserError(
            f"{origin}: size_bytes {size!r} of '{name}' is not accepted: 1 to {MAX_SIZE_BYTES} is"
        )
    if not isinstance(urls, list) or not all(_is_http(url) for url in urls):
        raise UserError(f"{origin}: urls of '{name}' are not accepted: a list of http and https addresses is")
    return {"size_bytes": size, "sha256": check_digest(str(table["sha256"])), "urls": tuple(urls)}


def _is_http(url: object) -> bool:
    if not isinstance(url, str) or any(ord(letter) <= 0x20 for letter in url):
        return False
    try:
        parts = urlsplit(url)
    except ValueError:  # brackets that hold no address
        return False
    return parts.scheme in ("http", "https") and bool(parts.hostname)
