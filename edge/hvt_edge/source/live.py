"""Live sources: a reader thread holds the latest frame of a camera or a network stream.

Where frames come in bursts, as over UDP through a radio, it holds the frames of one burst.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from hvt_common.errors import NotYetError, UserError
from hvt_common.runtime.clock import SteadyClock
from hvt_common.runtime.failures import Failures, RetryPause, reason_of
from hvt_common.units import SECOND_NS
from hvt_common.values import Frame, Image
from hvt_edge.source.contract import IDLE_S, BaseSize, Notes, Source, SourceSettings
from hvt_edge.source.resample import Gate, Resizer

_log = logging.getLogger(__name__)

FIRST_WAIT_NS, _LONGEST_WAIT_NS = SECOND_NS // 2, 8 * SECOND_NS
JOIN_S = 1.5
LEAST_PATIENCE_S, _MOST_PATIENCE_S = 2.0, 10.0
_MOST_PENDING = 8
"""Most frames of a burst that are held."""
_STEADY_NS = 2 * SECOND_NS
"""After this time without a missed frame, one may wait beside the newest: a keyframe is slow to code."""
SOURCE_PART = "source"


def patience_s(fps: float) -> float:
    """Time without a frame after which a camera is gone: two frames of ``fps``, within bounds."""
    return min(_MOST_PATIENCE_S, max(LEAST_PATIENCE_S, 2 / fps))


@dataclass(frozen=True, slots=True)
class Shot:
    """A grabbed frame that is converted to BGR only if it is wanted."""

    image: Callable[[], Image]
    camera_ns: int | None = None
    """Capture time by the camera's own clock, Unix nanoseconds; None where it gives none."""
    packet: object = None
    """For ``--encoder passthrough``; ``image`` then decodes it, and is not called otherwise."""
    missed: int = 0
    """Frames that came between the one before and this one, and were not taken in time."""
    damaged: int = 0
    """Frames between the two that could not be decoded."""


class SignalLost(Exception):  # noqa: N818 - an event, not a fault of the program
    """The device or the stream stopped; opening it again may help."""


class Grabber(Protocol):
    """A device that delivers frames as they happen. Used from one thread at a time; no call blocks for ever."""

    name: str

    @property
    def notes(self) -> Notes | None: ...

    def open(self) -> None:
        """Open for the first time: raises UserError where there is no device or stream."""

    def restart(self) -> None:
        """Open again after `SignalLost`; raises that or `UserError` if it fails."""

    def grab(self) -> Shot:
        """Wait for the next frame; raises `SignalLost`."""
        ...

    def close(self) -> None:
        """Release the device."""


