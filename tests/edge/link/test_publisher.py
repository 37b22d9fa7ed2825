"""What an edge answers, without a link."""

import socket
import time
import zlib
from types import SimpleNamespace
from unittest.mock import MagicMock

import msgpack
import zenoh

from hvt_common.errors import UserError
from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import WIRE_VERSION, Feedback, Message
from hvt_common.runtime.failures import Failures
from hvt_common.transport.session import open_session
from hvt_common.transport.zenoh_config import LinkSettings
from hvt_common.units import SECOND_NS
from hvt_edge.link import publisher
from programs.outsider import joined
from programs.processes import eventually
from rigs.messages import ANSWER, FEEDBACK, INFO_REQUEST, REQUEST


def of_version(version: int, message: Message) -> bytes:
    body = msgpack.packb([version, *msgpack.unpackb(message.pack())[1:-1], 2**32 - 1])[:-5]
    return body + b"\xce" + zlib.crc32(body).to_bytes(4, "big")


class Declared:
    """A listener, and what it declares."""

    def __init__(self, monkeypatch) -> None:
        self.channels, self.keys, self.answers = list[Channel](), list[str](), {}
        self.reports, self.requests, self.now_s = list[Feedback](), [], 0.0
        monkeypatch.setattr(publisher, "serve", self._serve)
        answers = publisher.Answers(
            info=lambda _received_ns: b"info",
            control=lambda _request: ANSWER,
            on_feedback=self.reports.append,
            on_info_request=self.requests.append,
        )
        self.listener = publisher.EdgeListener(
            MagicMock(declare_subscriber=lambda key, take: self._note(Channel.FEEDBACK, key, take)),
            EdgeKeys("uav-1"),
            answers,
            failures=Failures(lambda: 7),
            clock=lambda: round(self.now_s * SECOND_NS),
        )

    def _serve(self, _session, channel, *, keys, answer, declared_as) -> MagicMock:
        return self._note(channel, declared_as, answer)

    def _note(self, channel: Channel, key: str, answer) -> MagicMock:
        self.channels.append(channel)
        self.keys.append(key)
        self.answers[channel] = answer
        return MagicMock()

    def report(self, payload: bytes) -> None:
        self.answers[Channel.FEEDBACK](SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload)))


def test_a_ground_of_another_version_commands_nothing(caplog, monkeypatch):
    """A budget that a ground of last year set would be taken, and its answer not understood."""
    edge = Declared(monkeypatch)
    info, control = edge.answers[Channel.INFO], edge.answers[Channel.CONTROL]
    for version, taken in ((WIRE_VERSION - 1, 0), (WIRE_VERSION + 1, 0), (WIRE_VERSION, 1)):
        assert bool(control(of_version(version, REQUEST))) is bool(taken)
        assert info(of_version(version, INFO_REQUEST)) == b"info", "who asks is told the version"
        edge.report(of_version(version, FEEDBACK))
        assert (len(edge.reports), len(edge.requests)) == (taken, taken)
    assert edge.listener.unusable == 6
    # And none of the newer one on info, which says that it also speaks this one.
    said = (
        f"a ground speaks wire version {WIRE_VERSION - 1}, edge uav-1 reads {WIRE_VERSION}: update a ground"
    )
    assert caplog.messages == [said]
    for junk in (b"", bytes(100_000), b"\x93\x01", FEEDBACK.pack()[:-1]) * 25:
        edge.report(junk)
        assert control(junk) is None
    assert (edge.listener.unusable, len(edge.reports)) == (206, 1)
    assert len(caplog.messages) < 10, "a flood does not fill the log"


