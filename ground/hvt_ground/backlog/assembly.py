"""Assembles an edge's stored objects: chunks in, whole objects and acknowledgements out.

Pure, and bounded whatever comes. An object is held from its beginning without a hole: a chunk beyond that is
refused, and the edge learns how far it got. If space is short, the object that has waited longest for its next
chunk is dropped; its edge begins it again. Delivered objects are remembered, so a repetition is acknowledged and
nothing more.

An object is acknowledged when it is in its place, and not before, because its edge then deletes it. While it is
being processed, all of it but the last byte is acknowledged: so an edge that repeats gets an answer, and repeats
one byte.
"""

from __future__ import annotations

from collections import OrderedDict

from hvt_common.protocol.messages import (
    MAX_BACKLOG_BYTES,
    READ_VERSIONS,
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    BacklogUnit,
    Flags,
    Info,
    ObjectKey,
    RoiHeader,
    WireError,
    parse_backlog_still,
    parse_backlog_units,
)
from hvt_common.runtime.statistics import Newest
from hvt_ground.perception.stills.decode import ReceivedStill

_MAX_UNREPORTED = 512
_MAX_REFUSALS = 256
_PATIENCE = 3
"""An object that is unusable 3 times is so for good: it is acknowledged, so that it does not take the link."""


BacklogContent = Info | ReceivedStill | tuple[BacklogUnit, ...]
"""The content of an object: the facts of its session, a still, or a stretch of the base stream."""


class BacklogAssembly:
    """Assembles the chunks of one edge. Not safe for threads.

    At most ``max_objects`` are in progress. ``max_bytes`` bounds them and delivered ones that are not settled yet,
    and holds one object of the largest size. ``remember`` delivered objects are known again.
    """

    def __init__(
        self, *, max_objects: int = 64, max_bytes: int = 4 * MAX_BACKLOG_BYTES, remember: int = 8192
    ) -> None:
        self._max_objects = max_objects
        self._max_bytes = max_bytes
        self._open: OrderedDict[ObjectKey, tuple[int, bytearray]] = OrderedDict()
        """The size of an object and its beginning, as far as it has come; the newest at the end."""
        self._handed: dict[ObjectKey, int] = {}
        """Sizes of objects that are complete and handed out, and whose outcome is not known yet."""
        self._done: Newest[ObjectKey, int] = Newest(remember)
        self._refusals: Newest[ObjectKey, int] = Newest(_MAX_REFUSALS)
        self._unreported: Newest[ObjectKey, int] = Newest(_MAX_UNREPORTED)

    @property
    def size_bytes(self) -> int:
        """The bytes of the objects in progress and of those handed out."""
        return sum(len(data) for _, data in self._open.values()) + sum(self._handed.values())

    @property
    def in_progress(self) -> int:
        """Number of objects of which some is held or handed out."""
        return len(self._open) + self.handed

    @property
    def handed(self) -> int:
        """Number of objects that are handed out."""
        return len(self._handed)

    def chunk(self, header: BacklogHeader, payload: bytes, *, may_finish: bool = True) -> bytes | None:
        """Take a chunk; the object's bytes where it is the last one that was missing, to be `settle`d later.

        With ``may_finish`` False a chunk that would complete its object is not taken, and will come again.
        Raises `WireError` where the chunk cannot be one.
        """
        _check(header, payload)
        key, total_bytes = header.key, header.total_bytes
        if self._done.get(key) == total_bytes:
            self._done.move_to_end(key)
            self._unreported[key] = total_bytes
            return None
        if key in self._handed:  # nothing is here of another object of the same name
            self._unreported[key] = total_bytes - 1 if self._handed[key] == total_bytes else 0
            return None
        known_bytes, data = self._open.pop(key, (total_bytes, bytearray()))
        if known_bytes != total_bytes:
            data = bytearray()
        self._open[key] = total_bytes, data
        fresh = payload[len(data) - header.offset :] if header.offset <= len(data) else b""
        finishes = len(data) + len(fresh) == total_bytes
        if fresh and (may_finish or not finishes) and self._make_space(key, len(fresh)):
            data += fresh
        whole = len(data) == total_bytes
        self._unreported[key] = len(data) - whole
        if whole or not data:
            del self._open[key]
        if not whole:
            return None
        self._handed[key] = total_bytes
        return bytes(data)

    def settle(self, key: ObjectKey, *, usable: bool | None) -> None:
        """Report the outcome of an object that was handed out: it is in its place, or unusable.

        None forgets one that cannot be taken: another ground may, or this one later.
        """
        total_bytes = self._handed.pop(key, None)
        if total_bytes is None:
            return
        if usable is None:
            self._unreported.pop(key, None)
            return
        refusals = 0 if usable else self._refusals.pop(key, 0) + 1
        if 0 < refusals < _PATIENCE:
            self._refusals[key] = refusals
            self._unreported[key] = 0
            return
        self._refusals.pop(key, None)
        if key[1] != BacklogKind.INFO:  # one that was forgotten here has to come through again
            self._done.put(key, total_bytes)
        self._unreported[key] = total_bytes

    def drop_handed(self) -> int:
        """Forget objects that were handed out to somebody who is gone: the edge sends them again. How many."""
        dropped, self._handed = self._handed, {}
        for key in dropped:
            self._unreported[key] = 0
        return len(dropped)

    def want_info(self, session_id: int) -> None:
        """Ask for the facts of a session: without them nothing can be made of its objects."""
        self._unreported[session_id, BacklogKind.INFO, 0] = 0

    @property
    def unreported(self) -> int:
        """Number of acknowledgements not yet sent to the edge."""
        return len(self._unreported)

    def take_acknowledged_ranges(self, most: int) -> tuple[AcknowledgedRange, ...]:
        """Return and forget up to ``most`` acknowledgements that the edge has not been sent yet, oldest first."""
        taken = [self._unreported.popitem(last=False) for _ in range(min(most, len(self._unreported)))]
        return tuple(
            AcknowledgedRange(session_id=session_id, kind=kind, number=number, acknowledged_bytes=count)
            for (session_id, kind, number), count in taken
        )

    def _make_space(self, key: ObjectKey, more_bytes: int) -> bool:
        while self.in_progress > self._max_objects or self.size_bytes + more_bytes > self._max_bytes:
            victim = next((one for one in self._open if one != key), None)
            if victim is None:
                return False
            del self._open[victim]
        return True