class LiveSource(Source):
    """A camera or stream, resampled to the base rate by `Gate`; slow consumers lose frames, never gain delay.

    Frames are not repeated when the camera is slower than the base rate. After a loss of signal, or any other error
    of the grabber, the source is opened again, with growing pauses, until it is closed. ``clock`` gives Unix
    nanoseconds and must not go back, or the source gives no frame until it has caught up.
    """

    live = True
    frame_count = None

    def __init__(
        self,
        grabber: Grabber,
        settings: SourceSettings,
        *,
        clock: Callable[[], int] | None = None,
        failures: Failures | None = None,
    ) -> None:
        self.fps, self._limit = settings.fps, settings.max_frames
        self._clock = clock or SteadyClock()
        self._failures = failures or Failures(self._clock)
        self._grabber = grabber
        grabber.open()
        try:
            first_size = self._first_size(grabber, settings.size)
        except UserError:
            grabber.close()
            raise
        except Exception as error:
            grabber.close()
            raise NotYetError(
                f"source {grabber.name} opens but delivers no picture ({_reason(error)})"
            ) from error
        self._resizer = Resizer(first_size, settings.size, fit=settings.fit, name=grabber.name)
        self.notes = () if grabber.notes is None else grabber.notes.taken()
        self.view = self._resizer.view
        self._pause = RetryPause(FIRST_WAIT_NS, _LONGEST_WAIT_NS)
        self._news = threading.Condition()
        self._pending: deque[tuple[int, Image]] = deque()
        """(capture time, picture), the latest last: all of a burst, else one, or two for once."""
        self._missed_ns: int | None = None
        """Capture time of the frame before which another was missed."""
        self._gate = Gate(self.fps)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hvt-source", daemon=True)
        self._thread.start()

    def frames(self, *, start_ns: int) -> Iterator[Frame]:
        """Frames as they come, until the source is closed; ``capture_ns`` is their capture time (`CameraClock`)."""
        return (frame for frame in self.steps(start_ns=start_ns) if frame is not None)

    def steps(self, *, start_ns: int) -> Iterator[Frame | None]:  # noqa: ARG002 - a camera has its own time
        index = 0
        while index != self._limit:
            with self._news:
                self._news.wait_for(lambda: self._pending or self._stop.is_set(), IDLE_S)
                item = self._pending.popleft() if self._pending else None
            if self._stop.is_set():
                return
            if item is None:
                yield None
                continue
            yield self._resizer.frame(item[1], index=index, capture_ns=item[0])
            index += 1

    @property
    def pending(self) -> int:
        """Frames that have come and were not taken yet."""
        return len(self._pending)

    def close(self) -> None:
        """Stop the reader and join it; it answers within its read timeout."""
        again = self._stop.is_set()
        self._end()
        self._thread.join(JOIN_S)
        if self._thread.is_alive() and not again:
            _log.warning("%s did not answer within %g s and is left behind", self._grabber.name, JOIN_S)

    def _first_size(self, grabber: Grabber, size: BaseSize) -> tuple[int, int]:
        del size
        first = grabber.grab().image()
        return first.shape[1], first.shape[0]

    def _end(self) -> None:
        with self._news:
            self._stop.set()
            self._news.notify_all()

    def _run(self) -> None:
        camera_clock = CameraClock()
        try:
            while not self._stop.is_set():
                try:
                    shot = self._grabber.grab()
                    capture_ns = camera_clock.capture_ns(shot.camera_ns, now_ns=self._clock())
                    self._take(shot, capture_ns, jitter_ns=camera_clock.jitter_ns)
                except Exception as error:  # noqa: BLE001 - a driver or a decoder may raise any error
                    self._recover(error)
        finally:
            self._grabber.close()
            self._end()

    def _take(self, shot: Shot, capture_ns: int, *, jitter_ns: int) -> None:
        # A frame has come (the reader's thread); those of the last ``jitter_ns`` may have come with it.
        self.unreadable += shot.damaged
        shot_missed = self._gate.wanted(shot.missed, before_ns=capture_ns)
        if not self._gate.accept(capture_ns):
            self.missed += shot_missed
            self.passed_over += 1
            return
        image = shot.image()
        with self._news:
            together = [one for one in self._pending if one[0] >= capture_ns - jitter_ns]
            if not together and (self._missed_ns is None or capture_ns - self._missed_ns >= _STEADY_NS):
                together = list(self._pending)[-1:]
            together = together[1 - _MOST_PENDING :]
            missed = len(self._pending) - len(together) + shot_missed
            if missed:
                self.missed, self._missed_ns = self.missed + missed, capture_ns
            self._pending = deque([*together, (capture_ns, image)])
            self._news.notify_all()
        self._failures.works(SOURCE_PART)

    def _recover(self, error: Exception) -> None:
        # Open the grabber again, waiting twice as long after each failure; returns when it is open or we stop.
        again = False
        while not self._stop.is_set():  # a grabber that stops because it is closed has not failed
            self._pause.failed(self._clock(), again=again)
            self._failures.failed(SOURCE_PART, f"{self._grabber.name} stopped ({_reason(error)})")
            if self._stop.wait(self._pause.pause_ns / SECOND_NS):
                return
            try:
                self._grabber.restart()
            except Exception as later:  # noqa: BLE001 - see above
                error, again = later, True
            else:
                self.restarts += 1
                return


def _reason(error: Exception) -> str:
    # A driver or a decoder may raise any error.
    return str(error) if isinstance(error, SignalLost | UserError) else reason_of(error)


_MOST_DELAY_NS = 5 * SECOND_NS
"""A frame that seems older than this shows that the camera's clock differs from ours."""
_MEMORY_NS = 60 * SECOND_NS
"""The least delay of the last one to two of these periods counts: two clocks drift apart."""

_MOST_BEHIND_NS = 2 * SECOND_NS
"""Delay that has grown beyond this step by step means another length of a second: 25 stamps a second, 24 frames."""
_MOST_SET_NS = SECOND_NS
"""The same where the stamps go back: the camera's clock was set."""
_OFTEN = 3
"""Stamps that fell behind so often, each time within half a minute of the last, do not count for a minute."""
_PROOF_NS, _NEAR_NS = 10 * SECOND_NS, SECOND_NS // 10
"""Stamps that come this near to the least delay after this time count the same second as we do: …"""
_HELD_NS = 10 * SECOND_NS
"""… a network holds such frames back, until their delay has not fallen for this long."""
_RECENT = 32
"""Number of newest frames whose delays give the jitter."""
_MOST_JITTER_NS = SECOND_NS // 4