def test_what_a_ground_does_not_use_is_declared_again(monkeypatch):
    """One datagram that UDP loses at the start would leave a ground without a picture, or its reports unheard."""
    edge = Declared(monkeypatch)

    def after(seconds: int, *, there: bool) -> tuple[int, int, int]:
        before = len(edge.channels)
        for _ in range(seconds):
            edge.now_s += 1
            edge.listener.declare_again(there=there)
        new = edge.channels[before:]
        return tuple(new.count(one) for one in (Channel.INFO, Channel.CONTROL, Channel.FEEDBACK))

    assert after(10, there=False) == (0, 0, 0)
    assert after(7, there=True) == (3, 2, 2)
    for channel, key in zip(edge.channels, edge.keys, strict=True):
        met = {one for one in Channel if zenoh.KeyExpr(key).intersects(EdgeKeys("uav-1")[one])}
        assert met == {channel}
    assert len(set(edge.keys)) == len(edge.keys), "a key whose number was lost is never understood again"
    assert edge.answers[Channel.INFO](b"") == b"info"
    assert after(30, there=True) == (0, 2, 2), "it has asked, and reports nothing: it may only listen"
    edge.report(FEEDBACK.pack())
    assert len(edge.reports) == 1
    assert edge.answers[Channel.CONTROL](REQUEST.pack())
    assert after(100, there=True) == (0, 0, 0), "all is used"
    assert after(1, there=False) == (0, 0, 0)
    assert after(3, there=True) == (1, 1, 1), "another, or on another way"


def test_who_wants_reports_alone_gets_them_over_udp(free_port):
    """A program that watches the health of a fleet, and leaves its video alone, saw nothing where the link is UDP."""
    place, came = (f"udp/127.0.0.1:{free_port}",), []
    answers = publisher.Answers(
        info=lambda _received_ns: b"", control=lambda _request: ANSWER, on_feedback=lambda _feedback: None
    )
    with (
        open_session(LinkSettings("ground", listen=place)) as ground,
        publisher.ZenohLink(
            LinkSettings("edge", connect=place),
            edge_id="uav-1",
            failures=Failures(time.time_ns),
            clock=time.time_ns,
        ) as link,
    ):
        link.listen(answers)
        ground.declare_subscriber("hvt/uav-1/status", came.append)
        eventually(lambda: link.has_subscriber(Channel.STATUS))
        link.put(Channel.STATUS, b"x")
        eventually(lambda: came)


def refused(*_: object, **__: object) -> None:
    raise UserError("its key has gone")


def test_an_edge_whose_listener_hears_nothing_any_more_makes_its_link_anew(free_port, monkeypatch, caplog):
    """No picture would come any more once its radio was plugged in anew: it had to be restarted by hand."""
    there, anew = socket.if_nameindex(), "since its interface was removed: the link is made anew"
    monkeypatch.setattr(socket, "if_nameindex", lambda: there if anew in caplog.text else [])
    came, asked, failures = [], [], Failures(time.time_ns)
    told = publisher.Answers(
        info=lambda _received_ns: b"yes", control=lambda _request: ANSWER, on_feedback=asked.append
    )
    with publisher.ZenohLink(
        LinkSettings("edge", listen=(f"tcp/127.0.0.1:{free_port}#iface=lo",)),
        edge_id="uav-1",
        failures=failures,
        clock=time.time_ns,
    ) as link:
        link.listen(told)
        eventually(lambda: anew in caplog.text)
        with monkeypatch.context() as gone:
            gone.setattr(publisher, "open_session", refused)
            eventually(lambda: link.mend() or "its key has gone" in failures.now[0].reason)
        link.mend()
        eventually(lambda: "listener: works again" in caplog.text)
        with joined(f"tcp/127.0.0.1:{free_port}") as ground:
            ground.declare_subscriber("hvt/uav-1/status", came.append)
            eventually(lambda: link.has_subscriber(Channel.STATUS))
            link.put(Channel.STATUS, b"x")
            eventually(lambda: came)
            ground.put("hvt/uav-1/feedback", FEEDBACK.pack())
            eventually(lambda: asked)
            (alive,) = ground.liveliness().get("hvt/uav-1/alive")
            assert alive.ok is not None
