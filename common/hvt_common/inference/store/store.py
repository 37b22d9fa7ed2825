"""The cache folder of models: fetched or brought by hand, and checked each time before use.

Layout: ``NAME.onnx``, ``NAME-DIGEST.part`` while it is being fetched, ``added.toml`` for what the user added, and
lock files, so that two processes may fetch at once.
"""

from __future__ import annotations

import difflib
import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError
from hvt_common.inference.store.manifest import (
    MAX_SIZE_BYTES,
    ModelEntry,
    builtin_manifest,
    check_digest,
    check_name,
    parse_manifest,
)

_CHUNK_BYTES = 1 << 20
_ADDED = "added.toml"


def cache_folder() -> Path:
    """The folder of models: ``HVT_MODELS``, else ``hvt/models`` in the platform's cache folder."""
    own = os.environ.get("HVT_MODELS")
    if own:
        return Path(own).expanduser()
    import platformdirs  # noqa: PLC0415 - a start that names no model needs none of these

    return Path(platformdirs.user_cache_path("hvt")) / "models"


def file_digest(path: Path) -> str:
    """SHA-256 of a file in 64 hexadecimal digits. Raises `UserError` where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"model file {path} cannot be read ({error.strerror})") from error


class Store:
    """Models by name in one folder, which is made when something is put into it (default: `cache_folder`).

    Raises `UserError` where ``added.toml`` in the folder is not a manifest.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder if folder is not None else cache_folder()
        self._builtin = builtin_manifest()

    @property
    def entries(self) -> dict[str, ModelEntry]:
        """Every model that has a name, the built-in ones first; they cannot be overridden."""
        return {**self._builtin, **{k: v for k, v in self._added().items() if k not in self._builtin}}

    def entry(self, name: str) -> ModelEntry:
        """The entry of this name; `UserError` with near names where there is none."""
        entries = self.entries
        if name not in entries:
            near = difflib.get_close_matches(name, entries, n=2) or sorted(entries)
            raise UserError(f"model '{name}' is not known: did you mean {' or '.join(near)}?")
        return entries[name]

    def path(self, name: str) -> Path:
        """The path of the model of this name, there or not."""
        return self.folder / f"{self.entry(name).name}.onnx"

    def held_bytes(self, name: str) -> int:
        """Bytes of an unfinished fetch of this name."""
        part = self._part(self.entry(name))
        return part.stat().st_size if part.exists() else 0

    def is_there(self, name: str) -> bool:
        """Whether a file of this name is there, right or not."""
        return self.path(name).exists()

    def verified(self, name: str) -> Path:
        """The path of a model that is there and is the pinned file, size and SHA-256.

        Raises `UserError` where it is not there, with the ways to get it, or it is another file.
        """
        entry, path = self.entry(name), self.path(name)
        if not path.exists():
            raise UserError(f"model {name} is not on this machine: {self._how_to_get(entry)}")
        wrong = _what_is_wrong(path, entry)
        if wrong:
            raise UserError(f"model {name} in {path} {wrong} and is not used: {self._how_to_get(entry)}")
        return path

    def fetch(
        self,
        name: str,
        *,
        progress: Callable[[int], None] = lambda _: None,
        on_wait: Callable[[], None] = lambda: None,
        pauses_s: Sequence[float] = (1.0, 2.0, 4.0),
    ) -> Path:
        """Get a model from its first address that gives it; nothing is done where it is there and right.

        ``progress`` gets the bytes held so far. ``on_wait`` is called once where another process is fetching
        the same model; then this one waits for it. ``pauses_s`` are the seconds after each try that brought
        nothing. Raises `UserError` where no address gives the pinned file, or the folder cannot be written.
        """
        from hvt_common.inference.store.download import DownloadError  # noqa: PLC0415 - as above

        entry, path = self.entry(name), self.path(name)
        with self._lock(name, on_wait):
            if path.exists() and not _what_is_wrong(path, entry):
                return path
            part = self._part(entry)
            failures = []
            for url in entry.urls:
                try:
                    _from_address(url, part, entry, progress=progress, pauses_s=pauses_s)
                except DownloadError as error:
                    failures.append(str(error))
                    continue
                _put_in_place(part, path)
                return path
        why = "; ".join(failures) or "no address is known for it"
        held = self.held_bytes(name)
        rest = f" ({held} bytes are kept, and the same command goes on from there)" if held else ""
        raise UserError(f"model {name} could not be fetched: {why}{rest}; {_by_hand(entry)}")

    def add(self, file: Path, *, name: str, sha256: str | None = None) -> Path:
        """Copy a file that was brought by hand into the folder, if it is the pinned one.

        ``sha256`` must be given for a new name, and pins it; for a built-in name it must agree with the
        manifest. Raises `UserError` for another file than pinned, a missing pin, or a folder that cannot be
        written.
        """
        check_name(name)
        given = check_digest(sha256) if sha256 is not None else None
        found = file_digest(file)
        size_bytes = file.stat().st_size
        if not 0 < size_bytes <= MAX_SIZE_BYTES:
            raise UserError(f"model file {file} has {size_bytes} bytes: 1 to {MAX_SIZE_BYTES} are accepted")
        known = self.entries.get(name)
        if known is None and given is None:
            raise UserError(
                f"model file {file} has SHA-256 {found}: give --sha256 {found} if its origin says the same"
            )
        if given not in (found, None):
            raise UserError(f"model file {file} has SHA-256 {found}, but --sha256 is {given}")
        # The digest that was given is a new pin, except for the models that HVT itself pins.
        if known is not None and known.sha256 != found and (name in self._builtin or given is None):
            raise UserError(f"model file {file} has SHA-256 {found}, but {known.sha256} is pinned for {name}")
        with self._lock(name):
            if known is None or known.sha256 != found:
                self._note(ModelEntry(name=name, size_bytes=size_bytes, sha256=found))
            part = self._part(self.entry(name))
            _copy_file(file, part)
            _put_in_place(part, self.path(name))
        return self.verified(name)

    def _added(self) -> dict[str, ModelEntry]:
        file = self.folder / _ADDED
        try:
            text = file.read_text(encoding="utf-8")
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{file} cannot be read ({error})") from error
        return parse_manifest(text, origin=str(file))

    def _note(self, entry: ModelEntry) -> None:
        """Write ``entry`` into ``added.toml``, whole or not at all."""
        file = self.folder / _ADDED
        import tomli_w  # noqa: PLC0415 - as above

        with self._lock("added-toml"):
            entries = {**self._added(), entry.name: entry}
            tables = {name: _table(one) for name, one in entries.items()}
            scratch = file.with_name(f"{_ADDED}.part")
            scratch.write_text(tomli_w.dumps(tables), encoding="utf-8")
            scratch.replace(file)

    def _part(self, entry: ModelEntry) -> Path:
        # The digest is in the name: what was fetched for one pin is never carried on for another.
        return self.folder / f"{entry.name}-{entry.sha256[:12]}.part"

    @contextmanager
    def _lock(self, name: str, on_wait: Callable[[], None] = lambda: None) -> Iterator[None]:
        import filelock  # noqa: PLC0415 - as above

        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.folder / f".{name}.lock")
            try:
                lock.acquire(timeout=0)
            except filelock.Timeout:
                on_wait()
                lock.acquire()
        except OSError as error:
            raise UserError(
                f"models folder {self.folder} cannot be written ({error.strerror}): set HVT_MODELS to one that can"
            ) from error
        try:
            yield
        finally:
            lock.release()

    def _how_to_get(self, entry: ModelEntry) -> str:
        if not entry.urls:
            return _by_hand(entry)
        return f"run 'hvt-models fetch {entry.name}' ({entry.size_bytes / 1e6:.1f} MB); {_by_hand(entry)}"


