"""Sends stored objects, chunk by chunk, until the ground acknowledges them. Time is an argument.

First come the facts of sessions other than the present one, then stills by their worth, then video, newest first;
video goes first where a ground requested it. Bytes of several objects may be under way; only the object whose chunks
are being made is in memory. An object without progress is sent again from the ground's acknowledged bytes on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain

from hvt_common.protocol.messages import AcknowledgedRange, BacklogKind, ObjectKey
from hvt_common.units import SECOND_NS
from hvt_edge.backlog.disk import Store
from hvt_edge.backlog.entry import Entry
from hvt_edge.link.transmitter import Chunk

_log = logging.getLogger(__name__)

_PATIENCE_NS = 2 * SECOND_NS
_TRIES, _TRIES_BEGUN = 3, 6
"""Tries without progress: for an object of which the ground has nothing, and for one of which it has a part."""
_MOST_ANSWERS = 300
"""Answers without progress that still count as signs of life: some minutes of them."""
_MOST_OBJECTS = 12
"""Objects under way at a time; one report of the ground names 16."""
_MOST_AHEAD_BYTES = 256 * 1024
"""Limit of one object's bytes beyond the acknowledged ones."""
_LEAST_CHUNK_BYTES = 600
"""A smaller chunk is mostly headers; only the last one may be smaller."""
_OTHER_RECEIVER_NS = 5 * SECOND_NS


@dataclass(slots=True)
class _Transfer:
    entry: Entry
    total_bytes: int = -1
    """-1 until the object was read."""
    since_ns: int = 0
    """Time of the last chunk sent or acknowledged."""
    sent_bytes: int = 0
    acknowledged_bytes: int = 0
    tries: int = 0
    answers: int = 0
    """Answers of the ground without progress: it is busy."""
    aside: bool = False
    """The present ground does not take it; another ground, and the next start, are offered it again."""


