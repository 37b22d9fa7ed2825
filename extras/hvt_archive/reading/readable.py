"""The part of a damaged recording that the SDK can read, found without reading it in this process.

On some damage the SDK does not raise: it ends its process. So a process forks for each try. To start it takes as
long as to import Rerun: it stays for the next file, and ends with this process or after some seconds without one.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import resource
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from rerun.chunk import RrdReader

from hvt_ground.sinks.rerun.rrd_file import END, MESSAGE_HEADER, STREAM_HEADER_BYTES, open_rrd
from hvt_ground.sinks.rerun.sdk import RecordingId

_MAGIC = b"RRF2"
_STORE_INFO, _CHUNK, _LAST_KIND = 1, 2, 3
_CHUNK_KIND = _CHUNK.to_bytes(8, "little")
_BLOCK_BYTES = 2**16
_WHOLE, _COPIED, _NOTHING = b"0", b"1", b"2"
_FOOT_BYTES = 32
"""Between the last message of a recording and its end."""
_TRIES = 100
_TRY_S, _PATIENCE_S, _IDLE_S = 60, 600.0, 10.0

_Span = tuple[int, int]
"""Where a message begins and ends."""


def readable(path: Path, out: Path) -> Path | None:
    """``path`` if the SDK reads all of it; else ``out``, a copy of the messages that it reads; None if it reads none.

    After a power cut a file breaks off or ends in zeros, and cards lose bits.
    """
    try:
        found = _tries.found(path, out)
    except OSError:
        return None
    return {_WHOLE: path, _COPIED: out}.get(found)


class _Tries:
    """The process that tries to read, while files come; one at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._lock, self._idle = threading.Lock(), threading.Timer(_IDLE_S, self.rest)
        atexit.register(self.end)

    def found(self, path: Path, out: Path) -> bytes:
        """Nothing if it was killed; `OSError` where it does not start, or finds nothing in ten minutes."""
        question = json.dumps([str(path.absolute()), str(out.absolute())]).encode() + b"\n"
        with self._lock:
            self._idle.cancel()
            try:
                return self._answer(question) or self._answer(question)
            finally:
                self._idle = threading.Timer(_IDLE_S, self.rest)
                self._idle.daemon = True
                self._idle.start()

    def _answer(self, question: bytes) -> bytes:
        answer = b""
        try:
            process = self._process = self._process or _started()
            if process.stdin and process.stdout:
                with suppress(BrokenPipeError):
                    process.stdin.write(question)
                if not select.select([process.stdout], [], [], _PATIENCE_S)[0]:
                    raise TimeoutError
                answer = process.stdout.read(1)
        finally:
            if not answer:
                self.end()
        return answer

    def rest(self) -> None:
        with self._lock:
            self.end()

    def end(self) -> None:
        process, self._process = self._process, None
        if process:
            process.kill()
            with process:
                pass


def _started() -> subprocess.Popen[bytes]:
    command, pipe = [sys.executable, "-P", "-m", __name__], subprocess.PIPE
    return subprocess.Popen(command, bufsize=0, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL)  # noqa: S603


_tries = _Tries()


def has_holes(path: Path, copy: Path) -> bool:
    """Whether the copy that `readable` made lacks messages; not where the file merely breaks off."""
    with path.open("rb") as file:
        ends = [end for kind, end in whole_messages(file.fileno()) if kind]
    return copy.stat().st_size < max(ends, default=0)


def what_is_read(path: Path) -> str:
    """Why `readable` made a copy of a file, and of which part: the beginning of a sentence."""
    next_at = _next_recording(path)
    several = f"is several recordings in one file, another begins after {next_at} bytes: the first"
    return several if next_at else "is damaged or breaks off: what can be read"


def _next_recording(path: Path) -> int:
    # After how many bytes; 0 where none does.
    with path.open("rb") as file:
        head = file.read(STREAM_HEADER_BYTES)
        end = max((end for _, end in whole_messages(file.fileno())), default=0)
        place = os.pread(file.fileno(), STREAM_HEADER_BYTES + _FOOT_BYTES, end).find(head)
    return end + place if end and place >= 0 else 0


def id_of(reader: RrdReader) -> RecordingId:
    """Whose recording it is; `ValueError` where that is not one recording's."""
    (entry,) = reader.recordings()
    edge = entry.application_id.removeprefix("hvt-")
    return RecordingId(edge, entry.recording_id.removeprefix(f"{edge}-"))


