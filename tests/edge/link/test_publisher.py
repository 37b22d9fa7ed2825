"""What an edge answers, without a link."""

from __future__ import annotations

import zlib
from types import SimpleNamespace
from unittest.mock import MagicMock

import msgpack

from hvt_common.protocol.channels import Channel, EdgeKeys
from hvt_common.protocol.messages import WIRE_VERSION, Feedback, Message
from hvt_common.units import SECOND_NS
from hvt_edge.link import publisher
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
        failures=MagicMock(),
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
    assert caplog.messages == [said]


def test_a_ground_that_does_not_ask_is_told_again_whom_to_ask(monkeypatch):
    """One datagram that UDP loses at the start would leave a ground without a picture for the whole flight."""
    declared, now_s = [], [0.0]

    def serve(_session: object, channel: Channel, **told: object) -> MagicMock:
        declared.append((channel, told["answer"]))
        return MagicMock()

    monkeypatch.setattr(publisher, "serve", serve)
    answers = publisher.Answers(
        info=lambda _received_ns: b"info", control=lambda _request: ANSWER, on_feedback=lambda _feedback: None
    )
    listener = publisher.EdgeListener(
        MagicMock(),
        EdgeKeys("uav-1"),
        answers,
        failures=MagicMock(),
        clock=lambda: round(now_s[0] * SECOND_NS),
    )

    def after(seconds: int, *, there: bool) -> int:
        before = len(declared)
        for _ in range(seconds):
            now_s[0] += 1
            listener.declare_info_again(there=there)
        return [channel for channel, _ in declared[before:]].count(Channel.INFO)

    assert after(10, there=False) == 0
    assert after(7, there=True) == 3
    assert declared[-1][1](b"") == b"info"
    assert after(10, there=True) == 0, "it has asked"
    assert (after(1, there=False), after(3, there=True)) == (0, 1), "another, or the same on another way"