class Backfill:
    """For one thread. ``on_done(entry)`` is called for each object that a ground has completely."""

    def __init__(
        self, store: Store, *, session_id: int, on_done: Callable[[Entry], None] = lambda _entry: None
    ) -> None:
        self._store = store
        self._session_id = session_id
        self._on_done = on_done
        self._begun: dict[ObjectKey, _Transfer] = {}
        """Objects of which a ground was sent some, and that none has yet."""
        self.line: dict[ObjectKey, _Transfer] = {}
        """Those that are under way, in order."""
        self.data: tuple[ObjectKey, bytes] | None = None
        self._in_hand: _Transfer | None = None
        """The object whose chunks were made last."""
        self._informed = {session_id}
        """Sessions whose facts the ground has."""
        self._receiver_id: int | None = None
        self._reported_ns = 0
        self.video_first = False
        """A ground requested the video."""
        self.acknowledged_bytes = 0
        self.given_up = 0
        """Objects that were set aside because a ground did not take them."""

    @property
    def unacknowledged_bytes(self) -> int:
        """Bytes under way; for any thread."""
        return sum(one.sent_bytes - one.acknowledged_bytes for one in tuple(self.line.values()))

    # Acknowledgements

    def on_acknowledged(self, one: AcknowledgedRange, *, receiver_id: int, now_ns: int) -> None:
        """Process an acknowledgement. Only one ground counts, until it has sent none for a while."""
        if receiver_id != self._receiver_id:
            if self._receiver_id is not None:
                if now_ns - self._reported_ns < _OTHER_RECEIVER_NS:
                    return
                self._informed = {self._session_id}
                self._stop()
            for begun in self._begun.values():
                begun.aside = False
            self._receiver_id = receiver_id
        self._reported_ns = now_ns
        transfer = self._begun.get(one.key)
        if transfer is not None:
            self._advance(transfer, one.acknowledged_bytes, now_ns)
        elif one.kind == BacklogKind.INFO and not (one.number or one.acknowledged_bytes):
            self._informed.discard(one.session_id)

    def interrupt(self) -> None:
        """The link is down: objects under way start again later, from the acknowledged bytes on."""
        self._stop()
        self._forget_removed()

    def put_aside(self) -> None:
        """Making or sending chunks has failed: the object in hand waits for another ground or the next start."""
        if self._in_hand is not None:
            self._in_hand.aside = True
        self._stop()

    def _stop(self) -> None:
        self.line.clear()
        self.data = None

    def _forget_removed(self) -> None:
        self._begun = {key: one for key, one in self._begun.items() if self._store.find(key) is not None}

    def _advance(self, transfer: _Transfer, acknowledged_bytes: int, now_ns: int) -> None:
        if acknowledged_bytes > transfer.total_bytes:
            return
        gained_bytes = acknowledged_bytes - transfer.acknowledged_bytes
        self.acknowledged_bytes += max(0, gained_bytes)
        transfer.acknowledged_bytes = acknowledged_bytes
        if acknowledged_bytes == transfer.total_bytes:
            self._done(transfer.entry)
            return
        if gained_bytes < 0:  # the ground was restarted, or lost some
            transfer.sent_bytes = acknowledged_bytes
        elif gained_bytes > 0:
            transfer.tries, transfer.answers, transfer.since_ns = 0, 0, now_ns
        elif transfer.answers < _MOST_ANSWERS:  # the ground is busy: only silence is a failed try
            transfer.tries, transfer.answers = 0, transfer.answers + 1
        transfer.sent_bytes = max(transfer.sent_bytes, acknowledged_bytes)

    def _done(self, entry: Entry) -> None:
        self._leave(entry.key)
        if entry.kind is BacklogKind.INFO:
            self._informed.add(entry.session_id)
            return
        if (
            stored := self._store.find(entry.key)
        ) is not None:  # else evicted: its row may be another's by now
            self._store.remove(stored)
        self._on_done(entry)

    def _leave(self, key: ObjectKey) -> None:
        self._begun.pop(key, None)
        self.line.pop(key, None)
        if self.data is not None and self.data[0] == key:
            self.data = None

    # Chunks

    def next_chunk(self, most_bytes: int, *, now_ns: int, round_trip_ns: int) -> Chunk | None:
        """The next chunk, of at most ``most_bytes``; None where no object waits or the chunk would be too small."""
        self._begin_again(now_ns - _PATIENCE_NS - round_trip_ns, now_ns)
        while (transfer := self._current(now_ns)) is not None:
            data = self._bytes_of(transfer)
            if data is None:
                continue
            chunk = data[transfer.sent_bytes : transfer.sent_bytes + max(0, most_bytes)]
            ends = transfer.sent_bytes + len(chunk) == len(data)
            if not chunk or (len(chunk) < _LEAST_CHUNK_BYTES and not ends):
                return None
            key, offset = transfer.entry.key, transfer.sent_bytes
            transfer.sent_bytes += len(chunk)
            transfer.since_ns = now_ns
            return Chunk(key, offset, len(data), chunk)
        return None

    def take_back(self, chunk: Chunk) -> None:
        transfer = self.line.get(chunk.key)
        if transfer is not None:
            transfer.sent_bytes = min(transfer.sent_bytes, chunk.offset)

    def _begin_again(self, before_ns: int, now_ns: int) -> None:
        for key, transfer in list(self.line.items()):
            if self._store.find(key) is None:  # evicted meanwhile
                self._leave(key)
            elif transfer.since_ns < before_ns and transfer.sent_bytes > transfer.acknowledged_bytes:
                transfer.tries += 1
                transfer.sent_bytes, transfer.since_ns = transfer.acknowledged_bytes, now_ns
                if transfer.tries >= (_TRIES_BEGUN if transfer.acknowledged_bytes else _TRIES):
                    self._give_up(transfer)

    def _give_up(self, transfer: _Transfer) -> None:
        entry = transfer.entry
        self._leave(entry.key)
        self.given_up += 1
        if self.given_up.bit_count() == 1:
            _log.warning(
                "no ground takes %s in %d tries (%d objects so far): it stays on disk for another ground, or for "
                "the next start",
                entry,
                transfer.tries,
                self.given_up,
            )
        if entry.kind is BacklogKind.INFO:
            self._informed.add(entry.session_id)  # later reports show whether it is needed
        else:  # an object leaves the store only because a ground has it, for its age or for want of room
            self._forget_removed()
            transfer.aside = True
            self._begun[entry.key] = transfer  # an acknowledgement may still come

    def _current(self, now_ns: int) -> _Transfer | None:
        # The object whose chunks are made now: the first that is not entirely under way, or the next one.
        for transfer in self.line.values():
            if transfer.sent_bytes < transfer.total_bytes:
                self._in_hand = transfer
                ahead = transfer.sent_bytes - transfer.acknowledged_bytes
                return transfer if ahead < _MOST_AHEAD_BYTES else None
        if len(self.line) >= _MOST_OBJECTS:
            return None
        while (entry := next(self._open_entries(), None)) is not None:
            transfer = self._in_hand = self._begun.setdefault(entry.key, _Transfer(entry))
            if self._bytes_of(transfer) is not None:
                transfer.sent_bytes, transfer.since_ns = transfer.acknowledged_bytes, now_ns
                transfer.tries = transfer.answers = 0
                self.line[entry.key] = transfer
                return transfer
        return None

    def _open_entries(self) -> Iterator[Entry]:
        stills, video = self._store.best_stills(), self._store.newest_segments()
        if not self._store.segments:
            self.video_first = False
        under_way = [one.entry for one in self.line.values()]
        for entry in chain(under_way, *((video, stills) if self.video_first else (stills, video))):
            key, begun = entry.key, self._begun.get(entry.key)
            if begun is not None and begun.aside:
                continue
            informed = entry.session_id in self._informed
            info = None if informed else self._store.info_of(entry.session_id)
            if (key if info is None else info.key) not in self.line:
                yield entry if info is None else info

    def _bytes_of(self, transfer: _Transfer) -> bytes | None:
        # The object's bytes, read again if another object was read since; None where they are gone.
        key = transfer.entry.key
        if self.data is None or self.data[0] != key:
            data = self._store.read(transfer.entry)
            if data is None or transfer.total_bytes not in (-1, len(data)):
                self._leave(key)
                return None
            transfer.total_bytes, self.data = len(data), (key, data)
        return self.data[1]
