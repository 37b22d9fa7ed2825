"""A still on its way: its header, packed once, and which codecs the grounds read."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, fields

from hvt_common.protocol.messages import (
    BASE_CODEC,
    AlsoShown,
    InfoRequest,
    PackedMessage,
    RoiHeader,
    fitted_text,
)
from hvt_common.values import Still

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


_PLAIN_ENCODING = "application/octet-stream"
"""The encoding of formats that only HVT reads; one byte on the wire."""
_OWN_TYPES = "application/vnd.hvt."
_AS_THEY_ARE = {one.name for one in fields(Still)} & {one.name for one in fields(RoiHeader)} - {
    "class_name",
    "reason",
    "also",
}
"""Fields of a still that its header has too."""


@dataclass(frozen=True, slots=True)
class StillEnvelope:
    """Send delay, flags and checksum are packed when it goes out."""

    still: Still
    header: PackedMessage
    encoding: str
    """What Zenoh is told of the payload: its media type, if there is any program beside HVT that could read it.

    Spelling a type of our own out would cost up to 34 bytes a still, and the header names the codec anyway.
    """

    @classmethod
    def of(cls, still: Still, *, session_id: int) -> StillEnvelope:
        header = RoiHeader(
            session_id=session_id,
            send_delay_ns=0,
            flags=0,
            class_name=fitted_text(still.class_name, 64),
            reason=fitted_text(still.reason, 48),
            also=tuple(AlsoShown(track_id=one, box_source_px=box) for one, box in still.also),
            **{name: getattr(still, name) for name in _AS_THEY_ARE},
        )
        own = still.media_type.startswith(_OWN_TYPES)
        return cls(still, PackedMessage.of(header), _PLAIN_ENCODING if own else still.media_type)

    def header_at(self, send_ns: int, *, flags: int, frame_sent: bool = False) -> PackedMessage:
        """The header of a still that goes out at this time; ``frame_sent``: who gets it can have the capture time."""
        times = {"send_delay_ns": send_ns - self.still.capture_ns}
        if frame_sent and "ask" not in self.still.parameters:  # who asks need not have the video
            times["capture_ns"] = -1
        return self.header.with_fields(flags=int(flags), **times)