class CameraClock:
    """Turns a camera's time stamps into this process's time.

    A clock that agrees with ours (NTP) is used as it is. Of any other only the differences count: the frame
    that came quickest is taken to have come at once. Times never go back: where they would, as when the camera first
    reports its clock, they go on at half the pace until they have met.
    """

    def __init__(self) -> None:
        self._last_ns = self._came_ns = 0
        """Capture time of the newest frame, and when it came."""
        self._least: list[int] = []
        """The least delay of the present period, behind that of the one before."""
        self._camera_ns = 0
        """The newest frame's time by the camera."""
        self._since_ns = self._begun_ns = 0
        """When the present least delay was begun, and when the first for the stamps as they count now."""
        self._proven = False
        self._fell_behind = self._behind_ns = self._unused_ns = 0
        """How often its stamps did lately, when last, and until when they do not count for it."""
        self._late_ns = self._held_ns = self._fell_ns = 0
        """How late the last frame was, the least of those that are held back for long, and when that was found."""
        self._recent: deque[int] = deque(maxlen=_RECENT)
        """Delays of the newest frames."""

    @property
    def jitter_ns(self) -> int:
        """By how much some recent frames came later than others: they come in bursts. At most a quarter second."""
        return min(_MOST_JITTER_NS, max(self._recent, default=0) - min(self._recent, default=0))

    def capture_ns(self, camera_ns: int | None, *, now_ns: int) -> int:
        """The capture time of the frame that has just come; ``camera_ns`` is None where the camera gives none."""
        if now_ns < self._unused_ns:
            camera_ns = None
            self._least.clear()
        taken_ns = now_ns if camera_ns is None else camera_ns + self._ahead_ns(camera_ns, now_ns)
        taken_ns = min(taken_ns, now_ns)
        if taken_ns <= self._last_ns:
            taken_ns = self._last_ns + max(1, (now_ns - self._came_ns) // 2)
        self._last_ns, self._came_ns = taken_ns, now_ns
        self._recent.append(now_ns - self._last_ns)
        return self._last_ns

    def _ahead_ns(self, camera_ns: int, now_ns: int) -> int:
        delay_ns = now_ns - camera_ns
        if not self._least or self._counts_anew(camera_ns, delay_ns - min(self._least), now_ns):
            self._least, self._begun_ns, self._since_ns, self._proven = [delay_ns], now_ns, now_ns, False
        elif now_ns - self._since_ns > _MEMORY_NS:
            self._least, self._since_ns = [self._least[-1], delay_ns], now_ns
        self._camera_ns, self._least[-1] = camera_ns, min(self._least[-1], delay_ns)
        least_ns = min(self._least)
        self._proven |= now_ns - self._begun_ns >= _PROOF_NS and delay_ns - least_ns <= _NEAR_NS
        return 0 if 0 <= least_ns <= _MOST_DELAY_NS else least_ns

    def _counts_anew(self, camera_ns: int, late_ns: int, now_ns: int) -> bool:
        # Frames that a network held back are late at once, and their stamps go on; where they go back, a clock was
        # set, and where they fall behind step by step, they count another second.
        leaps, self._late_ns = late_ns - self._late_ns > _MOST_SET_NS, late_ns
        if camera_ns < self._camera_ns:
            return late_ns > _MOST_SET_NS
        if late_ns <= _MOST_BEHIND_NS:
            self._held_ns = 0
            if late_ns < -_MOST_BEHIND_NS:
                self._fell_behind = 0
                return True
            return False
        if self._held_ns == 0 and not leaps:
            soon = now_ns - max(self._behind_ns, self._unused_ns) < _MEMORY_NS // 2
            self._fell_behind, self._behind_ns = self._fell_behind * soon + 1, now_ns
            if self._fell_behind >= _OFTEN:  # no queue that grew: most frames would seem to come too early
                self._unused_ns = now_ns + _MEMORY_NS
            return True
        if leaps or late_ns < self._held_ns - _NEAR_NS:
            self._held_ns, self._fell_ns = late_ns, now_ns
        return not self._proven or now_ns - self._fell_ns > _HELD_NS
