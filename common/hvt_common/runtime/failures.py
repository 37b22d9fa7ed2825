"""Parts that fail in flight: said once, counted, tried again with growing pauses, while everything else goes on."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar
from weakref import WeakSet

from hvt_common.errors import NotYetError, UserError, foreign
from hvt_common.redaction import Redaction
from hvt_common.units import SECOND_NS

_log = logging.getLogger(__name__)

_Part = TypeVar("_Part")
_Answer = TypeVar("_Answer")
_Other = TypeVar("_Other")
_REDACTION = Redaction()
_STEADY_NS = 60 * SECOND_NS
"""A failure of a part that worked for a minute is reported anew."""
SILENT_NS = 10 * SECOND_NS
"""The slowest network answers sooner."""
_STEADY_PAUSES = 10
"""A part that worked for this many first pauses is retried after the first pause again: that costs little."""


def reason_of(error: BaseException) -> str:
    """An error in one line: a sentence, a database's or the system's words as they are; all else after its kind."""
    said = isinstance(error, UserError) or type(error).__module__ == "sqlite3"
    text = str(error) if said else f"{type(error).__name__}: {error}"
    if type(error).__module__ == "builtins" and isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return _one_line(text)


def _one_line(text: str) -> str:
    return " ".join(text.split())[:300]


@dataclass(frozen=True, slots=True)
class Failure:
    """The state of one failed part."""

    part: str
    reason: str
    """The newest failure, a sentence."""
    count: int
    failed_ns: int
    """The newest failure, Unix time."""
    since_ns: int
    """When it stopped, before all tries that were in vain."""
    working: bool = False
    over: bool = False
    """It has ended, and is not tried any more."""


@dataclass(frozen=True, slots=True)
class FailedPart:
    """A part that does not work now."""

    part: str
    reason: str
    """A sentence."""
    since_ns: int
    """Unix time."""


class Failures:
    """Which parts of a process have failed since its start. Thread-safe."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._parts: dict[str, Failure] = {}
        self._said: set[str] = set()
        """Parts that the log has reported as failed."""
        self._watched = WeakSet[Turns]()

    def watch(self, part: Turns) -> None:
        """Ask the part whether it hangs before each listing of failures, for as long as it exists."""
        with self._lock:
            self._watched.add(part)

    @property
    def parts(self) -> tuple[Failure, ...]:
        """The parts in the order of their first failure."""
        return tuple(self._parts.values())

    @property
    def now(self) -> tuple[FailedPart, ...]:
        with self._lock:
            watched = list(self._watched)
        for one in watched:
            one.check()
        return tuple(
            FailedPart(one.part, one.reason, one.since_ns)
            for one in self.parts
            if not (one.working or one.over)
        )

    def in_hand(self) -> frozenset[tuple[str, int]]:
        """The turns that have begun and not ended: name of the part, and a number that no other turn of it has."""
        with self._lock:
            return frozenset((one.name, one.count) for one in self._watched if one.count % 2)

    @property
    def hanging(self) -> str:
        """That the program hangs as it ends, a sentence, and which of its parts do not answer."""
        names = sorted(name for name, _ in self.in_hand())
        where = f": {', '.join(names)}" if names else ""
        return f"it was stopped, and something in it hangs{where}; what was written until then is kept"

    def failed(self, part: str, reason: str, *, last: bool = False, said: bool = False) -> int:
        """It has stopped, for the how manieth time. The log says so once, however often it is tried in vain.

        The ground, who watches the process and the summary are told the reason, without secrets of an address.
        ``last``: it ends, and is not tried again. ``said``: the program ends with that sentence.
        """
        reason = _one_line(_REDACTION.text(reason))
        now_ns = self._clock()
        with self._lock:
            before = self._parts.get(part)
            count = 1 if before is None else before.count + 1
            anew = before is None or before.working or before.over
            since_ns = now_ns if before is None or anew else before.since_ns
            self._parts[part] = Failure(part, reason, count, now_ns, since_ns)
        if said:
            return count
        if anew and (before is None or now_ns - before.failed_ns > _STEADY_NS or count.bit_count() == 1):
            self._said.add(part)
            times = "" if count == 1 else f" ({count} failures so far)"
            again = "" if last else ", and it is tried again"
            _log.warning("%s: %s; all else goes on%s%s", part, reason, again, times)
        return count

    def over(self, part: str, count: int) -> None:
        """It has ended without working again. Where it failed since that time, another of the name is at work."""
        with self._lock:
            one = self._parts.get(part)
            if one is not None and one.count == count and not one.working:
                self._parts[part] = replace(one, over=True)

    def attempt(
        self, part: str, call: Callable[..., _Answer], otherwise: _Other, *arguments: Any
    ) -> _Answer | _Other:
        """What a part answers that may raise any exception, or hang; ``otherwise`` where it raises."""
        try:
            with Turns(part, self, clock=self._clock):
                answer = call(*arguments)
        except foreign() as error:
            self.failed(part, reason_of(error))
            return otherwise
        self.works(part)
        return answer

    def works(self, part: str) -> None:
        with self._lock:
            before = self._parts.get(part)
            if before is None or before.working:
                return
            self._parts[part] = replace(before, working=True)
        if part in self._said:
            self._said.discard(part)
            _log.warning("%s: works again", part)


