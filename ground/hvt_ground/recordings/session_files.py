"""Records one session in files that follow each other, each of which opens by itself, and tells the index of them.

A file ends where a keyframe comes after its time or size is up. Video goes on in the next one at once; the former
stays open until perception has come to that keyframe too, so that boxes end where video ends. Objects stored at
the edge that are of a former file's time go into a file beside that one. All have the session's recording id: opened
together they are shown as one.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, count
from pathlib import Path

from hvt_common.files import claim_name
from hvt_common.units import SECOND_NS, Limit
from hvt_ground.events import Event, FrameEvent, Notice, Overlay, VideoSample
from hvt_ground.recordings.row import FileAccount, RecordingRow
from hvt_ground.sinks.queued import SinkWriter
from hvt_ground.sinks.rerun.recorder import Recorder, RecorderSettings
from hvt_ground.sinks.rerun.rrd_file import RecordingFile

_REPORT_S = 10.0
_SMALL_BYTES, _MOST_SMALL = 128 * 2**10, 8
"""A file costs 190 kB beside its content. With less content the next one begins at most 8 times in a session, or once
half its time has passed here, too: capture times are the edge's word."""
_BEHIND_S = 3.0
"""The longest time that a former file waits for perception."""
_MOST_LATE_OPEN, _MOST_LATE = 4, 32
"""Files of backlog beside former ones: each costs 80 kB before its first byte."""


