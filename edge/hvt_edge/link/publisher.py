"""The edge's end of the link: publishers, queryables and the feedback subscriber. Uses Zenoh; knows no frames."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, Self

import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import (
    ControlAnswer,
    ControlRequest,
    Feedback,
    InfoRequest,
    UnknownVersionError,
    WireError,
)
from hvt_common.runtime.failures import Failures, RetryPause
from hvt_common.transport.inbox import FloodWatch
from hvt_common.transport.link_doctor import link_doctor
from hvt_common.transport.session import (
    another_key,
    declare_publisher,
    loses_declarations,
    open_session,
    serve,
)
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_edge.link.transmitter import Outlet

_log = logging.getLogger(__name__)

_PUBLISHED = (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.POSE, Channel.BACKLOG, Channel.STATUS)
_MOST_PER_S = 1000
"""Requests, or reports: a ground sends about ten a second."""
_AGAIN_NS = {Channel.INFO: (2 * SECOND_NS,) * 2}
_AGAIN_NS |= dict.fromkeys((Channel.CONTROL, Channel.FEEDBACK), (2 * SECOND_NS, 64 * SECOND_NS))
"""First and longest pause before a channel is declared anew. A ground queries info within a fraction of it; some
grounds never command, some never report."""
_NEEDED = (Channel.BASE, Channel.ROI, Channel.STATUS)
"""Channels that every ground subscribes to; one that only shows the video may leave out the others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """The functions that a ground's messages call: they run in the link's callbacks, and must be quick."""

    info: Callable[[int], bytes]
    """Returns the session's facts for a query that came at this time, by the clock of the headers."""
    control: Callable[[ControlRequest], ControlAnswer]
    on_feedback: Callable[[Feedback], None]
    on_info_request: Callable[[InfoRequest], None] = lambda _request: None
    """Called before ``info`` answers."""
    reply: Callable[[Channel, bytes], bytes] = lambda _channel, payload: payload
    """Returns the payload as it leaves (`Transmitter.reply`)."""


class EdgeLink(Outlet, Protocol):
    """The link as an edge uses it: `ZenohLink`, or a study's."""

    @property
    def unusable(self) -> int:
        """Messages from grounds that were skipped: damaged, foreign or of another version."""
        ...

    @property
    def trouble(self) -> str:
        """The reason why no ground can be reached, where the log has given it."""
        ...

    def has_ground(self) -> bool:
        """Whether a ground subscribes to base, stills and status."""
        ...

    def has_subscriber(self, channel: Channel) -> bool: ...

    def listen(self, answers: Answers) -> None:
        """Answer grounds from now on; called once all parts that answer exist."""
        ...

    def mend(self) -> None:
        """Called once a second in the frame loop, also while that waits: restore lost parts of the link."""
        ...


