"""Stored segments of the base stream: their frames that can be shown, and the objects in them.

A stretch that begins with a keyframe stands by itself. The first one of an outage need not: it goes on from the last
picture that came over the link, so the units since the last keyframe before each gap are remembered.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence

from hvt_common.protocol.messages import BacklogUnit
from hvt_common.values import Image
from hvt_common.video.hevc import BaseDecoder

_MOST_GOP_BYTES = 2 * 2**20
_GAPS = 4


class BacklogVideo:
    """A session's stored video. `live` and `pictures` may be called by two threads. Pictures have ``base_size``."""

    def __init__(self, *, base_size: tuple[int, int]) -> None:
        self._base_size = base_size
        self._lock = threading.Lock()
        self._run: list[tuple[int, bytes]] = []
        """Frame index and access unit since the last keyframe; empty where they are too many."""
        self._run_bytes = 0
        self._ends: deque[list[tuple[int, bytes]]] = deque(maxlen=_GAPS)
        """The same before each gap."""

    def live(self, frame_index: int, data: bytes, *, keyframe: bool, after_gap: bool) -> None:
        """Note a unit that was decoded as it came."""
        with self._lock:
            if keyframe:
                if after_gap and self._run:
                    self._ends.append(self._run)
                self._run, self._run_bytes = [], 0
            elif not self._run:
                return
            self._run.append((frame_index, data))
            self._run_bytes += len(data)
            if self._run_bytes > _MOST_GOP_BYTES:
                self._run = []

    def pictures(self, units: Sequence[BacklogUnit]) -> Iterator[tuple[BacklogUnit, Image | None] | None]:
        """Each unit with its picture, or with None where it cannot be shown; None for each that leads up to them.

        After one that cannot be decoded all are left out up to the next keyframe: a decoder would make garbage of
        them, and so would a viewer.
        """
        decoder, goes_on = BaseDecoder(size=self._base_size), False
        if not units[0].keyframe:
            for data in self._leading_to(units[0].frame_index):
                goes_on = decoder.decode(data) is not None
                yield None
        for unit in units:
            if goes_on or unit.keyframe:
                image = decoder.decode(unit.data)
                goes_on = image is not None and image.shape[1::-1] == self._base_size
                yield unit, image if goes_on else None
            else:
                yield unit, None

    def _leading_to(self, frame_index: int) -> list[bytes]:
        # The units from a keyframe up to the one before ``frame_index``, of the newest run that has some.
        with self._lock:
            for run in (self._run, *reversed(self._ends)):
                if run and run[0][0] < frame_index:
                    return [data for index, data in run if index < frame_index]
        return []
