"""The edge's end of the link in a flight of the study: messages go to a simulated line, reports come back over it."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.ledger import overhead_bytes
from hvt_common.protocol.messages import BaseHeader, CaptureTimes, RoiHeader, Status, StillResult, TrackStep
from hvt_common.runtime.clock import SteadyClock
from hvt_common.transport.inbox import Received
from hvt_common.units import SECOND_NS
from hvt_edge.link.feedback import FeedbackInbox
from hvt_edge.link.publisher import Answers
from hvt_edge.perception.shadow import Detected
from hvt_study.datasets.sequence import NOMINAL_FPS
from hvt_study.serial_link import SerialLink

START_NS = 1_700_000_000_000_000_000


def frame_ns(frame_index: int) -> int:
    """Capture of a frame of the clip."""
    return START_NS + round(frame_index * SECOND_NS / NOMINAL_FPS)


class MediaClock(SteadyClock):
    """Stands still: in lockstep the source alone says what time it is."""

    def __call__(self) -> int:
        """Unix nanoseconds of the flight's beginning."""
        return START_NS


class FlightInbox(FeedbackInbox):
    """What the ground said, when the link has brought it back; nobody ever waits for more."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = START_NS
        self.due: deque[tuple[int, StillResult]] = deque()
        self.due_detected: deque[tuple[int, Detected]] = deque()

    def take(self) -> list[StillResult]:
        """Return and forget what has come by now."""
        due = [one for at_ns, one in self.due if at_ns <= self.now_ns]
        self.due = deque((at_ns, one) for at_ns, one in self.due if at_ns > self.now_ns)
        return due

    def take_up_to(self, sequence: int) -> list[StillResult]:  # noqa: ARG002 - time decides here
        """The same."""
        return self.take()

    def take_detected(self, *, up_to: int | None = None) -> Detected | None:  # noqa: ARG002 - time decides here
        """The newest that has come by now."""
        newest = None
        while self.due_detected and self.due_detected[0][0] <= self.now_ns:
            newest = self.due_detected.popleft()[1]
        return newest

    def wait_for(self, **_: Any) -> bool:
        """At once."""
        return True

    def wait_for_end(self, **_: Any) -> bool:
        """At once."""
        return True


class FlightOutlet:
    """The edge's end of the link: `hvt_edge.link.publisher.EdgeLink` without Zenoh.

    ``on_listen(info)`` is called with what the edge answers to ``info`` once it is ready.
    """

    unusable = 0
    trouble = ""

    def __init__(
        self, link: SerialLink[Received], *, edge_id: str, on_listen: Callable[[bytes], None]
    ) -> None:
        self._link = link
        self._keys = EdgeKeys(edge_id)
        self._on_listen = on_listen
        self._digest = hashlib.sha256()
        self._captures = CaptureTimes()
        self.line_bytes: Counter[str] = Counter()
        self.messages: Counter[str] = Counter()
        self.max_frame_bytes = 0
        self.last_frame = -1

    def has_ground(self) -> bool:
        """Always."""
        return True

    def has_subscriber(self, channel: Channel) -> bool:  # noqa: ARG002
        """Of every channel."""
        return True

    def listen(self, answers: Answers) -> None:
        """The edge is ready."""
        self._on_listen(answers.info(START_NS))

    def put(
        self, channel: Channel, payload: bytes, *, attachment: bytes | None = None, encoding: str = ""
    ) -> None:
        """Hand over one message at the time that it says itself."""
        attached = attachment or b""
        key = self._keys.key(channel)
        size_bytes = (
            len(payload)
            + len(attached)
            + overhead_bytes(len(payload), len(attached), key=key, encoding=encoding)
        )
        self.line_bytes[channel] += size_bytes
        self.messages[channel] += 1
        if channel is not Channel.STATUS:  # it counts what the machine did
            self._digest.update(payload)
        self._link.put(
            Received(key, payload, attached, encoding, 0),
            size_bytes=size_bytes,
            enter_ns=self._enter_ns(channel, payload, attached),
            urgent=channel is Channel.BASE,
        )

    @property
    def digest(self) -> str:
        """Of all that was sent but status: equal flights have the same."""
        return self._digest.hexdigest()

    def _enter_ns(self, channel: Channel, payload: bytes, attachment: bytes) -> int:
        if channel is Channel.BASE:
            header = BaseHeader.parse(attachment, payload)
            self.last_frame = header.frame_index
            self.max_frame_bytes = max(self.max_frame_bytes, len(payload))
            self._captures.note(header)
            return header.send_ns
        if channel is Channel.ROI:
            still = RoiHeader.parse(attachment, payload)
            return self._captures.filled(still, otherwise_ns=0).send_ns
        if channel is Channel.TRACKS:
            return TrackStep.parse(payload).send_ns
        assert channel is Channel.STATUS, f"the edge sends no {channel}"
        return Status.parse(payload).send_ns