def drop_footer(path: Path) -> None:
    """Take the footer off a recording: it has a row for each chunk, and a small one is mostly that."""
    with path.open("r+b") as file:
        file.truncate(max(end for kind, end in whole_messages(file.fileno()) if kind != END))


def whole_messages(file: int) -> Iterator[tuple[int, int]]:
    """The kind of each message, and where it ends, up to a footer; bytes between them that are none have its kind."""
    at, size, kind = STREAM_HEADER_BYTES, os.fstat(file).st_size, _CHUNK
    while kind != END:
        found = _message(file, at, size)
        kind, at = found or (_CHUNK, _next_chunk(file, at, size))
        if at < 0:
            return
        yield (kind if found else END), at


def _message(file: int, at: int, size: int) -> tuple[int, int] | None:
    # Its kind and where it ends; None if there is none at this place, or not all of it.
    head = os.pread(file, MESSAGE_HEADER.size, at)
    kind, length = MESSAGE_HEADER.unpack(head) if len(head) == MESSAGE_HEADER.size else (END, 0)
    end = at + MESSAGE_HEADER.size + length
    return (kind, end) if kind <= _LAST_KIND and length and end <= size else None


def _next_chunk(file: int, at: int, size: int) -> int:
    # Where damage ends: at a chunk that another message, or nothing, follows. -1 without one in this recording.
    if os.pread(file, len(_MAGIC), at) == _MAGIC:
        return -1
    while len(block := os.pread(file, _BLOCK_BYTES, at)) >= len(_CHUNK_KIND):
        for place in (at + one.start() for one in re.finditer(_CHUNK_KIND, block)):
            found = _message(file, place, size)
            if found is not None and (found[1] == size or _message(file, found[1], size)):
                return place
        at += len(block) - len(_CHUNK_KIND) + 1
    return -1


def main() -> None:
    """Answer the names of a file and of its copy, a line each time, with the readable spans."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(0, "rb", buffering=0) as questions:
        while line := questions.readline():
            os.write(answers, tried(*map(Path, json.loads(line))))


def tried(path: Path, out: Path) -> bytes:
    """The result of `readable`, in a process that the SDK may end in a fork."""
    if _reads(path):
        return _WHOLE
    with path.open("rb") as file:
        return _COPIED if _Copy(file.fileno(), out).is_made() else _NOTHING


class _Copy:
    def __init__(self, file: int, out: Path) -> None:
        self._file = file
        self._out = out
        ends = list(whole_messages(file))
        starts = [STREAM_HEADER_BYTES, *(end for _, end in ends)]
        spans = [(kind, (start, end)) for (kind, end), start in zip(ends, starts, strict=False)]
        self._first = [span for kind, span in spans if kind == _STORE_INFO]
        self._others = [span for kind, span in spans if kind > _STORE_INFO]
        self._tries = 0
        self._made: list[_Span] = []

    def is_made(self) -> bool:
        if not self._others or not self._reads([], least=0):
            return False
        todo, found = [self._others], list[_Span]()
        while todo and self._tries < _TRIES:  # the longest first: the tries leave out the least
            chosen = todo.pop(0)
            half = len(chosen) // 2
            if self._reads(chosen):
                found += chosen
            elif half:
                todo += [chosen[:half], chosen[half:]]
        return bool(found) and (found == self._made or self._reads(sorted(found)))

    def _reads(self, chosen: Sequence[_Span], *, least: int = 1) -> bool:
        self._tries += 1
        self._made = list(chosen)
        with self._out.open("wb") as copy:
            copy.write(os.pread(self._file, STREAM_HEADER_BYTES, 0))
            for start, end in [*self._first, *chosen]:
                copy.write(os.pread(self._file, end - start, start))
        return _reads(self._out, least=least)


def _reads(path: Path, *, least: int = 1) -> bool:
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] == 0
    try:
        signal.alarm(_TRY_S)
        reader, found = open_rrd(path), 0
        for chunk in reader.stream():
            chunk.to_record_batch().validate(full=True)
            found += 1
        if least:
            id_of(reader)
        os._exit(found < least)
    finally:
        os._exit(1)


if __name__ == "__main__":
    main()
