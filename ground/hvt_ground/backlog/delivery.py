"""What an edge kept while the link was away, from the chunks that come to the recordings that they belong to.

Whole objects of the session that is open go into that one, those of a session before into a recording of its own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Sequence
from pathlib import Path

from hvt_common.protocol.channels import DELIVERIES, Channel
from hvt_common.protocol.messages import (
    AcknowledgedRange,
    BacklogHeader,
    BacklogKind,
    BacklogUnit,
    Info,
    WireError,
)
from hvt_ground.backlog.assembly import BacklogAssembly, BacklogKey, StoredStill, backlog_content
from hvt_ground.backlog.fill import Work
from hvt_ground.backlog.recordings import BacklogRecordings
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.session.session import GroundSession

__all__ = ["BacklogDelivery"]

_log = logging.getLogger(__name__)

_MOST_INFOS = 64
_FINISH_NS = 1_000_000_000


class BacklogDelivery:
    """Of one edge. `chunk` is for the receiving thread, `take_acknowledged_ranges` for any.

    Args:
        edge: its id.
        recordings: where what is of another session goes; None refuses it.
        assembly: puts chunks together.
    """

    def __init__(
        self, edge: str, *, recordings: BacklogRecordings | None, assembly: BacklogAssembly | None = None
    ) -> None:
        self._edge = edge
        self._recordings = recordings
        self._assembly = assembly or BacklogAssembly()
        self._lock = threading.Lock()
        self._infos: OrderedDict[int, Info] = OrderedDict()
        self._backlog: deque[Work] = deque()
        self._working = 0
        self._sessions = 0
        """That have ended: what is still at work for one of them has no say any more."""

    @property
    def paths(self) -> Sequence[Path]:
        """Recordings of former sessions that were written."""
        return () if self._recordings is None else tuple(self._recordings.paths)

    @property
    def refused(self) -> int:
        """Objects that came whole and were unusable."""
        return self._assembly.refused

    @property
    def idle(self) -> bool:
        """Whether nothing that came is still being worked on."""
        return self._working == 0

    def learn(self, info: Info) -> None:
        """Note the facts of a session."""
        with self._lock:
            self._infos[info.session_id] = info
            self._infos.move_to_end(info.session_id)
            if len(self._infos) > _MOST_INFOS:
                self._infos.popitem(last=False)

    def chunk(self, header: BacklogHeader, payload: bytes, *, session: GroundSession) -> bool:
        """Take a chunk while ``session`` is open; True where it completes its object, which is handed on.

        Raises:
            WireError: it cannot be one, or the object that it completes is unusable.
        """
        own = header.session_id == session.info.session_id
        if not own and (self._recordings is None or not self._recordings.takes(header.session_id)):
            raise WireError(f"it was kept of the session {header.session_id:016x}, which is not shown")
        is_info = header.kind == BacklogKind.INFO
        with self._lock:
            known = own or header.session_id in self._infos
            if not (known or is_info):
                self._assembly.want_info(header.session_id)
            may_finish = is_info or (known and session.accepts_jobs)
            whole = self._assembly.chunk(header, payload, may_finish=may_finish)
        if whole is None:
            return False
        self._deliver((header.session_id, header.kind, header.number), whole, session)
        return True

    def work(self) -> None:
        """Do one step of what is to be done in the receiving thread: a frame."""
        if self._backlog:
            try:
                next(self._backlog[0])
            except StopIteration:
                self._backlog.popleft()

    @property
    def has_work(self) -> bool:
        """Whether there is any."""
        return bool(self._backlog)

    @property
    def unsaid(self) -> int:
        """How many acknowledgements the edge has not heard yet."""
        return self._assembly.unsaid

    def take_acknowledged_ranges(self, most: int) -> tuple[AcknowledgedRange, ...]:
        """Return and forget up to ``most`` acknowledgements."""
        with self._lock:
            return self._assembly.take_acknowledged_ranges(most)

    def finish(self) -> None:
        """Do what is left to do in the receiving thread, for a second: the session is about to be closed."""
        until_ns = time.monotonic_ns() + _FINISH_NS
        while self._backlog and time.monotonic_ns() < until_ns:
            self.work()

    def session_ended(self, info: Info) -> None:
        """The session that was open is closed: what was not worked off was not acknowledged, and is to come again."""
        self.learn(info)
        self._backlog.clear()
        with self._lock:
            dropped = self._assembly.drop_handed()
            self._working = 0
            self._sessions += 1
        if self._recordings is not None:
            self._recordings.release_all()
        if dropped:
            _log.info("%s: %d objects of an outage were not worked off in time", self._edge, dropped)

    def close(self) -> None:
        """Close the recordings of former sessions."""
        if self._recordings is not None:
            self._recordings.close()

    def _deliver(self, key: BacklogKey, whole: bytes, session: GroundSession) -> None:
        try:
            content = backlog_content(key, whole, edge=self._edge)
        except WireError:
            self._update(key, usable=False)
            raise
        if isinstance(content, Info):
            self.learn(content)
            self._update(key, usable=True)
        elif isinstance(content, StoredStill):
            self._still(key, content, session)
        else:
            self._backlog.append(self._settling(key, self._video(key, content, session)))

    def _still(self, key: BacklogKey, content: StoredStill, session: GroundSession) -> None:
        still = _received(content)
        own = key[0] == session.info.session_id
        work = session.stored_still(still) if own else self._still_elsewhere(self._infos[key[0]], still)
        if work is None:
            self._update(key, usable=True)
        else:
            session.later(self._settling(key, work))

    def _video(self, key: BacklogKey, units: Sequence[BacklogUnit], session: GroundSession) -> Work:
        if key[0] == session.info.session_id:
            return session.stored_video(units)
        return self._video_elsewhere(self._infos[key[0]], units, session)

    def _still_elsewhere(self, info: Info, still: ReceivedStill) -> Work:
        assert self._recordings is not None, "without, no piece of another session is taken"
        with self._recordings.using(info) as recording:
            return None if recording is None else (yield from recording.still(still))

    def _video_elsewhere(self, info: Info, units: Sequence[BacklogUnit], session: GroundSession) -> Work:
        recordings = self._recordings
        assert recordings is not None, "without, no piece of another session is taken"
        with recordings.using(info) as recording:
            if recording is None:
                return None
            return (
                yield from recording.fill.fill(
                    units, boxes=lambda work: session.at_leisure(recordings.stored(recording, work))
                )
            )

    def _settling(self, key: BacklogKey, work: Work) -> Work:
        """The work, and then its acknowledgement."""
        with self._lock:
            self._working += 1
            return self._then_settle(key, work, session=self._sessions)

    def _then_settle(self, key: BacklogKey, work: Work, *, session: int) -> Work:
        usable = yield from work
        with self._lock:
            if session == self._sessions:
                self._working -= 1
                if usable is None:
                    self._assembly.drop(key)
                else:
                    self._assembly.settle(key, usable=usable)
        return usable

    def _update(self, key: BacklogKey, *, usable: bool) -> None:
        with self._lock:
            self._assembly.settle(key, usable=usable)


def _received(still: StoredStill) -> ReceivedStill:
    media_type = still.encoding.partition(";")[0] or DELIVERIES[Channel.ROI].encoding
    return ReceivedStill(still.header, still.data, media_type)
