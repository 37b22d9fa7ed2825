"""The cache folder of models: fetched or brought by hand, and checked each time before use.

Layout: ``NAME.onnx``, or ``NAME.xml`` and ``NAME.bin`` of OpenVINO; ``NAME-DIGEST.part`` while it is being fetched;
``added.toml`` for models that the user added; lock files, so that two processes may fetch at once.
"""

from __future__ import annotations

import difflib
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hvt_common.errors import UserError, named_path, telling
from hvt_common.files import locked, read_text
from hvt_common.inference.store import MOTION, embedded_models
from hvt_models.exports.first_steps import own_steps
from hvt_models.manifest import (
    MAX_SIZE_BYTES,
    ModelEntry,
    PinnedFile,
    builtin_manifest,
    check_digest,
    check_name,
    parse_manifest,
)

_ADDED = "added.toml"


def cache_folder() -> Path:
    """The folder of models: ``HVT_MODELS``, else ``hvt/models`` in the platform's cache folder."""
    own = os.environ.get("HVT_MODELS")
    if own:
        return named_path(own, name="HVT_MODELS")
    import platformdirs  # noqa: PLC0415 - a start that names no model needs none of these

    return Path(platformdirs.user_cache_path("hvt")) / "models"


def file_digest(path: Path) -> str:
    """SHA-256 of a file in 64 hexadecimal digits. Raises `UserError` where it cannot be read."""
    with telling(f"model file {path} cannot be read (", "): name a file that can"), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
            _check_free(name)
            near = difflib.get_close_matches(name, entries, n=2) or sorted(entries)
            raise UserError(f"model '{name}' is not known: did you mean {' or '.join(near)}?")
        return entries[name]

    def known_classes(self, path: Path) -> str:
        """The classes of a file as the built-in manifest that pins it says: ``COCO, 80``, or names; "" for others."""
        try:
            size_bytes = path.stat().st_size
        except OSError:
            return ""
        entries = [entry for entry in self._builtin.values() if entry.size_bytes == size_bytes]
        same = [entry for entry in entries if file_digest(path) == entry.sha256]
        return same[0].classes if same else ""

    own_steps = staticmethod(own_steps)

    def path(self, name: str) -> Path:
        """The path of the model of this name, there or not; of an OpenVINO model the .xml."""
        return next(iter(self._files(name)))

    def _files(self, name: str) -> dict[Path, PinnedFile]:
        entry = self.entry(name)
        return {self.folder / f"{entry.name}{suffix}": file for suffix, file in entry.files.items()}

    def held_bytes(self, name: str) -> int:
        """Bytes of an unfinished fetch of this name."""
        if self.is_there(name):
            return 0
        candidates = [(path, self._part(path, file)) for path, file in self._files(name).items()]
        held = (next((one for one in pair if one.exists()), None) for pair in candidates)
        return sum(one.stat().st_size for one in held if one is not None)

    def is_there(self, name: str) -> bool:
        """Whether all files of this name are there, right or not."""
        return all(path.exists() for path in self._files(name))

    def verified(self, name: str) -> Path:
        """The path of a model that is there and is the pinned file, size and SHA-256.

        Raises `UserError` where it is not there, with the ways to get it, or it is another file.
        """
        entry = self.entry(name)
        if not self.is_there(name):
            raise UserError(f"model {name} is not on this machine: {self._how_to_get(entry)}")
        for path, file in self._files(name).items():
            wrong = _what_is_wrong(path, file)
            if wrong:
                raise UserError(f"model {name} in {path} {wrong} and is not used: {self._how_to_get(entry)}")
        return self.path(name)

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
        before = 0
        with self._lock(name, on_wait):
            for path, file in self._files(name).items():
                failures = self._fetch_file(path, file, progress, before, pauses_s)
                if failures is not None:
                    break
                before += file.size_bytes
            else:
                return self.path(name)
        why = "; ".join(failures) or "no address is known for it"
        held = self.held_bytes(name)
        rest = f" ({held} bytes are kept, and the same command goes on from there)" if held else ""
        raise UserError(f"model {name} could not be fetched: {why}{rest}; {_by_hand(self.entry(name))}")

    def _fetch_file(
        self,
        path: Path,
        file: PinnedFile,
        progress: Callable[[int], None],
        before: int,
        pauses_s: Sequence[float],
    ) -> list[str] | None:
        # None once the pinned file lies at ``path``; else why each address failed.
        from hvt_models.download import DownloadError  # noqa: PLC0415 - as above

        if path.exists() and not _what_is_wrong(path, file):
            return None
        part = self._part(path, file)
        failures = []
        for url in file.urls:
            try:
                _from_address(
                    url, part, file, progress=lambda held: progress(before + held), pauses_s=pauses_s
                )
            except DownloadError as error:
                failures.append(str(error))
                continue
            _put_in_place(part, path)
            return None
        return failures

    def add(self, file: Path, *, name: str, sha256: str | None = None) -> Path:
        """Copy a file that was brought by hand into the folder, if it is the pinned one.

        The .bin beside an OpenVINO .xml comes along. ``sha256`` must be given for a new name, of an OpenVINO model
        both by a comma, and pins it; for a built-in name it must agree with the manifest. Raises `UserError` for
        another file than pinned, a missing pin, or a folder that cannot be written.
        """
        _check_free(check_name(name))
        brought = (file, file.with_suffix(".bin")) if file.suffix.lower() == ".xml" else (file,)
        given = () if sha256 is None else tuple(check_digest(one.strip()) for one in sha256.split(","))
        pins = [_pin_of(one) for one in brought]
        known = self.entries.get(name)
        found = tuple(pin.sha256 for pin in pins)
        pinned = () if known is None else tuple(one.sha256 for one in known.files.values())
        names = " with ".join(map(str, brought))
        one_text = ",".join(found)
        if known is None and not given:
            raise UserError(
                f"model file {names} has SHA-256 {one_text}: give --sha256 {one_text} if its origin says the same"
            )
        if given not in (found, ()):
            raise UserError(f"model file {names} has SHA-256 {one_text}, but --sha256 is {','.join(given)}")
        # The digest that was given is a new pin, except for the models that HVT itself pins.
        if known is not None and pinned != found and (name in self._builtin or not given):
            raise UserError(
                f"model file {names} has SHA-256 {one_text}, but {','.join(pinned)} is pinned for {name}"
            )
        with self._lock(name):
            parts = [self._part(self.folder / name, pin) for pin in pins]
            for source, part in zip(brought, parts, strict=True):
                with telling(f"{source} cannot be copied to {part} (", ")"):
                    shutil.copyfile(source, part)  # before the pin changes: the disk may have no room for it
            if pinned != found:
                first, *more = pins
                self._note(
                    ModelEntry(
                        name=name,
                        size_bytes=first.size_bytes,
                        sha256=first.sha256,
                        weights=more[0] if more else None,
                    )
                )
            files = self._files(name)
            for part, path in zip(parts, files, strict=True):
                _put_in_place(part, path)
            for suffix in (".onnx", ".xml", ".bin"):  # of the format that the name had before
                if (old := self.folder / f"{name}{suffix}") not in files:
                    old.unlink(missing_ok=True)
        return self.verified(name)

    def _added(self) -> dict[str, ModelEntry]:
        file = self.folder / _ADDED
        try:
            text = read_text(file)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        except OSError as error:
            raise UserError(f"{file} cannot be read ({error.strerror})") from error
        return parse_manifest(text, origin=str(file))

    def _note(self, entry: ModelEntry) -> None:
        # Write ``entry`` into ``added.toml``, whole or not at all.
        file = self.folder / _ADDED
        import tomli_w  # noqa: PLC0415 - as above

        with self._lock(_ADDED):  # which no model is called
            entries = {**self._added(), entry.name: entry}
            tables = {name: _plain(asdict(one) | {"name": ""}) for name, one in entries.items()}
            scratch = file.with_name(f"{_ADDED}.part")
            with telling(f"{file} cannot be written (", ")"):
                scratch.write_text(tomli_w.dumps(tables), encoding="utf-8")
                scratch.replace(file)

    def _part(self, path: Path, file: PinnedFile) -> Path:
        # The digest is in the name: the part of one pin is never carried on for another.
        return path.with_name(f"{path.stem}-{file.sha256[:12]}.part")

    @contextmanager
    def _lock(self, name: str, on_wait: Callable[[], None] = lambda: None) -> Iterator[None]:
        with ExitStack() as lock:
            with telling(
                f"models folder {self.folder} cannot be written (", "): set HVT_MODELS to one that can"
            ):
                self.folder.mkdir(parents=True, exist_ok=True)
                lock.enter_context(locked(self.folder / f".{name}.lock", on_wait))
            yield

    def _how_to_get(self, entry: ModelEntry) -> str:
        if not entry.urls:
            return _by_hand(entry)
        return f"run 'hvt-models fetch {entry.name}' ({entry.total_bytes / 1e6:.1f} MB); {_by_hand(entry)}"


