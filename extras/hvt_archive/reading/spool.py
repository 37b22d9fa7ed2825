"""Values of a recording that is read back, on disk: in memory is where each is, 32 bytes."""

from __future__ import annotations

import os
import tempfile
import weakref
from array import array
from bisect import bisect_right
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import msgpack
import numpy as np

from hvt_common.errors import UserError

_BUFFER_BYTES = 2**18
Item = TypeVar("Item")
Made = TypeVar("Made")
Timed = tuple[int, int, Any]
"""Frame index, capture time in nanoseconds, value."""


class Spool:
    """A file without a name, gone with the program or with the last that reads it; for one thread at a time."""

    def __init__(self) -> None:
        try:
            self._file, name = tempfile.mkstemp(prefix="hvt-")
        except OSError as error:
            raise _no_space(error) from None
        Path(name).unlink()
        weakref.finalize(self, os.close, self._file)
        self._written = 0
        self._unwritten = bytearray()

    def put(self, data: bytes) -> int:
        """Append; where it begins."""
        at = self._written + len(self._unwritten)
        self._unwritten += data
        if len(self._unwritten) >= _BUFFER_BYTES:
            self._flush()
        return at

    def get(self, at: int, size: int) -> bytes:
        if at + size > self._written:
            self._flush()
        return os.pread(self._file, size, at)

    def _flush(self) -> None:
        while self._unwritten:
            try:
                count = os.write(self._file, self._unwritten)
            except OSError as error:
                raise _no_space(error) from None
            del self._unwritten[:count]
            self._written += count


def _no_space(error: OSError) -> UserError:
    # None as long as no folder was found, as where all disks are mounted read-only.
    where = tempfile.tempdir
    takes = "no folder takes" if where is None else f"{where} does not take ({error.strerror})"
    return UserError(
        f"what is read is kept in a temporary file as large as the recording, which {takes}: set TMPDIR to a folder "
        "with room"
    )


class SpooledRows(Sequence[Timed]):
    """Rows of one component, in order of frames once they were sorted; values are bytes, or packed."""

    def __init__(self, spool: Spool, *, blobs: bool) -> None:
        self._spool, self._blobs = spool, blobs
        self._columns = tuple(array("q") for _ in range(4))
        """Frames, capture times, places and sizes."""

    def add(self, frame: int, capture_ns: int, value: Any) -> None:
        data = value if self._blobs else msgpack.packb(value)
        for column, number in zip(
            self._columns, (frame, capture_ns, self._spool.put(data), len(data)), strict=True
        ):
            column.append(number)

    def extend(self, rows: SpooledRows) -> None:
        for column, more in zip(self._columns, rows._columns, strict=True):
            column.extend(more)

    def begun(self, frame: int, capture_ns: int, value: Any, *, then: SpooledRows | None) -> SpooledRows:
        """Others of the same component that begin with this row."""
        rows = SpooledRows(self._spool, blobs=self._blobs)
        rows.add(frame, capture_ns, value)
        if then is not None:
            rows.extend(then)
        return rows

    def keep(self, wanted: Callable[[int], bool]) -> None:
        """Leave out the rows at other places than those."""
        self._take([place for place in range(len(self)) if wanted(place)])

    def sort(self, *, unique: bool = False) -> None:
        """By frames; of one frame in the order of adding, or the last alone where they are to be ``unique``."""
        frames = np.asarray(self._columns[0], np.int64)
        order = np.argsort(frames, kind="stable")
        if unique and len(order):
            ordered = frames[order]
            order = order[np.append(ordered[1:] != ordered[:-1], True)]
        self._take(order.tolist())

    @property
    def frames(self) -> Sequence[int]:
        return self._columns[0]

    @property
    def captures_ns(self) -> Sequence[int]:
        return self._columns[1]

    def latest(self, frame: int) -> int:
        """The place of the last row up to a frame; -1 where there is none. They are sorted."""
        return bisect_right(self._columns[0], frame) - 1

    def value(self, place: int) -> Any:
        data = self._spool.get(self._columns[2][place], self._columns[3][place])
        return data if self._blobs else msgpack.unpackb(data)

    def __len__(self) -> int:
        return len(self._columns[0])

    @overload
    def __getitem__(self, place: int) -> Timed: ...
    @overload
    def __getitem__(self, place: slice) -> list[Timed]: ...
    def __getitem__(self, place: int | slice) -> Timed | list[Timed]:
        if isinstance(place, slice):
            return [self[one] for one in range(*place.indices(len(self)))]
        return self._columns[0][place], self._columns[1][place], self.value(place)

    def _take(self, places: Sequence[int]) -> None:
        self._columns = tuple(array("q", map(column.__getitem__, places)) for column in self._columns)


class Mapped(Sequence[Made], Generic[Item, Made]):
    """A sequence that makes each of ``items`` on access, and keeps none; a slice is another of these."""

    def __init__(
        self, items: Sequence[Item], make: Callable[[Item], Made], places: range | None = None
    ) -> None:
        self._items, self._make = items, make
        self._places = range(len(items)) if places is None else places

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, place: int) -> Made: ...
    @overload
    def __getitem__(self, place: slice) -> Mapped[Item, Made]: ...
    def __getitem__(self, place: int | slice) -> Made | Mapped[Item, Made]:
        if isinstance(place, slice):
            return Mapped(self._items, self._make, self._places[place])
        return self._make(self._items[self._places[place]])
