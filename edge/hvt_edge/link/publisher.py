"""The edge's end of the link: what it declares, sends and hears. Knows Zenoh; knows nothing of frames."""

from __future__ import annotations

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import ControlAnswer, ControlRequest, Feedback, WireError
from hvt_common.transport.flood import FloodWatch
from hvt_common.transport.session import declare_publisher, serve

__all__ = ["EdgeLink"]

_log = logging.getLogger(__name__)

_PUBLISHED = (Channel.BASE, Channel.ROI, Channel.TRACKS, Channel.BACKLOG, Channel.STATUS)
_MOST_PER_S = 1000
"""Questions, or reports: a ground sends some ten a second."""
_NEEDED = (Channel.BASE, Channel.ROI, Channel.STATUS)
"""Rows that a ground subscribes to in any case; one that only shows the video may leave out tracks and past."""


class EdgeLink:
    """Publishers of all rows; queryables info and control; a subscriber of feedback; the alive token.

    ``answer_info(received_ns)``, ``answer_control(request)`` and ``hear(feedback)`` run in Zenoh's callbacks and
    must be quick; ``clock`` is that of the headers.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: EdgeKeys,
        *,
        answer_info: Callable[[int], bytes],
        answer_control: Callable[[ControlRequest], ControlAnswer],
        hear: Callable[[Feedback], None],
        clock: Callable[[], int],
    ) -> None:
        self._keys = keys
        self._answer_info = answer_info
        self._answer_control = answer_control
        self._hear = hear
        self._clock = clock
        self._flood = FloodWatch(most_per_s=_MOST_PER_S)
        self.unusable = 0
        """Messages from grounds that were skipped: damaged, foreign or of another version."""
        self._publishers = {row: declare_publisher(session, row, keys=keys) for row in _PUBLISHED}
        serve(session, Channel.INFO, keys=keys, answer=self._info)
        serve(session, Channel.CONTROL, keys=keys, answer=self._control)
        self._feedback = session.declare_subscriber(keys.key(Channel.FEEDBACK), self._on_feedback)
        # Last: who sees the token may ask at once.
        self._token = session.liveliness().declare_token(keys.key(Channel.ALIVE))

    def heard(self) -> bool:
        """Whether a ground subscribes to base, stills and status."""
        return all(self.listens(row) for row in _NEEDED)

    def listens(self, row: Channel) -> bool:
        """Whether somebody subscribes to this row."""
        # Zenoh's own stub calls the status a bool.
        return bool(self._publishers[row].matching_status.matching)  # type: ignore[attr-defined]

    def put(
        self, row: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Send one message; blocks while the link is full. A link that is gone takes nothing and says nothing."""
        try:
            self._publishers[row].put(payload, attachment=attachment, encoding=encoding or None)
        except zenoh.ZError as error:
            _log.debug("%s was not sent: %s", row, error)

    def close(self) -> None:
        """Withdraw the token, so that grounds see the end."""
        self._token.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _info(self, _question: bytes) -> bytes:
        return self._answer_info(self._clock())

    def _control(self, question: bytes) -> bytes | None:
        self._watch(Channel.CONTROL)
        try:
            request = ControlRequest.parse(question)
        except WireError as error:
            self._skip("control", error)
            return None
        return self._answer_control(request).pack()

    def _on_feedback(self, sample: zenoh.Sample) -> None:
        self._watch(Channel.FEEDBACK)
        try:
            feedback = Feedback.parse(sample.payload.to_bytes())
        except WireError as error:
            self._skip("feedback", error)
            return
        self._hear(feedback)

    def _watch(self, row: Channel) -> None:
        if self._flood.note(row, now_ns=self._clock()) is not None:
            _log.warning(
                "more than %d messages a second on %s, far more than any ground sends: somebody floods this edge "
                "(docs/security.md has keys against that)",
                _MOST_PER_S,
                row,
            )

    def _skip(self, row: str, error: WireError) -> None:
        self.unusable += 1
        if self.unusable.bit_count() == 1:  # 1, 2, 4, 8 …: a flood does not fill the log
            _log.warning("%s message skipped (%d so far): %s", row, self.unusable, error)
