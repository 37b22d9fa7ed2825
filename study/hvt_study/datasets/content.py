"""A hash of everything that a sequence is made of, so that a result says what it was measured on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

from hvt_edge.source.folder import sequence_files
from hvt_study.datasets.sequence import Sequence

_CHUNK_BYTES = 1 << 20


def content_hash(sequence: Sequence) -> str:
    """SHA-256, hexadecimal, of the bytes of pictures and annotations and of how they are played, wherever they lie.

    It reads every file once: seconds for a sequence of a thousand images. The drawn demo is its seed.
    """
    digest = hashlib.sha256(f"{sequence.dataset} {sequence.fps:.9g} {sequence.clip.seed}".encode())
    digest.update(repr(sorted(sequence.attributes.items())).encode())
    for path in sequence.files:
        for file in _files(path):
            digest.update(f"\n{file.name} {file.stat().st_size}\n".encode())
            _add(digest, file)
    return digest.hexdigest()


def _files(path: Path) -> Iterator[Path]:
    if path.is_dir():
        yield from sequence_files(path)
    elif path.is_file():
        yield path


def _add(digest: hashlib._Hash, file: Path) -> None:
    with file.open("rb") as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            digest.update(chunk)
