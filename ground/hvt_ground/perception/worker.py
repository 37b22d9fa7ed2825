"""The thread of perception, beside the receiving one, so that decoding never waits for detection.

In real time pictures that come too fast are passed over, newest first; in lockstep nothing is, and the order is
always the same: the same input gives the same tracks.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing

from hvt_common.errors import foreign
from hvt_common.runtime.failures import reason_of
from hvt_common.runtime.process import lower_priority
from hvt_common.values import Tracks
from hvt_ground.perception.pipeline import DecodedFrame, ReceivedStill

_log = logging.getLogger(__name__)

_MOST_PICTURES, _MOST_PICTURE_BYTES = 12, 48 * 2**20
"""How many decoded frames may wait for detection and tracking; beyond, the oldest goes untracked. The newest waits,
however large."""
_MOST_PASSED = 64
_OLDEST_S = 0.6
"""A frame that has waited for longer goes untracked, if there is a newer one: a ground of too many edges would show
all of them ever later."""
_STILLS_AT_ONCE = 16
"""Stills of one frame that are read at once. Pictures that have arrived go between the stills of two frames, because
reading may take longer than the time between two pictures."""
_MOST_STILLS = 256
_MOST_STILL_BYTES = 32 * 2**20
_MOST_STEPS = 8
"""Reports of the edge's tracks: the newest count, each says all."""
_MOST_POSES = 64
_MOST_JOBS = 4096
_MOST_LAST_JOBS = 8
"""Limit for jobs of least priority: each holds a stretch of video."""
_JOB_STEP_S = 0.1
"""On a machine that never comes to rest jobs still get one step in this time."""
_STEP_LAG = 2
"""In lockstep a step, or a pose, counts from 2 frames on. It is sent right before the next access unit, which
may overtake it by microseconds: this makes the order the same in every run."""
_AHEAD = 6
"""Most pictures, and other turns, that in lockstep wait for one: a detection takes as long as some five decodings."""

Analyze = Callable[[DecodedFrame, bool, threading.Event | None], None]
"""Called with a picture, whether to hurry, and an event that is set once anything comes (None: all is waited for)."""
Step = Callable[[Tracks, int], None]
"""Called with the edge's tracks at one frame, and that frame's capture time."""
Read = Callable[[Sequence[ReceivedStill]], None]
Job = Generator[None, None, None]
"""Work that can wait, done step by step while nothing newer is there. An exception of a step ends this job alone; it
is closed at its end, done or not."""