def _by_hand(entry: ModelEntry) -> str:
    file = entry.urls[0] if entry.urls else f"the file with SHA-256 {entry.sha256}"
    return f"where there is no network, bring {file} and run 'hvt-models add FILE --name {entry.name}'"


def _what_is_wrong(path: Path, entry: ModelEntry) -> str:
    """Why this is not the pinned file, as half a sentence; empty where it is."""
    size_bytes = path.stat().st_size
    if size_bytes != entry.size_bytes:
        return f"has {size_bytes} bytes, not the {entry.size_bytes} that are pinned,"
    found = file_digest(path)
    if found != entry.sha256:
        return f"has SHA-256 {found[:12]}…, not the pinned {entry.sha256[:12]}…,"
    return ""


def _from_address(
    url: str, part: Path, entry: ModelEntry, *, progress: Callable[[int], None], pauses_s: Sequence[float]
) -> None:
    """Bring ``part`` to the pinned file; `DownloadError` where this address does not give it."""
    from hvt_common.inference.store.download import DownloadError, download  # noqa: PLC0415 - as above

    went_on = part.exists()
    download(url, part, size_bytes=entry.size_bytes, progress=progress, pauses_s=pauses_s)
    wrong = _what_is_wrong(part, entry)
    if wrong:
        part.unlink()
        if went_on:  # the fault may be in what was there before
            _from_address(url, part, entry, progress=progress, pauses_s=pauses_s)
            return
        raise DownloadError(f"{url} gives a file that {wrong.rstrip(',')}")


def _copy_file(source: Path, target: Path) -> None:
    try:
        with source.open("rb") as read, target.open("wb") as write:
            while chunk := read.read(_CHUNK_BYTES):
                write.write(chunk)
    except OSError as error:
        raise UserError(f"{source} cannot be copied to {target} ({error.strerror})") from error


def _put_in_place(part: Path, path: Path) -> None:
    """Give the whole file its name, in one step and for good."""
    try:
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror})") from error


def _table(entry: ModelEntry) -> dict[str, Any]:
    """The entry as TOML knows it: without its name and without empty values."""
    fields = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(entry).items()}
    return {key: value for key, value in fields.items() if value and key != "name"}