def backlog_content(key: ObjectKey, data: bytes, *, edge: str) -> BacklogContent:
    """Read the bytes of a whole object; raises `WireError` and nothing else, for any bytes whatever."""
    session_id, kind, number = key
    if kind == BacklogKind.INFO:
        info = Info.parse(data, versions=READ_VERSIONS)
        if info.session_id != session_id or info.edge != edge:
            raise WireError("the facts of a stored session are those of another")
        return info
    if kind == BacklogKind.STILL:
        return _still(session_id, number, data)
    units = parse_backlog_units(data)
    if units[0].frame_index != number:
        raise WireError(f"stored video {number} begins with frame {units[0].frame_index}")
    return units


def _still(session_id: int, number: int, data: bytes) -> ReceivedStill:
    stored = parse_backlog_still(data)
    header = RoiHeader.parse(stored.attachment, stored.payload, versions=READ_VERSIONS).named(())
    if header.session_id != session_id or header.sequence != number:
        raise WireError(f"stored still {number} has another number inside")
    if not header.flags & Flags.STORED or header.capture_ns < 0:
        raise WireError(f"stored still {number} does not say that it is one, or when it was captured")
    return ReceivedStill(header, stored.payload)


def _check(header: BacklogHeader, payload: bytes) -> None:
    if not payload or header.offset + len(payload) > header.total_bytes:
        raise WireError(
            f"a chunk of {len(payload)} bytes at {header.offset} is none of an object of {header.total_bytes}"
        )
    if header.kind == BacklogKind.INFO and (header.number or header.total_bytes > Info.MAX_BYTES):
        raise WireError("a chunk of a session's facts has a number, or is too long")