class SessionFiles(SinkWriter[Event]):
    """A sink, as `Recorder`. Without ``split`` all goes into the file of ``settings``.

    Otherwise that gives the names: ``flight.rrd`` becomes ``flight-0001.rrd``, ``flight-0002.rrd`` and, for late
    objects, ``flight-0001-backlog.rrd``; none is written over. ``tell`` gets the facts of each file when it begins
    and ends, and every few seconds.
    """

    def __init__(
        self,
        settings: RecorderSettings,
        *,
        split: Limit | None = None,
        tell: Callable[[RecordingRow], None] | None = None,
        backlog: bool = False,
    ) -> None:
        assert settings.path is not None, "a viewer is no file"
        self._settings, self._split, self._tell, self._backlog = settings, split, tell, backlog
        self._base = settings.path
        first = self._base if split is None else self._numbered(1)
        self._recorder = Recorder(replace(settings, path=first))
        self._accounts: dict[RecordingFile, FileAccount] = {}
        self._reported_s = 0.0
        self._parts: list[Path] = [first]
        self._starts: list[tuple[int, int]] = []
        """Frame and capture time of the keyframes at which the files after the first begin."""
        self._began_ns: int | None = None
        """Capture time of the newest file's first picture."""
        self._began_s, self._came_bytes = time.monotonic(), 0
        """When that came, and how much video since then."""
        self._small_left = _MOST_SMALL
        self._next: RecordingFile | None = None
        """Takes the video already, while the recorder's own file waits for perception."""
        self._late: OrderedDict[int, RecordingFile] = OrderedDict()
        """By the part whose time they are of, the one that was used last at the end."""
        self._late_left = _MOST_LATE
        self._opened(self._recorder.file)

    def log(self, item: Event) -> None:
        if isinstance(item, FrameEvent):
            self._go_on(item)
            item, file = self._placed(item)
            self._recorder.log(item, into=file)
            self._accounts[file].note(item)
        if time.monotonic() - self._reported_s > _REPORT_S:
            self._reported_s = time.monotonic()
            for file in self._accounts:
                self._report(file)

    def skipped(self, count: int) -> None:
        self._recorder.skipped(count)

    def close(self, hurry: threading.Event | None = None) -> None:
        """Close all files; a second call does nothing. Once ``hurry`` is set no footers are added."""
        with ExitStack() as every:
            for file in [*self._late.values(), self._recorder.file]:
                every.callback(self._close, file, hurry)
            if self._next is not None:
                every.callback(self._close, self._next, hurry)
                every.callback(self._settle, hurry)
        self._late.clear()

    # Which file

    def _go_on(self, item: FrameEvent) -> None:
        if self._split is None or getattr(item, "stored", False):
            return
        if self._next is not None:
            behind = item.frame_index - self._starts[-1][0]
            if behind > _BEHIND_S * self._settings.fps or (isinstance(item, Overlay) and behind >= 0):
                self._settle(None)
        if not isinstance(item, VideoSample):
            return
        if item.keyframe and self._recorder.begins_with(item):
            if self._began_ns is None:
                self._began_ns = item.capture_ns
            elif self._is_full(self._split, item.capture_ns - self._began_ns):
                self._settle(None)
                self._began_ns = item.capture_ns
                self._began_s, self._came_bytes = time.monotonic(), 0
                path = self._numbered(len(self._parts) + 1)
                self._next = self._opened(self._recorder.open_file(path))
                self._parts.append(path)
                self._starts.append((item.frame_index, item.capture_ns))
        self._came_bytes += len(item.data)

    def _is_full(self, split: Limit, lasted_ns: int) -> bool:
        if split.size_bytes is not None:
            return self._recorder.size_bytes >= split.size_bytes
        seconds = split.seconds or 0.0
        # A clock that was set back is a reason too: it would take as long again.
        if 0 <= lasted_ns < seconds * SECOND_NS:
            return False
        if self._came_bytes >= _SMALL_BYTES or time.monotonic() - self._began_s >= seconds / 2:
            return True
        self._small_left -= 1
        return self._small_left >= 0

    def _settle(self, hurry: threading.Event | None) -> None:
        if self._next is not None:
            former = self._recorder.file
            self._recorder.go_on_in(self._next, at=self._starts[-1])
            self._next = None
            self._close(former, hurry)

    def _placed(self, item: FrameEvent) -> tuple[FrameEvent, RecordingFile]:
        # The file that an event goes into; one too late for its own file is put at the beginning of the newest.
        part = bisect_right(self._starts, item.frame_index, key=lambda start: start[0])
        newest = len(self._starts)
        if part == newest:
            return item, self._next or self._recorder.file
        if self._next is not None and part == newest - 1:
            return item, self._recorder.file
        stored = getattr(item, "stored", False)
        if stored or (isinstance(item, Notice) and part in self._late):
            file = self._late_file(part)
            if file is not None:
                return item, file
        if not stored:
            frame, capture_ns = self._starts[-1]
            item = replace(item, frame_index=frame, capture_ns=capture_ns)
        return item, self._next or self._recorder.file

    def _late_file(self, part: int) -> RecordingFile | None:
        # The file beside a former one; None where too many were made.
        if part in self._late:
            self._late.move_to_end(part)
            return self._late[part]
        if not self._late_left:
            return None
        self._late_left -= 1
        if len(self._late) >= _MOST_LATE_OPEN:
            self._close(self._late.popitem(last=False)[1], None)
        of = self._parts[part]
        names = chain([f"{of.stem}-backlog"], (f"{of.stem}-backlog-{number}" for number in count(2)))
        path = _free(of.with_name(f"{name}.rrd") for name in names)
        self._late[part] = self._opened(self._recorder.open_file(path), backlog=True)
        return self._late[part]

    def _numbered(self, number: int) -> Path:
        base = self._base
        return _free(base.with_name(f"{base.stem}-{one:04d}{base.suffix}") for one in count(number))

    # Facts for others

    def _opened(self, file: RecordingFile, *, backlog: bool = False) -> RecordingFile:
        self._accounts[file] = FileAccount(backlog=backlog or self._backlog)
        self.path = file.path
        self._report(file)
        return file

    def _close(self, file: RecordingFile, hurry: threading.Event | None) -> None:
        if not file.closed:
            self._recorder.close_file(file, hurry)
            self._report(file)
            del self._accounts[file]

    def _report(self, file: RecordingFile) -> None:
        if self._tell is None or file.path is None:
            return
        account = self._accounts[file]
        self._tell(
            RecordingRow(
                file=file.path.name,
                edge=self._settings.edge_id,
                session=self._settings.session,
                begin_ns=account.begin_ns,
                end_ns=account.end_ns,
                written_ns=0,
                size_bytes=file.size_bytes,
                frames=file.frames,
                stills=account.stills,
                classes=dict(account.classes),
                backlog=account.backlog,
                whole=file.closed,
            )
        )


def _free(paths: Iterable[Path]) -> Path:
    return next(path for path in paths if claim_name(path))
