"""Results that are never computed twice, whole or not at all: small files, named by the content that decides them.

Each carries a checksum of its own. One that was cut off or changed is thrown away with a warning and made again.
HVT's own code counts by its content: a version that stays the same through a hundred edits does not identify it.

The cost of a detection is remembered with it, so that a flight can still state its full cost. An answer is named by
all that decides it: the content of the model file, its provider, the code and the versions of the libraries on the
way, and the pixels.
"""

import hashlib
import json
import logging
import os
import platform
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from hvt_common.errors import UserError
from hvt_common.inference.detect import OnnxDetector
from hvt_common.inference.runtimes.model import ModelSettings, open_model
from hvt_common.inference.runtimes.model_file import files_of
from hvt_common.inference.store import resolve_model
from hvt_common.values import Detections, Image

DETECTING = ("hvt_common", "hvt_models")
"""Packages that decide a detector's results."""
FLYING = (*DETECTING, "hvt_codecs", "hvt_edge", "hvt_ground", "hvt_scene", "hvt_study")
"""Has one in a flight and its figures."""
KINDS = (".py", ".toml", ".csv", ".txt", ".onnx", ".j2", ".css")
"""Ends of the names of all files that these packages consist of."""
_BESIDE = ("hvt_study/commands", "hvt_study/report")
"""Has no say in a flight or in its figures."""
_DIGITS = 16


def flight_code() -> str:
    """Digest of all code that decides a flight and its figures: edge, ground, extras that matter, and the study."""
    return code_digest(*FLYING, without=_BESIDE)


@cache
def code_digest(*packages: str, without: tuple[str, ...] = ()) -> str:
    """Digest of the files of these packages, as they are installed here; a process reads them once.

    A checkout and a wheel with the same files have the same digest. ``without`` names folders that are passed over.
    """
    return tree_digest(_folders(packages), without=without)


def tree_digest(folders: Iterable[Path], *, without: Collection[str] = ()) -> str:
    """Hexadecimal; of the names and contents of all files below, in whatever order a disk lists them.

    Tables of class names decide figures as code does; hidden files and other kinds than `KINDS`, such as bytecode and
    an editor's copies, are left out. ``without`` names folders as `code_digest` does: from the last part of one of
    ``folders`` on.
    """
    digest = hashlib.sha256()
    files = {
        file.relative_to(folder.parent).as_posix(): file for folder in folders for file in _counting(folder)
    }
    for name, file in sorted(files.items()):
        if any(name.startswith(f"{folder}/") for folder in without):
            continue
        try:
            content = file.read_bytes()
        except FileNotFoundError:  # since it was listed
            continue
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:_DIGITS]


def _counting(folder: Path) -> Iterator[Path]:
    for place, folders, names in os.walk(folder):
        folders[:] = (name for name in folders if not name.startswith("."))
        for name in names:
            if name.endswith(KINDS) and not name.startswith("."):
                yield Path(place, name)


def installed(packages: Iterable[str]) -> dict[str, str]:
    """The versions of those of these packages that are installed."""
    found = {}
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _folders(packages: Iterable[str]) -> Iterator[Path]:
    for name in packages:
        found = find_spec(name)
        assert found is not None, f"{name} is a part of HVT"
        yield from map(Path, found.submodule_search_locations or ())


_log = logging.getLogger(__name__)

_CHECKSUM_BYTES = 16


class CacheError(UserError):
    """A result cannot be kept (the disk is full): that is no fault of one run, and ends the study."""


def content_key(*parts: object) -> str:
    """One name for all that decides a result; parts are anything that JSON can hold."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:40]


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content, hexadecimal; `UserError` where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror}): name a file that can") from None


def make_folder(folder: Path) -> Path:
    """The folder of a cache, which is made; `UserError` where it cannot be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cache {folder} cannot be made ({error.strerror}): name a folder") from None
    return folder


def check_cache(folder: Path) -> None:
    """Make the folder; `UserError` now where it cannot be made, or nothing be written into it."""
    trial = make_folder(folder) / "trial"
    write_whole(trial, b"")
    trial.unlink(missing_ok=True)


