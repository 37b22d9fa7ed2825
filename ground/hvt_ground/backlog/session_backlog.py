"""Turns a session's stored objects into the events of live messages: video in its holes, stills, boxes."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hvt_common.errors import UserError, foreign
from hvt_common.protocol.messages import BacklogUnit, Info
from hvt_common.runtime.statistics import Newest, SequenceWindow, StillSequenceWindow
from hvt_common.units import SECOND_NS
from hvt_common.values import Image, iou
from hvt_common.video.hevc import BaseDecoder
from hvt_ground.events import Event, Overlay, Refinement, VideoSample
from hvt_ground.perception.guesses import are_firm
from hvt_ground.perception.models import NotOpenError
from hvt_ground.perception.session import SessionPerception
from hvt_ground.perception.stills.decode import ReceivedStill
from hvt_ground.perception.stills.refine import ViewTilt
from hvt_ground.perception.worker import Job, PerceptionWorker
from hvt_ground.sinks import QueuedSink, Receipt

_LEAST_IOU, _MOST_LATE = 0.4, 512
_LONGEST_S = 1.0
"""The longest time that one frame counts as video, where the next was left out."""


@dataclass(slots=True)
class BacklogTotals:
    """Totals of a received backlog."""

    stills: int = 0
    frames: int = 0
    """Missing frames that can be shown."""
    left_out: int = 0
    """Frames that are missing still, because no decoder can use them."""
    video_s: float = 0.0
    first: tuple[int, int] | None = None
    """Frame index and capture time of the oldest of it."""

    def add(
        self, *, stills: int = 0, frames: int = 0, video_s: float = 0.0, at: tuple[int, int] | None = None
    ) -> None:
        """Count stored objects that came, or negative numbers for lost ones: they are sent again."""
        self.stills += stills
        self.frames += frames
        self.video_s += video_s
        self.first = min(filter(None, (self.first, at)), default=None)

    def amount(self) -> str:
        """``12 stills and 31 s of video``; empty where it is nothing."""
        parts = [f"{self.stills} still{'s' * (self.stills != 1)}"] if self.stills > 0 else []
        if self.frames > 0:
            parts.append(f"{self.video_s:.{int(self.video_s < 1)}f} s of video")
        return " and ".join(parts)


class LateStills:
    """Stored stills name the tracks of stored video: each the one whose box it shows at its frame.

    For one session and one thread. Stills come before the boxes of their frame, and before its ``tilt`` is known.
    A still that matches a track outweighs others that matched none; ``scale`` is base pixels per source pixel.
    """

    def __init__(self, tilt: ViewTilt, *, scale: float) -> None:
        self._tilt, self._scale = tilt, scale
        self._stills: Newest[int, list[Refinement]] = Newest(_MOST_LATE)
        """Those of no track yet, by frame."""
        self._named: Newest[int, Refinement] = Newest(_MOST_LATE)
        """Stills by track."""

    def take(self, still: Refinement) -> None:
        """Note a stored still that was read; others pass by."""
        if still.stored and not still.unread and still.track_id is None:
            bare = replace(still, base_crop_bgr=None, still_bgr=None)  # the pictures are shown already
            self._stills.setdefault(still.frame_index, []).append(bare)

    def named(self, overlay: Overlay) -> Iterator[Event]:
        """The overlay with the classes of the stills so far, after the refinements by the stills of its frame."""
        tracks = overlay.track_ids.tolist()
        for still in self._stills.pop(overlay.frame_index, ()) if tracks else ():
            shares = iou(np.array([still.box_base_px], np.float32), overlay.boxes_base_px)[0]
            best = int(shares.argmax())
            if shares[best] >= _LEAST_IOU:
                known = replace(still, track_id=tracks[best], class_before=overlay.base_classes[best])
                self._named[tracks[best]] = known
                vague = bool(overlay.vague[best]), self._tilt.vague_of(known)[1]
                yield replace(known, vague=vague, doubted=self._doubts(known, guess=overlay.doubted[best]))
        stills = [self._named.get(track) for track in tracks]
        if not any(stills):
            yield overlay
            return
        classes = zip(overlay.classes, stills, strict=True)
        confidences = zip(overlay.confidences.tolist(), stills, strict=True)
        doubts = zip(overlay.doubted.tolist(), stills, strict=True)
        guesses = zip(overlay.vague.tolist(), stills, strict=True)
        yield replace(
            overlay,
            classes=tuple(still.class_after if still else name for name, still in classes),
            confidences=np.array([s.confidence if s else own for own, s in confidences], np.float32),
            refined=np.array([still is not None for still in stills], np.bool_),
            doubted=np.array([self._doubts(s, guess=own) if s else own for own, s in doubts], np.bool_),
            vague=np.array([self._tilt.vague_of(s)[1] if s else own for own, s in guesses], np.bool_),
        )

    def _doubts(self, still: Refinement, *, guess: bool) -> bool:
        firm = are_firm([still.box_base_px], [still.confidence], scale=self._scale)[0]
        return self._tilt.doubts(still) or bool(guess and not firm)


class SessionBacklog:
    """Of one session, open or over. Safe for the receiving thread and the perception worker's.

    ``log`` takes events that may lie before others it has; ``stills`` is the session's own where it is open.
    ``outputs`` are the sinks behind ``log`` that the edge may rely on.
    """

    def __init__(
        self,
        info: Info,
        *,
        log: Callable[[Event], None],
        perception: SessionPerception | None,
        read: Callable[[ReceivedStill], None],
        stills: StillSequenceWindow | None = None,
        outputs: Sequence[QueuedSink[Event]] = (),
    ) -> None:
        self.info = info
        self.perception = perception
        self.video = BacklogVideo(base_size=info.base_size)
        self.log = log
        self._outputs = outputs
        self._read = read
        self._stills = stills or StillSequenceWindow()
        self._frame_ns = round(SECOND_NS / info.fps)
        self._lock = threading.Lock()
        self._frames = SequenceWindow()
        self._late = LateStills(ViewTilt() if perception is None else perception.tilt, scale=info.view.scale)
        self.totals = BacklogTotals()
        self._news = BacklogTotals()

    def live(self, frame_index: int, data: bytes, *, keyframe: bool, after_gap: bool) -> None:
        """Note a unit that came over the link at once and was decoded."""
        with self._lock:
            self._frames.add([frame_index])
        self.video.live(frame_index, data, keyframe=keyframe, after_gap=after_gap)

    def able(self) -> bool:
        """Whether an object logged now will be written. Otherwise it must come again: the edge would forget it."""
        return all(one.is_open() for one in self._outputs)

    def is_new_still(self, sequence: int) -> bool:
        """Note the number of a still; whether none of it has come before, on whichever way."""
        return self._stills.is_new(sequence)

    def read_still(self, still: ReceivedStill) -> None:
        """Read and count a still; whatever goes wrong, it is new when it comes again."""
        header = still.header
        try:
            self._read(still)
        except foreign():
            self._stills.forget(header.sequence)
            raise
        self._count(stills=1, at=(header.frame_index, header.capture_ns))

    def receipt(self) -> Receipt:
        """The receipt of everything logged from now on: only written objects are acknowledged."""
        return Receipt(self._outputs)

    def lose_still(self, sequence: int) -> None:
        """A still that was read is lost on its way into the recording: it is new again."""
        self._stills.forget(sequence)
        self._count(stills=-1)

    def lose_frames(self, lengths_s: Mapping[int, float]) -> None:
        """Frames that were shown are lost on their way into the recording: they are missing again."""
        with self._lock:
            for frame_index in lengths_s:
                self._frames.discard(frame_index)
        self._count(frames=-len(lengths_s), video_s=-sum(lengths_s.values()))

    def note(self, still: Refinement) -> None:
        """Note the outcome of a still, for the boxes of its frame should it be a stored one."""
        self._late.take(still)

    def log_boxes(self, event: Event) -> None:
        """Log boxes of stored video, named by the stills."""
        for named in self._late.named(event) if isinstance(event, Overlay) else (event,):
            self.log(named)

    def show(self, unit: BacklogUnit, image: Image | None, *, after: BacklogUnit | None) -> float | None:
        """Log a frame that is missing, and say for how many seconds it counts.

        None where it is not missing, or cannot be shown (``image`` is None).
        """
        with self._lock:
            if image is None:
                self.totals.left_out += unit.frame_index not in self._frames
                return None
            if not self._frames.add([unit.frame_index]):
                return None
            frames = 1 if after is None else unit.frame_index - after.frame_index
            lasts_s = min(frames / self.info.fps, _LONGEST_S)
        self._count(frames=1, video_s=lasts_s, at=(unit.frame_index, unit.capture_ns))
        self.log(VideoSample(unit.frame_index, unit.capture_ns, unit.data, unit.keyframe, stored=True))
        return lasts_s

    def end_boxes(self, last: BacklogUnit) -> None:
        """The boxes of a stretch end with it, where nothing goes on from there."""
        with self._lock:
            if last.frame_index + 1 in self._frames:
                return
        self.log(Overlay.none(last.frame_index + 1, last.capture_ns + self._frame_ns, stored=True))

    def _count(self, **what: Any) -> None:
        with self._lock:
            for totals in (self.totals, self._news):
                totals.add(**what)

    def take_news(self) -> BacklogTotals:
        """Return and forget the arrivals since the last call."""
        with self._lock:
            news, self._news = self._news, BacklogTotals()
            return news


_MOST_GOP_BYTES = 2 * 2**20
_GAPS = 4


class BacklogVideo:
    """A session's stored video. `live` and `pictures` may be called by two threads. Pictures have ``base_size``.

    A stretch that begins with a keyframe stands by itself. The first one of an outage need not: it goes on from the
    last picture that came over the link, so the units since the last keyframe before each gap are remembered.
    """

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


Take = Callable[[], AbstractContextManager[SessionBacklog | None]]
Done = Callable[[bool | None], None]
"""``take()`` opens the session's backlog, and lets it go when the job ends; it gives None where nothing of that
session is taken any more. ``done(usable)`` is called when the object is written; None: it was not taken, or is lost.
"""


def read_still(still: ReceivedStill, take: Take, *, done: Done) -> Job:
    """Read one still, in one step."""
    sequence, receipt, new = still.header.sequence, Receipt(()), False
    try:
        with take() as target:
            if target is not None:
                receipt, new = target.receipt(), target.is_new_still(sequence)
                if new:
                    target.read_still(still)
    except foreign() as error:
        done(_usable(error))
        raise

    def end(written: bool) -> None:  # noqa: FBT001 - a receipt
        if target is not None and new and not written:
            target.lose_still(sequence)
        done(True if written and target is not None else None)

    receipt.then(end)
    yield from ()


def show_video(units: Sequence[BacklogUnit], take: Take, *, worker: PerceptionWorker, done: Done) -> Job:
    """Log those frames of a stretch that are missing and can be decoded; another job finds their boxes.

    Where the worker has too many of those, only the video is shown.
    """
    target: SessionBacklog | None = None
    receipt, usable = Receipt(()), None
    logged: dict[int, float] = {}
    """Frame index → the seconds that it counts for."""

    def finish(usable: bool | None) -> None:  # noqa: FBT001 - as of `done`
        # Say so when it is written; frames that are lost on the way are missing again.
        def end(written: bool) -> None:  # noqa: FBT001 - a receipt
            if target is not None and not written:
                target.lose_frames(logged)
            done(usable if written else None)

        receipt.then(end)

    try:
        with take() as target:
            if target is not None:
                receipt, last = target.receipt(), None
                for shown in target.video.pictures(units):
                    if not target.able():
                        break
                    lasts_s = None if shown is None else target.show(*shown, after=last)
                    if shown is not None and lasts_s is not None:
                        last = shown[0]
                        logged[last.frame_index] = lasts_s
                    yield
                else:
                    usable = target.able() or None
                boxes = _find_boxes(units, logged.keys(), take)
                if usable and logged and next(boxes, True) is None and not worker.submit(boxes, last=True):
                    boxes.close()
    except foreign() as error:
        finish(_usable(error))
        raise
    finish(usable)


def _find_boxes(units: Sequence[BacklogUnit], frames: AbstractSet[int], take: Take) -> Job:
    with take() as target:
        if target is None or target.perception is None:
            return
        yield  # the recording stays open while this waits
        analyze, last = target.perception.track(target.log_boxes), None
        for shown in target.video.pictures(units):
            if shown is not None and shown[1] is not None and shown[0].frame_index in frames:
                last = shown[0]
                analyze(last.frame_index, last.capture_ns, shown[1])
            yield
        if last is not None:
            target.end_boxes(last)


def _usable(error: BaseException) -> bool | None:
    # The object comes again if the machine may mend it, such as a full disk.
    return None if isinstance(error, OSError | UserError | NotOpenError) else False