def _check_free(name: str) -> None:
    if name in (*embedded_models(), MOTION, "none", "detector"):  # the programs' own words
        raise UserError(f"model name '{name}' is HVT's own: there is nothing to fetch, verify or add")


def _by_hand(entry: ModelEntry) -> str:
    files = entry.files.values()
    file = " and ".join(one.urls[0] if one.urls else f"the file with SHA-256 {one.sha256}" for one in files)
    given = "FILE" if entry.weights is None else "FILE.xml"
    return f"where there is no network, bring {file} and run 'hvt-models add {given} --name {entry.name}'"


def _pin_of(file: Path) -> PinnedFile:
    found = file_digest(file)
    size_bytes = file.stat().st_size
    if not 0 < size_bytes <= MAX_SIZE_BYTES:
        raise UserError(f"model file {file} has {size_bytes} bytes: 1 to {MAX_SIZE_BYTES} are accepted")
    return PinnedFile(size_bytes, found)


def _what_is_wrong(path: Path, file: PinnedFile) -> str:
    # Why this is not the pinned file, as half a sentence; empty where it is.
    size_bytes = path.stat().st_size
    if size_bytes != file.size_bytes:
        return f"has {size_bytes} bytes, not the {file.size_bytes} that are pinned,"
    found = file_digest(path)
    if found != file.sha256:
        return f"has SHA-256 {found[:12]}…, not the pinned {file.sha256[:12]}…,"
    return ""


def _from_address(
    url: str, part: Path, file: PinnedFile, *, progress: Callable[[int], None], pauses_s: Sequence[float]
) -> None:
    # Bring ``part`` to the pinned file; `DownloadError` where this address does not give it.
    from hvt_models.download import DownloadError, download  # noqa: PLC0415 - as above

    went_on = part.exists()
    download(url, part, size_bytes=file.size_bytes, progress=progress, pauses_s=pauses_s)
    wrong = _what_is_wrong(part, file)
    if wrong:
        part.unlink()
        if went_on:  # the fault may be in the part of an earlier try
            _from_address(url, part, file, progress=progress, pauses_s=pauses_s)
            return
        raise DownloadError(f"{url} gives a file that {wrong.rstrip(',')}")


def _put_in_place(part: Path, path: Path) -> None:
    # Give the whole file its name, in one step and for good.
    with telling(f"{path} cannot be written (", ")"):
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)


def _plain(table: dict[str, Any]) -> dict[str, Any]:
    # Lists for tuples, and nothing that is empty, in tables in it too.
    lists = {key: list(value) if isinstance(value, tuple) else value for key, value in table.items()}
    return {key: _plain(value) if isinstance(value, dict) else value for key, value in lists.items() if value}
