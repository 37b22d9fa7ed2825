"""The Python API for asking edges.

    from hvt_ground.control import EdgeClient

    with EdgeClient.connect("tcp/127.0.0.1:7447") as edges:
        crop = edges["uav-1"].still(track=17, at_s=-3)
        crop.save("crop.png")

It connects to a ground or to a router, which pass on questions and answers, so that a still crosses the
link of the edge once. An edge that listens itself can be connected to as well; its stills then cross its link twice
while one is waited for.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TypeVar

import cv2
import zenoh

from hvt_common.errors import UserError, telling
from hvt_common.protocol.channels import Channel, EdgeKeys, parse_key, selector
from hvt_common.protocol.messages import (
    Command,
    ControlAnswer,
    ControlRequest,
    Info,
    RoiHeader,
    Status,
    UnknownVersionError,
    WireError,
)
from hvt_common.transport.inbox import Inbox, Received
from hvt_common.transport.link_doctor import control_unanswered, link_doctor
from hvt_common.transport.session import open_session, query, subscribe
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.values import Image
from hvt_common.video.still_codecs import StillError
from hvt_ground.perception.stills.decode import ReceivedStill, decode_still

ANSWER_S = 2.0
_POLL_S = 0.3
_OUTCOME_S = 0.5
"""Time between two queries of the outcome of a still that does not come."""
_INBOX_MESSAGES = 64
_JPEG_QUALITY_PCT = 95
_SUFFIXES = (".jpg", ".jpeg", ".png")

_Message = TypeVar("_Message")


class RefusedError(UserError):
    """The edge says no; the text is its reason."""


@dataclass(frozen=True, slots=True)
class EdgeTrack:
    """A track of the edge now."""

    track_id: int
    """The edge's own; a ground numbers its tracks itself."""
    class_name: str
    confidence: float
    box_source_px: tuple[float, float, float, float]
    """x1, y1, x2, y2."""


@dataclass(frozen=True, slots=True)
class RequestedStill:
    """A still that was requested."""

    edge: str
    header: RoiHeader
    """All that came with it: frame, capture time, track, box, crop, codec, quality."""
    data: bytes
    """As it came over the link."""
    image_bgr: Image
    """(height, width, 3) uint8; smaller than the crop where the budget is thin, or it is longer than 2048 pixels."""

    def save(self, path: Path | str) -> None:
        """Write it as JPEG or PNG, by the suffix; a JPEG that came as one is written as it came.

        Raises `UserError` for another suffix, or where the file cannot be written.
        """
        path = Path(path)
        check_suffix(path)
        data = self.data
        if path.suffix.lower() == ".png" or self.header.codec != "jpeg":
            options = [] if path.suffix.lower() == ".png" else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY_PCT]
            data = cv2.imencode(path.suffix.lower(), self.image_bgr, options)[1].tobytes()
        with telling(f"{path} cannot be written (", "): name a file that can"):
            path.write_bytes(data)


def check_suffix(path: Path) -> None:
    """Raise `UserError` for a picture format that is not written."""
    if path.suffix.lower() not in _SUFFIXES:
        raise UserError(f"{path} is not a picture that can be written: name it {', '.join(_SUFFIXES)}")


def _link_hint(session: zenoh.Session) -> str:
    # Names the other end by its key; empty without keys. An asker has one link.
    names = sorted({link.auth_identifier for link in session.info.links() if link.auth_identifier})
    if not names:
        return ""
    return (
        f"; {names[0]}, to which we are linked, passes on only what its file lets our key see (hvt-ground keys list; "
        f"a {names[0]}.json5 from before our key was made does not name it)"
    )


