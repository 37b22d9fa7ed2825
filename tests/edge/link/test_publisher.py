"""What an edge answers, without a link."""

from __future__ import annotations

import socket
import time
import zlib
from types import SimpleNamespace
from unittest.mock import MagicMock

import msgpack
import zenoh

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
    """The message as a ground of another version would have sealed it."""
    body = msgpack.packb([version, *msgpack.unpackb(message.pack())[1:-1], 2**32 - 1])[:-5]
    return body + b"\xce" + zlib.crc32(body).to_bytes(4, "big")


def test_a_ground_of_another_version_commands_nothing(caplog, monkeypatch):
    """A budget that a ground of last year set would be taken, and its answer not understood."""
    reports: list[Feedback] = []
    requests: list[object] = []
    session, asked = MagicMock(), {}
    monkeypatch.setattr(
        publisher, "serve", lambda _session, channel, **told: asked.update({channel: told["answer"]})
    )
    listener = publisher.EdgeListener(
        session,
        EdgeKeys("uav-1"),
        publisher.Answers(
            info=lambda _received_ns: b"info",
            control=lambda _request: ANSWER,
            on_feedback=reports.append,
            on_info_request=requests.append,
        ),
        failures=Failures(lambda: 7),
        clock=lambda: 7,
    )
    report = session.declare_subscriber.call_args.args[1]
    for version, taken in ((WIRE_VERSION - 1, 0), (WIRE_VERSION + 1, 0), (WIRE_VERSION, 1)):
        assert bool(asked[Channel.CONTROL](of_version(version, REQUEST))) is bool(taken)
        assert asked[Channel.INFO](of_version(version, INFO_REQUEST)) == b"info", (
            "who asks is told the version"
        )
        sample = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda v=version: of_version(v, FEEDBACK)))
        report(sample)
        assert (len(reports), len(requests)) == (taken, taken)
    assert listener.unusable == 6
    said = (
        f"a ground speaks wire version {WIRE_VERSION - 1}, edge uav-1 reads {WIRE_VERSION}: update a ground"
    )
    assert caplog.messages == [
        said
    ]  # and none of the newer one on info, which says that it also speaks this one
    for junk in (b"", bytes(100_000), b"\x93\x01", FEEDBACK.pack()[:-1]) * 25:
        report(SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda junk=junk: junk)))
        assert asked[Channel.CONTROL](junk) is None
    assert (listener.unusable, len(reports)) == (206, 1)
    assert len(caplog.messages) < 10, "a flood does not fill the log"


def test_what_a_ground_does_not_use_is_declared_again(monkeypatch):
    """One datagram that UDP loses at the start would leave a ground without a picture, or its reports unheard."""
    declared, keys, now_s = [], [], [0.0]

    def serve(_session: object, channel: Channel, **told: object) -> MagicMock:
        declared.append((channel, told["answer"]))
        keys.append(told["declared_as"])
        return MagicMock()

    def subscribe(key: str, callback: object) -> MagicMock:
        declared.append((Channel.FEEDBACK, callback))
        keys.append(key)
        return MagicMock()

    monkeypatch.setattr(publisher, "serve", serve)
    reports: list[Feedback] = []
    answers = publisher.Answers(
        info=lambda _received_ns: b"info", control=lambda _request: ANSWER, on_feedback=reports.append
    )
    listener = publisher.EdgeListener(
        MagicMock(declare_subscriber=subscribe),
        EdgeKeys("uav-1"),
        answers,
        failures=Failures(lambda: 7),
        clock=lambda: round(now_s[0] * SECOND_NS),
    )

    def after(seconds: int, *, there: bool) -> tuple[int, int, int]:
        before = len(declared)
        for _ in range(seconds):
            now_s[0] += 1
            listener.declare_again(there=there)
        channels = [channel for channel, _ in declared[before:]]
        return tuple(channels.count(one) for one in (Channel.INFO, Channel.CONTROL, Channel.FEEDBACK))

    assert after(10, there=False) == (0, 0, 0)
    assert after(7, there=True) == (3, 2, 2)
    for (channel, _), key in zip(declared, keys, strict=True):
        met = {one for one in Channel if zenoh.KeyExpr(key).intersects(EdgeKeys("uav-1")[one])}
        assert met == {channel}
    assert len(set(keys)) == len(keys), "a key whose number was lost is never understood again"
    answer = next(answer for channel, answer in reversed(declared) if channel is Channel.INFO)
    assert answer(b"") == b"info"
    assert after(30, there=True) == (0, 2, 2), "it has asked, and reports nothing: it may only listen"
    report = next(answer for channel, answer in reversed(declared) if channel is Channel.FEEDBACK)
    report(SimpleNamespace(payload=SimpleNamespace(to_bytes=FEEDBACK.pack)))
    assert len(reports) == 1
    command = next(answer for channel, answer in reversed(declared) if channel is Channel.CONTROL)
    assert command(REQUEST.pack())
    assert after(100, there=True) == (0, 0, 0), "all is used"
    assert (after(1, there=False), after(3, there=True)) == ((0, 0, 0), (1, 1, 1)), (
        "another, or on another way"
    )


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


def test_an_edge_whose_listener_hears_nothing_any_more_makes_its_link_anew(free_port, monkeypatch, caplog):
    """No picture would come any more once its radio was plugged in anew: it had to be restarted by hand."""
    there, answers = socket.if_nameindex(), iter([[]])
    monkeypatch.setattr(socket, "if_nameindex", lambda: next(answers, there))
    came, asked = [], []
    told = publisher.Answers(
        info=lambda _received_ns: b"yes", control=lambda _request: ANSWER, on_feedback=asked.append
    )
    with publisher.ZenohLink(
        LinkSettings("edge", listen=(f"tcp/127.0.0.1:{free_port}#iface=lo",)),
        edge_id="uav-1",
        failures=Failures(time.time_ns),
        clock=time.time_ns,
    ) as link:
        link.listen(told)
        eventually(lambda: "since its interface was removed: the link is made anew" in caplog.text)
        link.put(Channel.STATUS, b"x")
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