def read_whole(path: Path) -> bytes | None:
    """The bytes of `write_whole` there; None where there are none, or no whole ones."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        _log.warning("%s cannot be read (%s) and is made again", path, error.strerror)
        return None
    body = data[_CHECKSUM_BYTES:]
    if data[:_CHECKSUM_BYTES] != _checksum(body):
        _log.warning("%s is damaged and is made again", path)
        path.unlink(missing_ok=True)
        return None
    return body


def write_whole(path: Path, body: bytes) -> None:
    """Write it, whole or not at all, whenever the process dies; another one may be reading.

    Raises `CacheError` where it cannot be written.
    """
    scratch = path.with_name(f"{path.name}.{platform.node()}-{os.getpid()}")  # containers share numbers
    try:
        path.parent.mkdir(exist_ok=True)
        scratch.write_bytes(_checksum(body) + body)
        scratch.replace(path)
    except OSError as error:
        with suppress(OSError):
            scratch.unlink()
        raise CacheError(
            f"cache {path.parent} cannot be written ({error.strerror}): what is in it stays; make room, or name "
            "another with --cache"
        ) from None


class ResultCache:
    """A folder of results, which JSON can hold; several processes may use it. `UserError` where it cannot be made."""

    def __init__(self, folder: Path) -> None:
        self._folder = make_folder(folder)

    def get(self, key: str) -> dict[str, Any] | None:
        """The value under this key; None where there is none, or no whole one."""
        body = read_whole(self._path(key))
        found: dict[str, Any] | None = None if body is None else json.loads(body)
        return found

    def put(self, key: str, result: Mapping[str, Any]) -> None:
        write_whole(self._path(key), json.dumps(result, separators=(",", ":")).encode())

    def known(self, key: str, make: Callable[[], Mapping[str, Any]]) -> Mapping[str, Any]:
        """The value under this key; else it is made, and put there."""
        found: Mapping[str, Any] | None = self.get(key)
        if found is None:
            found = make()
            self.put(key, found)
        return found

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"


def _checksum(body: bytes) -> bytes:
    return hashlib.sha256(body).digest()[:_CHECKSUM_BYTES]


_PACKAGES = ("numpy", "opencv-python-headless", "onnxruntime", "onnxruntime-gpu", "openvino")
"""Those that may have a say in an answer, as far as they are installed."""
digest_of_file = cache(file_digest)
"""Once in a study, or until the file changes (`hvt_study.runs.run_context`)."""


class CachedDetector(OnnxDetector):
    """The network that ``spec`` names, on one thread; its answers lie in ``folder``, which processes may share.

    Raises `UserError` as `hvt_common.inference.detect.open_detector`; `detect` raises `CacheError` on a full disk.
    """

    def __init__(self, spec: str, *, confidence: float, provider: str, folder: Path) -> None:
        path = resolve_model(spec, role="detector")
        super().__init__(
            open_model(path, settings=ModelSettings(threads=1, provider=provider)), confidence=confidence
        )
        said = (
            *(digest_of_file(file.resolve()) for file in files_of(path)),
            self.model.provider.provider,
            f"{confidence:g}",
            f"code {code_digest(*DETECTING)}",
            *(f"{name} {number}" for name, number in installed(_PACKAGES).items()),
        )
        self._name = " ".join(said).encode()
        self._folder = make_folder(folder)
        self.saved_cpu_s = 0.0
        """The cost of the answers out of memory, less that of remembering."""

    def detect(self, image_bgr: Image, *, share: float = 1.0) -> Detections:
        assert share == 1, "a study flies in lockstep, where nothing is reduced"
        began_s = time.process_time()
        path = self._folder / self._key(image_bgr)
        known = _read(path)
        if known is None:
            began_s = time.process_time()
            found = super().detect(image_bgr)
            cost_s = time.process_time() - began_s
            _write(path, found, cost_s)
        else:
            found, cost_s = known
        self.saved_cpu_s += cost_s - (time.process_time() - began_s)
        return found

    def _key(self, image_bgr: Image) -> str:
        digest = hashlib.sha1(self._name + repr(image_bgr.shape).encode(), usedforsecurity=False)
        digest.update(image_bgr.tobytes())
        return digest.hexdigest()


def _read(path: Path) -> tuple[Detections, float] | None:
    """The answer there; None where there is none, or no whole one."""
    body = read_whole(path)
    if body is None:
        return None
    cost_s, boxes, confidences, class_ids = msgpack.unpackb(body)
    found = Detections(
        np.frombuffer(boxes, "<f4").reshape(-1, 4).astype(np.float32),
        np.frombuffer(confidences, "<f4").astype(np.float32),
        np.frombuffer(class_ids, "<i4").astype(np.int32),
    )
    return found, float(cost_s)


def _write(path: Path, found: Detections, cost_s: float) -> None:
    arrays = (found.boxes_xyxy_px, "<f4"), (found.confidences, "<f4"), (found.class_ids, "<i4")
    write_whole(path, msgpack.packb([cost_s, *(one.astype(dtype).tobytes() for one, dtype in arrays)]))