class RemoteEdge:
    """One edge, at the other end of the link.

    Every method raises `UserError` where it does not answer, two edges of its name do, or our own keys do not let us
    ask, and `RefusedError` where it says no.
    """

    def __init__(self, session: zenoh.Session, edge: str, *, refusal: Callable[[str], str]) -> None:
        self.name = edge
        self._session = session
        self._keys = EdgeKeys(edge)
        self._refusal = refusal

    def info(self) -> Info:
        answers = [self._parsed(Info.parse, data) for data in self._query(Channel.INFO, b"")]
        if not answers:
            raise UserError(self._absent())
        # The first may not be the one that the ground shows.
        if len({info.session_id for info in answers}) > 1:
            raise UserError(
                f"two edges call themselves {self.name}, and both have answered: stop one of them, or start it with "
                "an --edge-id of its own"
            )
        return answers[0]

    def tracks(self, *, on_note: Callable[[str], None] = lambda _note: None) -> list[EdgeTrack]:
        """Its present tracks, by its own ids; ``on_note`` is called with a sentence if that is not all."""
        self._check_may_command()
        info = self.info()
        answer = self._obeyed(info.session_id, Command.TRACKS, {})
        if answer.note:
            on_note(answer.note)
        name = dict(enumerate(info.class_names))
        return [
            EdgeTrack(
                one.track_id, name.get(one.class_id, str(one.class_id)), one.confidence, one.box_source_px
            )
            for one in answer.tracks
        ]

    def keyframe(self) -> None:
        self.command(Command.KEYFRAME)

    def set_budget(self, bps: int) -> None:
        self.command(Command.SET_BUDGET, {"bps": bps})

    def set_method(self, method: str) -> None:
        """Set who gets a still: a name of ``hvt-edge --method``."""
        self.command(Command.SET_METHOD, {"method": method})

    def still(
        self,
        *,
        track: int | None = None,
        box: tuple[int, int, int, int] | None = None,
        at_s: float | None = None,
        frame: int | None = None,
        quality_pct: int | None = None,
        timeout_s: float = 15.0,
        on_note: Callable[[str], None] = lambda _note: None,
    ) -> RequestedStill:
        """Ask for a still of the untouched source frame, and wait for it.

        Of a ``track`` (the edge's id, see `tracks`), of a ``box`` (x, y, width and height in source pixels), or
        else the whole frame; ``at_s`` seconds before the edge's newest frame (as ``-3``), at ``frame``, or else the
        newest. ``quality_pct`` is 5 to 95, None for the edge's ``--jpeg-quality``; less where the budget has no
        room, more where the video is as good. ``on_note`` is called with a sentence where it comes otherwise than
        requested, before it comes. Raises `RefusedError` where the edge refused it or gave it up, `UserError` where
        the edge ended, or it did not come in time.
        """
        given = {"track": track, "frame": frame, "quality": quality_pct}
        given["at_ms"] = None if at_s is None else round(at_s * 1000)
        given |= zip(("x", "y", "w", "h"), box or (), strict=False)
        arguments = {name: value for name, value in given.items() if value is not None}
        until_s = time.monotonic() + timeout_s
        self._check_may_command()
        info = self.info()
        inbox = Inbox(capacity=_INBOX_MESSAGES)
        subscribers = [
            subscribe(self._session, self._keys[channel], put=inbox.put)
            for channel in (Channel.ROI, Channel.STATUS)
        ]
        try:
            answer = self._obeyed(info.session_id, Command.STILL, arguments)
            header, item = self._wait(inbox, answer, until_s=until_s, timeout_s=timeout_s, on_note=on_note)
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
        received = ReceivedStill(header, item.payload)
        try:
            image = decode_still(received, base=None, view=info.view)
        except StillError as error:
            raise UserError(f"{self.name} sent a still that cannot be decoded: {error}") from None
        return RequestedStill(self.name, header, item.payload, image)

    def command(
        self, command: str, arguments: Mapping[str, int | float | str] | None = None
    ) -> ControlAnswer:
        """Send any command of docs/wire.md; return the answer where it is accepted."""
        self._check_may_command()
        return self._obeyed(self.info().session_id, command, arguments or {})

    def _obeyed(
        self, session_id: int, command: str, arguments: Mapping[str, int | float | str]
    ) -> ControlAnswer:
        answer = self._commanded(session_id, command, arguments)
        if answer is None:
            raise UserError(control_unanswered(self._session, self.name, who="this key"))
        return answer

    def _wait(
        self,
        inbox: Inbox,
        answer: ControlAnswer,
        *,
        until_s: float,
        timeout_s: float,
        on_note: Callable[[str], None],
    ) -> tuple[RoiHeader, Received]:
        # The still of that number; in between the edge is asked whether it is still to come.
        query_s, noted = time.monotonic() + _OUTCOME_S, ""
        while (now_s := time.monotonic()) < until_s:
            item = inbox.get(timeout_s=min(_POLL_S, until_s - now_s))
            if item is not None and item.key.endswith(f"/{Channel.STATUS}"):
                status = _read(Status.parse, item.payload)
                if status and (status.session_id, status.state) == (answer.session_id, "ended"):
                    raise UserError(f"{self.name} has ended: the still does not come")
            elif item is not None:
                header = _read(RoiHeader.parse, item.attachment, item.payload)
                answers = header and (header.session_id, header.parameters.get("ask"))
                if header and answers == (answer.session_id, answer.still_request):
                    return header, item
            if now_s >= query_s:
                note = self._note_of(answer)
                if note and note != noted:
                    on_note(note)
                    noted = note
                query_s = now_s + _OUTCOME_S
        raise UserError(
            f"{self.name} accepted the still, but it did not come within {timeout_s:g} s: {self._why_late()}"
        )

    def _note_of(self, answer: ControlAnswer) -> str:
        # The edge's note on a pending still. Raises `RefusedError` if none comes.
        try:
            outcome = self._commanded(answer.session_id, Command.STILL_OUTCOME, {"ask": answer.still_request})
        except RefusedError:
            raise
        except UserError:
            return ""  # an answer that cannot be used, as no answer: the still itself may come all the same
        return "" if outcome is None else outcome.note

    def _why_late(self) -> str:
        alive = self._session.liveliness().get(self._keys[Channel.ALIVE], timeout=ANSWER_S)
        if any(reply.ok is not None for reply in alive):
            return "the link is full, or has lost it"
        return "the edge is not there any more: it has ended, or its link is down"

    def _commanded(
        self, session_id: int, command: str, arguments: Mapping[str, int | float | str]
    ) -> ControlAnswer | None:
        # The answer where that session accepts; None where there is none in time. Others refuse.
        try:
            question = ControlRequest(
                session_id=session_id, command=command, arguments=arguments, request_id=secrets.randbits(64)
            ).pack()
        except ValueError as error:
            raise UserError(f"{command}: {error}") from None

        def is_ours(data: bytes) -> bool:
            answer = _read(ControlAnswer.parse, data)
            return answer is not None and answer.session_id == session_id

        answers = self._query(Channel.CONTROL, question, is_last=is_ours)
        if not answers:
            return None
        answer = self._parsed(ControlAnswer.parse, answers[-1])
        if answer.session_id != session_id:
            raise RefusedError(
                f"the session of {self.name} that was asked does not answer, and another one does: it was "
                "started anew, or two edges have one name"
            )
        if not answer.accepted:
            raise RefusedError(f"{self.name} refuses: {answer.reason}")
        return answer

    def _check_may_command(self) -> None:
        if refusal := self._refusal(self.name):
            raise UserError(refusal)

    def _query(
        self, row: Channel, question: bytes, is_last: Callable[[bytes], bool] | None = None
    ) -> list[bytes]:
        with suppress(zenoh.ZError):
            return query(
                self._session, row, keys=self._keys, question=question, timeout_s=ANSWER_S, is_last=is_last
            )
        return []

    def _absent(self) -> str:
        return (
            f"edge {self.name!r} does not answer: is it flying, and does this link reach it?"
            f"{_link_hint(self._session)}"
        )

    def _parsed(self, parse: Callable[[bytes], _Message], data: bytes) -> _Message:
        try:
            return parse(data)
        except UnknownVersionError as error:
            raise UserError(error.between(f"edge {self.name}", "this ground")) from None
        except WireError as error:
            raise UserError(f"the answer of {self.name} cannot be used: {error}") from None