class ZenohLink:
    """One Zenoh session with publishers of all channels; a context manager.

    Raises `UserError` where a port or an endpoint cannot be used, or another edge with that id is on the link.
    """

    def __init__(
        self, settings: LinkSettings, *, edge_id: str, failures: Failures, clock: Callable[[], int]
    ) -> None:
        self._settings, self._failures = settings, failures
        self._keys = EdgeKeys(edge_id)
        self._clock = clock
        link_doctor().check_id(settings, self._keys)
        self._listener: EdgeListener | None = None
        self._deaf = threading.Event()
        self._stack = ExitStack()
        self._open()

    def _open(self) -> None:
        settings, self._deaf = self._settings, threading.Event()
        opened = open_session(settings, failures=self._failures, on_deaf=self._deaf.set)
        self._session = self._stack.enter_context(opened)
        self._loses = loses_declarations(settings, self._session)
        self._publishers = {
            channel: declare_publisher(self._session, channel, keys=self._keys) for channel in _PUBLISHED
        }
        watch = link_doctor().watch(self._session, settings, served=lambda _ground: self.has_ground())
        self._watch = self._stack.enter_context(watch)
        if self._listener is not None:
            self._listener.go_on(self._session)

    @property
    def trouble(self) -> str:
        return self._watch.trouble

    @property
    def unusable(self) -> int:
        return 0 if self._listener is None else self._listener.unusable

    def has_ground(self) -> bool:
        return all(self.has_subscriber(channel) for channel in _NEEDED)

    def has_subscriber(self, channel: Channel) -> bool:
        status: Any = self._publishers[channel].matching_status  # Zenoh's own stub calls it a bool
        return bool(status.matching)

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Send one message; blocks while the link is full. A link that is gone drops it without an error."""
        with suppress(zenoh.ZError):
            self._publishers[channel].put(payload, attachment=attachment, encoding=encoding or None)

    def mend(self) -> None:
        if self._deaf.is_set():
            self._stack.close()
            try:
                self._open()
            except (UserError, zenoh.ZError) as error:  # a file of the link's is gone, or its port taken
                self._failures.failed("listener", str(error))
                self._deaf.set()
        with suppress(zenoh.ZError):
            if self._listener is not None and self._loses():
                self._listener.declare_again(there=self.has_ground())

    def listen(self, answers: Answers) -> None:
        self._listener = EdgeListener(
            self._session, self._keys, answers, failures=self._failures, clock=self._clock
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        if self._listener is not None:
            self._listener.close()
        self._stack.close()


@dataclass(eq=False)
class EdgeListener:
    """Declares queryables for info and control, the feedback subscriber, and last the alive token.

    Grounds find the edge by the token. ``clock`` is the clock of the headers.
    """

    session: zenoh.Session
    keys: EdgeKeys
    answers: Answers
    _: KW_ONLY
    failures: Failures
    clock: Callable[[], int]

    def __post_init__(self) -> None:
        self._flood = FloodWatch(most_per_s=_MOST_PER_S)
        self.unusable = 0
        """Messages from grounds that were skipped: damaged, foreign or of another version."""
        self._version_said = False
        self.go_on(self.session)

    def go_on(self, session: zenoh.Session) -> None:
        """Answer through this session from now on; nothing of another one is used any more."""
        self.session = session
        self._used: set[Channel] = set()
        """Channels that the present ground has used."""
        self._waits: dict[Channel, RetryPause] = {}
        """Channels on which nothing comes although a ground is there."""
        self._again: Counter[Channel] = Counter()
        self._declared: dict[Channel, zenoh.Queryable[None] | zenoh.Subscriber[None]] = {}
        for channel in (Channel.INFO, Channel.CONTROL, Channel.FEEDBACK):
            self._declare(channel)
        self._token = self.session.liveliness().declare_token(self.keys[Channel.ALIVE])

    def close(self) -> None:
        self._token.undeclare()  # type: ignore[no-untyped-call]

    def declare_again(self, *, there: bool) -> None:
        """Declare anew the channels that a ground, if one is ``there``, does not use; call it about once a second.

        A declaration is sent once: where UDP has lost it, the ground could not query info and show nothing of this
        flight, could not command, or its reports would not steer.
        """
        now_ns = self.clock()
        if not there:
            self._used.clear()
            self._waits.clear()
        for channel in _AGAIN_NS if there else ():
            pause = self._waits.setdefault(channel, RetryPause(*_AGAIN_NS[channel]))
            if channel in self._used or not pause.due(now_ns):
                continue
            if pause.pause_ns:
                self._declare(channel)
            pause.failed(now_ns)

    def _declare(self, channel: Channel) -> None:
        if channel in self._declared:
            self._declared[channel].undeclare()  # type: ignore[no-untyped-call]
            self._again[channel] += 1
        key = another_key(self.keys[channel], channel, number=self._again[channel])
        if channel is Channel.FEEDBACK:
            self._declared[channel] = self.session.declare_subscriber(key, self._on_feedback)
        else:
            answer = self._on_info if channel is Channel.INFO else self._on_control
            self._declared[channel] = serve(
                self.session, channel, keys=self.keys, answer=answer, declared_as=key
            )

    def _on_info(self, query: bytes) -> bytes | None:
        self._used.add(Channel.INFO)
        if query:
            try:
                self.answers.on_info_request(InfoRequest.parse(query))
            except WireError as error:  # a malformed request is answered all the same
                self._skip("info", error)
        return self._answered(Channel.INFO, lambda: self.answers.info(self.clock()))

    def _on_control(self, query: bytes) -> bytes | None:
        self._used.add(Channel.CONTROL)
        self._watch(Channel.CONTROL)
        try:
            request = ControlRequest.parse(query)
        except WireError as error:
            self._skip("control", error)
            return None
        return self._answered(Channel.CONTROL, lambda: self.answers.control(request).pack())

    def _answered(self, channel: Channel, answer: Callable[[], bytes]) -> bytes | None:
        # None where that fails: no one would handle an error in Zenoh's thread.
        return self.failures.attempt(channel, lambda: self.answers.reply(channel, answer()), None)

    def _on_feedback(self, sample: zenoh.Sample) -> None:
        self._used.add(Channel.FEEDBACK)
        self._watch(Channel.FEEDBACK)
        try:
            feedback = Feedback.parse(sample.payload.to_bytes())
        except WireError as error:
            self._skip("feedback", error)
            return
        self.answers.on_feedback(feedback)

    def _watch(self, channel: Channel) -> None:
        if self._flood.note(channel, now_ns=self.clock()) is not None:
            _log.warning(
                "more than %d messages a second on %s, far more than any ground sends: somebody floods this edge "
                "(docs/security.md has keys against that)",
                _MOST_PER_S,
                channel,
            )

    def _skip(self, channel: str, error: WireError) -> None:
        self.unusable += 1
        if isinstance(error, UnknownVersionError):
            if not (self._version_said or error.in_common):  # the answer names the edge's version
                self._version_said = True
                _log.warning("%s", error.between("a ground", f"edge {self.keys.edge}"))
            return
        if self.unusable.bit_count() == 1:  # 1, 2, 4, 8 …: a flood does not fill the log
            _log.warning("%s message skipped (%d so far): %s", channel, self.unusable, error)