class _Worker:
    """Takes pictures and stills from the receiving thread, and runs their jobs."""

    def __init__(self, analyze: Analyze, step: Step, read: Read) -> None:
        self._analyze = analyze
        self._step = step
        self._read = read
        self.untracked = 0
        """Pictures that were passed over."""
        self.dropped: Counter[str] = Counter()
        """Stills that were passed over, by reason."""
        self.jobs_failed = 0
        self._error: BaseException | None = None

    def raise_error(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _is_done(self, job: Job) -> bool:
        # Do one step of a job; whether it was the last.
        try:
            next(job)
        except StopIteration:
            return True
        except foreign() as error:  # the picture of now goes on
            self.jobs_failed += 1
            if self.jobs_failed.bit_count() == 1:
                _log.warning(
                    "what was stored cannot be worked off (%d so far): %s", self.jobs_failed, reason_of(error)
                )
            return True
        return False


class RealtimeWorker(_Worker):
    """A thread with two bounded queues. Pictures first: a still's frame has to be known before the still.

    ``pass_over`` takes frame and capture time of a picture for which there is no time, ``take_late()`` the objects
    found since their picture was analyzed: True while more may come. `close` leaves ``finish_s`` for the queues, then
    ``leave_s`` for the present work.
    """

    def __init__(
        self,
        analyze: Analyze,
        step: Step,
        read: Read,
        *,
        name: str,
        pass_over: Callable[[int, int], None] = lambda _frame_index, _capture_ns: None,
        take_late: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] = time.monotonic,
        finish_s: float = 1.5,
        leave_s: float = 1.0,
    ) -> None:
        super().__init__(analyze, step, read)
        self._pass_over = pass_over
        self._take_late = take_late
        self._clock = clock
        self._finish_s = finish_s
        self._leave_s = leave_s
        self._lock = threading.Lock()
        self._pictures: deque[tuple[DecodedFrame, float]] = deque()
        """Each with the moment at which it came."""
        self._passed: deque[tuple[int, int]] = deque(maxlen=_MOST_PASSED)
        """Frame and capture time of pictures that found no room, all older than the pictures."""
        self._stills: deque[ReceivedStill] = deque()
        self._steps: deque[tuple[Tracks, int]] = deque(maxlen=_MOST_STEPS)
        self._jobs: deque[Job] = deque()
        self._last_jobs: deque[Job] = deque()
        self._job_step_s = 0.0
        """When the last step of one was done."""
        self._wake = threading.Event()
        """Something has come or was found since the picture in hand was taken, or the thread is to end."""
        self._ending = threading.Event()
        self._given_up = threading.Event()
        self._in_hand = self._searching = False
        self._thread = threading.Thread(target=self._run, name=f"hvt-perception-{name}", daemon=True)
        self._thread.start()

    @property
    def idle(self) -> bool:
        # In the order of the work: from the queues to the present work, from there to the detector.
        return not (self._has_news() or self._jobs or self._last_jobs or self._in_hand or self._searching)

    @property
    def stills_queued(self) -> int:
        return len(self._stills)

    @property
    def accepts_jobs(self) -> bool:
        """Whether `submit` takes another."""
        return len(self._jobs) < _MOST_JOBS

    def _has_news(self) -> bool:
        return bool(self._steps or self._pictures or self._stills)

    def picture(self, picture: DecodedFrame) -> None:
        """Queue a frame; where the queue is full, or the oldest has waited for too long, that goes untracked."""
        now_s = self._clock()
        with self._lock:
            queued_bytes = sum(one.picture.nbytes for one, _ in self._pictures) + picture.picture.nbytes
            while self._pictures and (
                len(self._pictures) >= _MOST_PICTURES
                or queued_bytes > _MOST_PICTURE_BYTES
                or now_s - self._pictures[0][1] > _OLDEST_S
            ):
                oldest, _ = self._pictures.popleft()
                queued_bytes -= oldest.picture.nbytes
                self._passed.append((oldest.frame_index, oldest.capture_ns))
                self.untracked += 1
            self._pictures.append((picture, now_s))
        self._wake.set()

    def step(self, tracks: Tracks, capture_ns: int) -> None:
        """Queue a report of tracks; where the queue is full the oldest goes."""
        self._steps.append((tracks, capture_ns))
        self._wake.set()

    def pose(self, use: Callable[[], None], capture_ns: int) -> None:  # noqa: ARG002 - for lockstep
        """Where the camera was at that time counts at once, by ``use()``."""
        use()

    def still(self, still: ReceivedStill) -> None:
        """Queue a still; where the queue is full it is dropped."""
        with self._lock:
            if _fits(still, self._stills):
                self._stills.append(still)
            else:
                self.dropped["overflow"] += 1
        self._wake.set()

    def submit(self, job: Job, *, last: bool = False) -> bool:
        """Queue a job; one that comes ``last`` lets all others go before it, between any two steps.

        False where too many are queued: it is not taken.
        """
        queued, most = (self._last_jobs, _MOST_LAST_JOBS) if last else (self._jobs, _MOST_JOBS)
        if len(queued) >= most:
            return False
        queued.append(job)
        self._wake.set()
        return True

    def close(self) -> bool:
        """Finish the queue, for a second or two; False if the thread did not come back."""
        self._ending.set()
        self._wake.set()
        self._thread.join(self._finish_s)
        self._given_up.set()
        self._wake.set()
        self._thread.join(self._leave_s)
        self.dropped["ended"] += len(self._stills)
        self.untracked += len(self._pictures)
        return not self._thread.is_alive()

    def _run(self) -> None:
        lower_priority(little=True)  # boxes follow the picture, detection follows them
        try:
            while not self._given_up.is_set():
                self._wake.wait(0.2)
                self._wake.clear()
                self._in_hand = True
                self._work_off()
                self._searching = self._take_late()
                self._in_hand = False
                if self._ending.is_set() and self.idle:
                    return
        except BaseException as error:  # noqa: BLE001 - handed to the receiving thread, which ends the process
            self._error = error
        finally:
            for jobs in (self._jobs, self._last_jobs):
                while jobs:
                    jobs.popleft().close()

    def _work_off(self) -> None:
        # Analyze the pictures that came before the stills taken here, take the edge's tracks, then read.
        with self._lock:
            stills: list[ReceivedStill] = []
            while self._stills and len(stills) < _STILLS_AT_ONCE:
                if stills and self._stills[0].header.frame_index != stills[0].header.frame_index:
                    break
                stills.append(self._stills.popleft())
        self._take_pictures(hurry=False, awaited=bool(stills))
        while self._steps and not self._given_up.is_set() and not self._picture_before(self._steps[0][0]):
            self._step(*self._steps.popleft())
        if stills:
            # Pictures that came while the detector ran would wait as long again.
            self._take_pictures(hurry=True, awaited=True)
            self._read(stills)
        if self._has_news():
            self._wake.set()
        self._do_jobs()

    def _picture_before(self, step: Tracks) -> bool:
        # One that came while the detector ran. Its own list would be older than the step's, and never be shown: the
        # boxes of a frame before it would stand on its picture, and on those after it, while the camera moves on.
        with self._lock:
            return bool(self._pictures) and self._pictures[0][0].frame_index <= step.frame_index

    def _take_pictures(self, *, hurry: bool, awaited: bool) -> None:
        # Analyze the pictures that are there: in the newest objects are detected, unless in a ``hurry``. Where stills
        # have ``awaited`` them no detection is waited for.
        # Those that come meanwhile are not among them, or on a slow machine stills would wait for ever.
        for _ in range(len(self._pictures)):
            if self._given_up.is_set():
                break
            while self._passed:
                self._pass_over(*self._passed.popleft())
            with self._lock:
                if not self._pictures:  # those that waited for too long went meanwhile
                    break
                picture, came_s = self._pictures.popleft()
                newer = len(self._pictures) > 0
                self._wake.clear()
                stepped = bool(self._steps) and self._steps[-1][0].frame_index > picture.frame_index
                if newer or awaited or self._stills or stepped or self._ending.is_set():
                    self._wake.set()
                late = newer and self._clock() - came_s > _OLDEST_S
                self.untracked += late
            if late:
                self._pass_over(picture.frame_index, picture.capture_ns)
            else:
                self._analyze(picture, hurry or newer, self._wake)

    def _do_jobs(self) -> None:
        # Do jobs that can wait, until something comes that cannot.
        while (jobs := self._jobs or self._last_jobs) and not self._given_up.is_set():
            if self._wake.is_set() and self._clock() - self._job_step_s < _JOB_STEP_S:
                return
            if self._is_done(jobs[0]):
                jobs.popleft().close()
            self._job_step_s = self._clock()


