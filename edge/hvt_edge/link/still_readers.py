"""Which still codecs the grounds read: a still that one of them cannot read would be bits for nothing."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

from hvt_common.protocol.messages import BASE_CODEC, InfoRequest

_log = logging.getLogger(__name__)

_FORGET_NS = 60_000_000_000
"""A ground asks for ``info`` three times in it; after that it counts as gone."""
_MOST_READERS = 16
_MOST_SAID = 8


@dataclass(frozen=True, slots=True)
class _Reader:
    codecs: frozenset[str]
    requested_ns: int


class StillReaders:
    """The still codecs that each ground reads, by its `InfoRequest`; a ground that named none reads all. Thread-safe.

    ``clock`` is Unix nanoseconds without steps.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._readers: dict[int, _Reader] = {}
        """Codecs by requester, in the order of the last request; a stranger's numbers cost a place each."""
        self._said: set[str] = set()
        self._video_said = False

    def on_request(self, request: InfoRequest) -> None:
        """A ground says what it reads."""
        if BASE_CODEC not in request.base_codecs and not self._video_said:
            self._video_said = True
            _log.warning(
                "a ground reads video of %s: this edge sends %s, and that ground will show none",
                ", ".join(request.base_codecs) or "no codec",
                BASE_CODEC,
            )
        with self._lock:
            self._readers.pop(request.requester_id, None)
            if len(self._readers) >= _MOST_READERS:
                del self._readers[next(iter(self._readers))]
            self._readers[request.requester_id] = _Reader(frozenset(request.still_codecs), self._clock())

    def read(self, codec: str) -> bool:
        """Whether every ground that said what it reads, within the last minute, reads this codec."""
        since_ns = self._clock() - _FORGET_NS
        with self._lock:
            good = all(codec in one.codecs for one in self._readers.values() if one.requested_ns >= since_ns)
            news = not good and codec not in self._said and len(self._said) < _MOST_SAID
            if news:
                self._said.add(codec)
        if news:
            _log.warning("a ground does not read stills of %s: others are sent while it listens", codec)
        return good
