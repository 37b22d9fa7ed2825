"""Of a recording that may be damaged: what the SDK can read, told without reading it in this process.

On some damage the SDK does not raise: it ends its process. So a child forks for each try; to start it takes
as long as to import Rerun.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from hvt_ground.sinks.rerun.rrd_file import STREAM_HEADER_BYTES, id_of, open_rrd, whole_messages

_STORE_INFO = 1
_WHOLE, _COPIED, _NOTHING = 0, 10, 11
_FOOT_BYTES = 32
"""Between the last message of a recording and its end."""
_TRIES = 100
_TRY_S, _PATIENCE_S = 60, 600.0

_Span = tuple[int, int]
"""Where a message begins and ends."""


def readable(path: Path, out: Path) -> Path | None:
    """``path`` if the SDK reads all of it; else ``out``, a copy of the messages that it reads; None if it reads none.

    After a power cut a file breaks off or ends in zeros, and cards lose bits.
    """
    command = [sys.executable, "-P", "-m", __name__, str(path), str(out)]
    try:
        done = subprocess.run(  # noqa: S603
            command,
            check=False,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=_PATIENCE_S,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return {_WHOLE: path, _COPIED: out}.get(done.returncode)


def has_holes(path: Path, copy: Path) -> bool:
    """Whether the copy that `readable` made lacks messages; not where the file merely breaks off."""
    with path.open("rb") as file:
        ends = [end for kind, end in whole_messages(file.fileno()) if kind]
    return copy.stat().st_size < max(ends, default=0)


def what_is_read(path: Path) -> str:
    """Of a file that `readable` made a copy of, why, and which part: the beginning of a sentence."""
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


def main(path: Path, out: Path) -> int:
    """The child's part; what it found is its exit code."""
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
        while todo and self._tries < _TRIES:  # the longest first: what the tries do not reach is least
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
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    raise SystemExit(main(*map(Path, sys.argv[1:])))