class RetryPause:
    """The wait before the next try: twice as long after each failure that comes soon. Time is an argument."""

    def __init__(self, first_ns: int = SECOND_NS, longest_ns: int = 60 * SECOND_NS) -> None:
        self._first_ns = first_ns
        self._longest_ns = longest_ns
        self.pause_ns = 0
        """From the newest failure to the next try; 0 before the first."""
        self._failed_ns = 0

    def failed(self, now_ns: int, *, again: bool = False) -> None:
        """It failed, at the start or after it had worked for a while; ``again``: it has not, the try was long."""
        worked_ns = 0 if again else now_ns - self._failed_ns - self.pause_ns
        steady = worked_ns > _STEADY_PAUSES * self._first_ns
        self.pause_ns = self._first_ns if steady else min(2 * self.pause_ns, self._longest_ns)
        self.pause_ns = max(self._first_ns, self.pause_ns)
        self._failed_ns = now_ns

    def due(self, now_ns: int) -> bool:
        return now_ns - self._failed_ns >= self.pause_ns


class _InHand(threading.local):
    turns: Turns | None = None


_in_hand = _InHand()
_firsts = itertools.count(0, 1 << 32)


class Turns:
    """The turns of a part that may hang, as a driver or a disk does: it has failed until it answers.

    Of two turns in one another only the inner one is watched. For one thread, or threads that take turns.
    """

    def __init__(
        self, name: str, failures: Failures, *, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.name, self._failures, self._clock = name, failures, clock
        self.count = next(_firsts)
        """Begun and ended, or left for an inner one: odd while it is asked, and no other's of any part."""
        self._seen = self.count, 0
        """As many at a former `check`, and when."""
        self._hangs = False
        self._outer: Turns | None = None
        failures.watch(self)

    def __enter__(self) -> None:
        self._outer, _in_hand.turns = _in_hand.turns, self
        if self._outer is not None:
            self._outer.count += 1
        self.count += 1

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.count += 1
        if self._outer is not None:
            self._outer.count += 1
        _in_hand.turns, self._outer = self._outer, None
        if self._hangs:
            self._hangs = False
            if kind is None:
                self._failures.works(self.name)

    def check(self) -> None:
        """Say that it hangs, where it does."""
        count, now_ns = self.count, self._clock()
        if count != self._seen[0]:
            self._seen = count, now_ns
        elif count % 2 and not self._hangs and now_ns - self._seen[1] > SILENT_NS:
            self._hangs = True
            self._failures.failed(self.name, f"no answer for {SILENT_NS // SECOND_NS} s")

    @staticmethod
    def goes_on() -> None:
        """The turn that this thread has in hand takes long by its nature, and does not hang."""
        if _in_hand.turns is not None:
            _in_hand.turns.count += 2


class Retried(Generic[_Part]):
    """A part that may raise any exception: it is opened again after a pause. Threads take turns (`Turns`).

    ``failures`` lists it as ``name``; ``clock`` is steady nanoseconds. Raises the exceptions of ``open_part``.
    """

    def __init__(
        self,
        open_part: Callable[[], _Part],
        name: str,
        failures: Failures,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.part = open_part()
        """The one that is open, or that failed last."""
        self._open_part = open_part
        self._name = name
        self._failures = failures
        self._clock = clock
        self._pause = RetryPause()
        self._failed = False
        self._turns = Turns(name, failures, clock=clock)
        self._lock = threading.Lock()

    def run(self, use: Callable[[_Part], _Answer]) -> _Answer | None:
        """None where it fails, or has failed and is left alone for a while."""
        with self._lock:
            if self._failed and not self._pause.due(self._clock()):
                return None
            try:
                if self._failed:
                    self.part = self._open_part()
                with self._turns:
                    answer = use(self.part)
            except foreign() as error:
                self._pause.failed(self._clock(), again=self._failed)
                self._failed = True
                self._failures.failed(self._name, reason_of(error))
                return None
            if self._failed:
                self._failed = False
                self._failures.works(self._name)
            return answer


class Awaited(Generic[_Part]):
    """A part that may not be there yet: opened at once, or else by `wait`, again and again until it is.

    ``failures`` lists it as ``name``. Raises the exceptions of ``open_part`` except `NotYetError`.
    """

    def __init__(
        self, open_part: Callable[[], _Part], name: str, failures: Failures, *, longest_s: float = 5.0
    ) -> None:
        self._open_part = open_part
        self._name = name
        self._failures = failures
        self._pause = RetryPause(longest_ns=round(longest_s * SECOND_NS))
        self.error: UserError | None = None
        """Why it is not there."""
        self.part = self._tried()
        """None while it is not there."""

    def wait(self, stop: threading.Event) -> _Part | None:
        """The part, once it is there; None where ``stop`` was set before."""
        while self.part is None and not stop.wait(self._pause.pause_ns / SECOND_NS):
            self.part = self._tried()
        return self.part

    def _tried(self) -> _Part | None:
        try:
            part = self._open_part()
        except NotYetError as error:
            self.error = error
            self._pause.failed(time.monotonic_ns(), again=True)
            self._failures.failed(self._name, reason_of(error))
            return None
        self._failures.works(self._name)
        return part