class EdgeClient:
    """The edges that can be reached from one place; a context manager. ``client["uav-1"]`` is one of them."""

    def __init__(
        self, session: zenoh.Session, settings: LinkSettings, *, stack: ExitStack | None = None
    ) -> None:
        """Ask through a session that is open, which its owner closes; ``settings`` are those that it has."""
        self._session = session
        self._refusal = link_doctor().refusals(settings)
        self._stack = stack or ExitStack()

    @classmethod
    def connect(cls, *endpoints: str, zenoh_config: Path | None = None) -> EdgeClient:
        """Connect to a ground or a router, such as ``tcp/127.0.0.1:7447``, where one listens unless told otherwise.

        Raises `UserError` where nobody answers within three seconds, or a setting cannot be used.
        """
        stack = ExitStack()
        settings = LinkSettings(role="client", connect=endpoints, zenoh_config=zenoh_config)
        return cls(stack.enter_context(open_session(settings)), settings, stack=stack)

    def go_on(self, session: zenoh.Session) -> None:
        """Ask through another session from now on."""
        self._session = session

    def nobody(self) -> str:
        """The sentence for a user if `names` is empty."""
        return f"no edge is there{_link_hint(self._session)}"

    def names(self) -> list[str]:
        replies = self._session.liveliness().get(selector(Channel.ALIVE), timeout=ANSWER_S)
        keys = [parse_key(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None]
        return sorted({key[0] for key in keys if key is not None})

    def __getitem__(self, edge: str) -> RemoteEdge:
        return RemoteEdge(self._session, edge, refusal=self._refusal)

    def close(self) -> None:
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _read(parse: Callable[..., _Message], *data: bytes) -> _Message | None:
    try:
        return parse(*data)
    except WireError:
        return None