class LockstepWorker(_Worker):
    """Analyzes one frame while the next are decoded, in order, waiting for it rather than passing anything over."""

    stills_queued, accepts_jobs = 0, True

    def __init__(self, analyze: Analyze, step: Step, read: Read, *, name: str) -> None:
        super().__init__(analyze, step, read)
        self._pending: deque[Future[None]] = deque()
        self._early: list[ReceivedStill] = []
        self._steps: deque[tuple[Tracks, int]] = deque(maxlen=_MOST_STEPS)
        self._poses: deque[tuple[int, Callable[[], None]]] = deque(maxlen=_MOST_POSES)
        self._captures_ns: deque[int] = deque(maxlen=_STEP_LAG)
        """Capture times of the last pictures."""
        self._newest_frame, self._ahead = -1, _AHEAD
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=f"hvt-perception-{name}")

    @property
    def idle(self) -> bool:
        return all(future.done() for future in self._pending)

    def raise_error(self) -> None:
        super().raise_error()
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()

    def picture(self, picture: DecodedFrame) -> None:
        """Analyze a frame, and read the stills of it that overtook it on the link."""
        if len(self._captures_ns) == _STEP_LAG:
            self._take_poses(until_ns=self._captures_ns[0])
        self._captures_ns.append(picture.capture_ns)
        self._take_steps(before=picture.frame_index - _STEP_LAG + 1)
        self._newest_frame = picture.frame_index
        self._ahead = max(2, min(_AHEAD, _MOST_PICTURE_BYTES // picture.picture.nbytes))
        self._submit(self._worker.submit(self._analyze, picture, False, None))
        known = [one for one in self._early if one.header.frame_index <= self._newest_frame]
        if known:
            self._early = [one for one in self._early if one.header.frame_index > self._newest_frame]
            self._submit(self._worker.submit(self._read, known))

    def step(self, tracks: Tracks, capture_ns: int) -> None:
        """Take in a report of tracks before the frame `_STEP_LAG` frames later."""
        self._steps.append((tracks, capture_ns))

    def pose(self, use: Callable[[], None], capture_ns: int) -> None:
        """It counts from `_STEP_LAG` pictures on, like a report of tracks."""
        self._poses.append((capture_ns, use))

    def still(self, still: ReceivedStill) -> None:
        """Read a still once its frame has been analyzed."""
        if still.header.frame_index <= self._newest_frame:
            self._submit(self._worker.submit(self._read, [still]))
            return
        while not _fits(still, self._early):
            self._early.pop(0)
            self.dropped["overflow"] += 1
        self._early.append(still)

    def submit(self, job: Job, *, last: bool = False) -> bool:  # noqa: ARG002 - one after the other
        """Do it after the jobs handed over before."""
        self._submit(self._worker.submit(self._do, job))
        return True

    def close(self) -> bool:
        """Finish the queue."""
        try:
            self._take_steps(before=None)
            while self._pending:
                self._pending.popleft().result()
        finally:
            self._worker.shutdown()
            self.dropped["ended"] += len(self._early)
        return True

    def _take_steps(self, *, before: int | None) -> None:
        while self._steps and (before is None or self._steps[0][0].frame_index < before):
            self._submit(self._worker.submit(self._step, *self._steps.popleft()))

    def _take_poses(self, *, until_ns: int) -> None:
        while self._poses and self._poses[0][0] <= until_ns:
            self._submit(self._worker.submit(self._poses.popleft()[1]))

    def _submit(self, future: Future[None]) -> None:
        self._pending.append(future)
        while len(self._pending) > self._ahead:
            self._pending.popleft().result()

    def _do(self, job: Job) -> None:
        with closing(job):
            while not self._is_done(job):
                pass


PerceptionWorker = RealtimeWorker | LockstepWorker


def _fits(still: ReceivedStill, queued: Collection[ReceivedStill]) -> bool:
    size_bytes = len(still.data) + sum(len(one.data) for one in queued)
    return not queued or (len(queued) < _MOST_STILLS and size_bytes <= _MOST_STILL_BYTES)
